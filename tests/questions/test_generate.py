"""Generated scenes: the evidence, the seed, and the distribution of the model."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from app.scene import CANONICAL, contradiction, derive_relations
from app.scene.scene import Scene
from tests.enumeration.small_machines import enumerate_joint, small_machine
from tests.questions.answers import generate
from tests.questions.artifacts import (
    EXACT,
    LABELS,
    LARGER,
    STRUCTURE,
    artifact_of,
    exact_artifact,
    larger_artifact,
    random_machine,
    scene_of,
)
from tests.questions.log_score import log_score
from tests.questions.test_properties import scenes
from training.machines import MachineSpec
from training.machines.arrays import machine_of

NAMES = tuple(name for name, spec in LARGER.items() if spec.is_local)
ARTIFACTS = {name: larger_artifact(name) for name in NAMES}
every_model = pytest.mark.parametrize("artifact", ARTIFACTS.values(), ids=NAMES)


@settings(max_examples=25)
@given(st.sampled_from(NAMES), scenes(minimum=0), st.integers(0, 2**63 - 1))
def test_scenes_contain_the_evidence_and_no_contradiction(name, scene, seed):
    evidence = {thing.label for thing in scene.objects}
    stated = {
        (scene.objects[i].label, CANONICAL[a], scene.objects[j].label)
        for a, i, j in scene.relations or ()
    }
    for drawn in generate(ARTIFACTS[name], scene, count=9, seed=seed, steps=4):
        assert evidence <= set(drawn.objects)
        assert not (set(drawn.objects) - evidence) & STRUCTURE
        assert list(drawn.objects) == sorted(set(drawn.objects), key=LABELS.index)
        assert stated <= set(drawn.relations)
        assert len(set(drawn.relations)) == len(drawn.relations)
        free = []
        for subject, relation, object_ in drawn.relations:
            assert {subject, object_} <= set(drawn.objects)
            if (subject, relation, object_) not in stated:
                assert subject != object_
                assert not {subject, object_} & STRUCTURE
                assert (object_, relation, subject) not in stated
                free.append((CANONICAL.index(relation), subject, object_))
        assert contradiction(free) is None
        assert math.isfinite(drawn.log_score)


@every_model
def test_scenes_depend_on_the_seed_and_not_on_the_count(artifact):
    def ask(count, seed):
        scene = scene_of([0, 1], [(2, 1, 0)])
        return generate(artifact, scene, count=count, seed=seed, steps=6)

    few, many, other = ask(3, 5), ask(19, 5), ask(3, 6)
    assert many[:3] == few
    assert len(many) == 19
    assert other != few
    # Neighbouring seeds share no random stream.
    assert other[:2] != many[1:3]


@every_model
def test_generation_stops_at_the_end_of_the_request(artifact):
    """The answer then has the first scenes of the complete answer."""
    scene = scene_of([0, 1], [(2, 1, 0)])
    complete = generate(artifact, scene, count=32, seed=5, steps=6)
    stop = iter([False] * 2 + [True] * 32).__next__
    part = generate(artifact, scene, count=32, seed=5, steps=6, stop=stop)
    assert 0 < len(part) < 32
    assert part == complete[: len(part)]
    assert generate(artifact, scene, count=32, seed=5, stop=lambda: True) == ()


def test_relations_observed_as_off_stay_off():
    """Of two boxes side by side, only left holds."""
    poses = derive_relations([[1, 0, 0], [1, 1, 0]], [[0.5, 0.5, 0.5]] * 2)
    scene = Scene(scene_of([0, 1]).objects, ((0, 1, 0),), poses=poses)
    for name in ("triway-local", "triway-wide"):
        for drawn in generate(ARTIFACTS[name], scene, count=16, seed=1, steps=6):
            between = [r for r in drawn.relations if {r[0], r[2]} == {"bed", "lamp"}]
            assert between == [("lamp", "left", "bed")]


@every_model
def test_active_units_of_the_request_stay_active(artifact):
    """In each layer, the unit that is on in the fewest scenes of another request."""
    sizes = {"h1": artifact.spec.H1, "h2": artifact.spec.H2}
    free = [
        one.context._asdict() for one in generate(artifact, scene_of([]), count=16, seed=2, steps=5)
    ]
    assert set(free[0]) == {layer for layer, size in sizes.items() if size}
    rare = {}
    for layer in free[0]:
        on = [sum(unit in context[layer] for context in free) for unit in range(sizes[layer])]
        assert min(on) < 16
        rare[layer] = [on.index(min(on))]
    for drawn in generate(artifact, scene_of([]), count=16, seed=2, steps=5, context=rare):
        for layer, units in rare.items():
            assert set(units) <= set(getattr(drawn.context, layer))


# Few enough states to enumerate. Each variant, and one machine with a second layer.
DRAWN: dict[str, MachineSpec] = {
    "rbm": MachineSpec("rbm", V=3, A=1, H1=2, T=2, form="local"),
    "gbm": MachineSpec("gbm", V=3, A=1, H1=2, H2=2, T=2, form="local"),
    "triway-two-layers": MachineSpec("triway", V=3, A=1, H1=2, H2=2, K=2, T=2, form="local"),
    **{name: spec for name, spec in EXACT.items() if spec.form == "local"},
}


def with_joint(name):
    """An artifact, and the joint of its machine."""
    machine = random_machine(DRAWN[name], torch.float32, 1.3)
    return artifact_of(machine), enumerate_joint(copy.deepcopy(machine).double())


def share(joint, event, condition):
    """p(event | condition), of bool tensors over the states."""
    return float(joint.p[event & condition].sum() / joint.p[condition].sum())


def check_share(count, drawn, p):
    """Within five standard errors. By chance, this fails with a probability of 6e-7."""
    error = math.sqrt(p * (1 - p) / len(drawn))
    assert abs(count / len(drawn) - p) <= 5 * error + 1e-12


def label_sets(drawn):
    return [frozenset(LABELS.index(label) for label in scene.objects) for scene in drawn]


@pytest.mark.parametrize("name", DRAWN)
@pytest.mark.parametrize("evidence", [[], [0]])
def test_objects_have_the_distribution_of_the_model(name, evidence):
    """The frequency of every set of classes."""
    artifact, joint = with_joint(name)
    drawn = label_sets(generate(artifact, scene_of(evidence), count=512, seed=0, steps=40))
    condition = (joint.v[:, evidence] > 0).all(1)
    codes = (joint.v.long() << torch.arange(3)).sum(1)
    for code in range(8):
        classes = frozenset(i for i in range(3) if code >> i & 1)
        check_share(drawn.count(classes), drawn, share(joint, codes == code, condition))


def unit_of(joint, i, j):
    """The index of the unit of left(i, j), or None."""
    units = (joint.edges.subject[0] == i) & (joint.edges.object[0] == j)
    return int(units.nonzero()) if bool(units.any()) else None


@pytest.mark.parametrize("name", [name for name, spec in DRAWN.items() if not spec.G])
def test_relations_have_the_distribution_of_the_model(name):
    """The shares of scenes with left(bed, lamp), with the opposite, and with neither.

    If both are on, the likelier one given the context stays. The test leaves out machines whose
    relations imply each other. They have no joint, because the order of the draws counts.
    """
    artifact, joint = with_joint(name)
    edges = joint.machine.edges(torch.arange(3).expand(len(joint.v), -1))
    logits = joint.machine.relation_logits(edges, joint.v, joint.h1)
    on, logit = [], []
    for unit in (unit_of(joint, 0, 1), unit_of(joint, 1, 0)):
        absent = torch.zeros(len(joint.v), dtype=torch.bool)
        on.append(absent if unit is None else joint.r[:, unit] > 0)
        logit.append(absent.double() if unit is None else logits[:, unit])
    wins = logit[0] >= logit[1]
    forward, backward = on[0] & (~on[1] | wins), on[1] & (~on[0] | ~wins)
    drawn = [
        {r for r in scene.relations if r[1] == "left" and {r[0], r[2]} == {"bed", "lamp"}}
        for scene in generate(artifact, scene_of([0, 1]), count=512, seed=3, steps=40)
    ]
    both = (joint.v[:, :2] > 0).all(1)
    for relations, event in (
        ({("bed", "left", "lamp")}, forward),
        ({("lamp", "left", "bed")}, backward),
        (set(), ~forward & ~backward),
    ):
        check_share(drawn.count(relations), drawn, share(joint, event, both))


@pytest.mark.slow
def test_observed_relations_change_the_share_of_other_objects():
    """Two relations between two classes give a third class different shares."""
    artifact, joint = with_joint("triway-local")
    shares = []
    for i, j in ((0, 1), (1, 0)):
        scene = scene_of([0, 1], [(0, i, j)], complete=True)
        drawn = label_sets(generate(artifact, scene, count=2048, seed=1, steps=40))
        on, off = unit_of(joint, i, j), unit_of(joint, j, i)
        evidence = (joint.v[:, :2] > 0).all(1) & (joint.r[:, on] > 0) & (joint.r[:, off] == 0)
        shares.append(share(joint, joint.v[:, 2] > 0, evidence))
        check_share(sum(2 in classes for classes in drawn), drawn, shares[-1])
    assert abs(shares[0] - shares[1]) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAWN)
def test_a_higher_temperature_gives_more_varied_scenes(name):
    """At a high temperature, every set of three classes occurs. Near zero, only a few sets occur."""
    artifact, _ = with_joint(name)
    hot, cold = (
        set(label_sets(generate(artifact, scene_of([]), count=512, seed=1, **options)))
        for options in ({"steps": 10, "temperature": 1e6}, {"steps": 60, "temperature": 0.05})
    )
    assert len(cold) < len(hot) == 8


@pytest.mark.parametrize("name", EXACT)
def test_the_log_score_is_the_log_probability_up_to_a_constant(name):
    """Exact for one layer: log p(v, r) in the seed form, log p(v) + log p(r | v, h1) in the local."""
    machine = machine_of(exact_artifact(name).weights)
    joint = enumerate_joint(machine)
    spec = machine.spec
    edges = machine.edges(torch.arange(spec.V).expand(len(joint.v), -1))
    scores = log_score(machine, joint.v, joint.r, edges, joint.h1, None)

    def log_p(*blocks):
        states = torch.cat(blocks, 1)
        _, which = states.unique(dim=0, return_inverse=True)
        return torch.zeros(len(states)).double().scatter_add(0, which, joint.p)[which].log()

    expected = log_p(joint.v, joint.r) + joint.log_z
    if spec.form == "local":
        explained = log_p(joint.v, joint.r, joint.h1) - log_p(joint.v, joint.h1)
        expected = log_p(joint.v) + joint.log_z + explained
    # A machine without gates may relate absent objects. No answer has such states.
    possible = (joint.r <= edges.ends_present(joint.v)).all(1)
    torch.testing.assert_close(scores[possible], expected[possible])


def test_the_score_of_two_layers_is_a_lower_bound():
    """The entropy of the second layer's mean field makes it a lower bound."""
    machine = small_machine("triway-local-two-layers")
    joint = enumerate_joint(machine)
    edges = machine.edges(torch.arange(2).expand(len(joint.v), -1))
    scores = log_score(machine, joint.v, joint.r, edges, joint.h1, None)
    gate = machine.gate(edges, joint.v)
    logits = machine.relation_logits(edges, joint.v, joint.h1)
    known = torch.ones_like(joint.r, dtype=torch.bool)
    objects = scores - machine.relation_term(logits, gate, joint.r, known).sum(1)
    for v in joint.v.unique(dim=0):
        same = (joint.v == v).all(1)
        gap = joint.log_sum(same) - objects[same]
        assert bool((gap >= -1e-9).all())
        assert bool((gap < 0.5).all())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count"),
        ({"seed": -1}, "seed"),
        ({"steps": 0}, "steps"),
        ({"temperature": 0.0}, "temperature"),
        ({"temperature": math.nan}, "temperature"),
        ({"context": {"h3": [0]}}, "h3"),
        ({"context": {"h1": [6]}}, "unit 6"),
        ({"context": {"h1": [-1]}}, "unit -1"),
    ],
)
def test_bad_input_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        generate(ARTIFACTS["triway-local"], scene_of([0]), **({"seed": 0} | options))
