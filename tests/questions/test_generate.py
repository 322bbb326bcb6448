"""Drawn scenes: what they must contain, that seeds decide, and that the draws follow p."""

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

NAMES = tuple(name for name, spec in LARGER.items() if spec.form == "local")
ARTIFACTS = {name: larger_artifact(name) for name in NAMES}


@settings(max_examples=25)
@given(st.sampled_from(NAMES), scenes(minimum=0), st.integers(0, 2**63 - 1))
def test_scenes_hold_the_evidence_and_nothing_impossible(name, scene, seed):
    evidence = {thing.label for thing in scene.objects}
    stated = {
        (scene.objects[i].label, CANONICAL[a], scene.objects[j].label)
        for a, i, j in scene.relations or ()
    }
    for drawn in generate(ARTIFACTS[name], scene, count=9, seed=seed, steps=4):
        assert evidence <= set(drawn.objects)
        assert not (set(drawn.objects) - evidence) & STRUCTURE
        places = [LABELS.index(label) for label in drawn.objects]
        assert places == sorted(set(places))
        assert stated <= set(drawn.relations)
        assert len(set(drawn.relations)) == len(drawn.relations)
        for subject, relation, object_ in drawn.relations:
            assert {subject, object_} <= set(drawn.objects)
            assert relation in CANONICAL
        free = [
            (CANONICAL.index(a), i, j) for i, a, j in drawn.relations if (i, a, j) not in stated
        ]
        assert contradiction(free) is None
        assert all(i != j and not {i, j} & STRUCTURE for _, i, j in free)
        assert not {(i, CANONICAL[a], j) for a, j, i in free} & stated
        assert math.isfinite(drawn.log_score)


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_decides_and_the_count_does_not(name):
    artifact, scene = ARTIFACTS[name], scene_of([0, 1], [(2, 1, 0)])
    few = generate(artifact, scene, count=3, seed=5, steps=6)
    many = generate(artifact, scene, count=19, seed=5, steps=6)
    assert many[:3] == few
    assert len(many) == 19
    assert generate(artifact, scene, count=3, seed=5, steps=6) == few
    assert generate(artifact, scene, count=3, seed=6, steps=6) != few
    # Neighbouring seeds share no stream.
    assert generate(artifact, scene, count=3, seed=6, steps=6)[:2] != many[1:3]


@pytest.mark.parametrize("name", NAMES)
def test_drawing_stops_when_told_to(name):
    """Nobody waits any more: what was drawn so far is as it would have been."""
    artifact, scene = ARTIFACTS[name], scene_of([0, 1], [(2, 1, 0)])
    whole = generate(artifact, scene, count=32, seed=5, steps=6)
    asked = 0

    def stop():
        nonlocal asked
        asked += 1
        return asked > 2

    part = generate(artifact, scene, count=32, seed=5, steps=6, stop=stop)
    assert 0 < len(part) < 32
    assert part == whole[: len(part)]
    assert generate(artifact, scene, count=32, seed=5, stop=lambda: True) == ()


def test_relations_observed_as_off_stay_off():
    """Two boxes a metre apart, side by side: nothing but left holds of them."""
    plain = scene_of([0, 1])
    poses = derive_relations([[1, 0, 0], [1, 1, 0]], [[0.5, 0.5, 0.5]] * 2)
    scene = Scene(plain.objects, ((0, 1, 0),), poses=poses)
    for name in ("triway-local", "triway-wide"):
        for drawn in generate(ARTIFACTS[name], scene, count=16, seed=1, steps=6):
            between = [r for r in drawn.relations if {r[0], r[2]} == {"bed", "lamp"}]
            assert between == [("lamp", "left", "bed")]


@pytest.mark.parametrize("name", NAMES)
def test_held_context_units_stay_on(name):
    """Of every layer the unit that is on in the fewest scenes when nothing is held."""
    artifact = ARTIFACTS[name]
    sizes = {"h1": artifact.spec.H1, "h2": artifact.spec.H2}
    free = generate(artifact, scene_of([]), count=16, seed=2, steps=5)
    assert set(free[0].context) == {layer for layer, size in sizes.items() if size}
    rare = {}
    for layer in free[0].context:
        on = [sum(unit in drawn.context[layer] for drawn in free) for unit in range(sizes[layer])]
        assert min(on) < 16
        rare[layer] = [on.index(min(on))]
    for drawn in generate(artifact, scene_of([]), count=16, seed=2, steps=5, context=rare):
        for layer, units in rare.items():
            assert set(units) <= set(drawn.context[layer])


# Few enough states to enumerate, of every variant, one of them with a second layer.
DRAWN: dict[str, MachineSpec] = {
    "rbm": MachineSpec("rbm", V=3, A=1, H1=2, T=2, form="local"),
    "gbm": MachineSpec("gbm", V=3, A=1, H1=2, H2=2, T=2, form="local"),
    "triway-two-layers": MachineSpec("triway", V=3, A=1, H1=2, H2=2, K=2, T=2, form="local"),
    **{name: spec for name, spec in EXACT.items() if spec.form == "local"},
}


def drawable(name):
    """An artifact, and the joint of its machine."""
    machine = random_machine(DRAWN[name], torch.float32, 1.3)
    return artifact_of(machine), enumerate_joint(copy.deepcopy(machine).double())


def label_sets(answers):
    return [frozenset(LABELS.index(label) for label in drawn.objects) for drawn in answers]


@pytest.mark.parametrize("name", DRAWN)
@pytest.mark.parametrize("given_classes", [[], [0]])
def test_objects_are_drawn_from_the_model(name, given_classes):
    """Frequencies of every set of classes within five standard errors of the joint, over 512
    chains; each of at most 8 sets fails by chance with probability 6e-7."""
    artifact, joint = drawable(name)
    where = (joint.v[:, given_classes] > 0).all(1)
    p = torch.where(where, joint.p, 0.0)
    p = p / p.sum()
    drawn = label_sets(generate(artifact, scene_of(given_classes), count=512, seed=0, steps=40))
    codes = (joint.v.long() << torch.arange(3)).sum(1)
    for code in range(8):
        classes = frozenset(i for i in range(3) if code >> i & 1)
        expected = float(p[codes == code].sum())
        error = math.sqrt(expected * (1 - expected) / len(drawn))
        frequency = sum(one == classes for one in drawn) / len(drawn)
        assert abs(frequency - expected) <= 5 * error + 1e-12


@pytest.mark.parametrize("name", [name for name, spec in DRAWN.items() if not spec.G])
def test_relations_are_drawn_from_the_model(name):
    """Shares of scenes with left(bed, lamp), with the opposite, and with neither, within five
    standard errors of the joint; of both the likelier given the context is left.

    Relations that imply each other have no joint: the order in which they are drawn counts.
    """
    artifact, joint = drawable(name)
    e = joint.edges
    logits = joint.machine.relation_logits(machine_rows(joint), joint.v, joint.h1)
    on, logit = [], []
    for i, j in ((0, 1), (1, 0)):
        match = (e.relation[0] == 0) & (e.subject[0] == i) & (e.object[0] == j)
        unit = match.nonzero().flatten().tolist()
        absent = torch.zeros(len(joint.v), dtype=torch.bool)
        on.append(joint.r[:, unit[0]] > 0 if unit else absent)
        logit.append(logits[:, unit[0]] if unit else absent.double())
    both = (joint.v[:, :2] > 0).all(1)
    wins = logit[0] >= logit[1]
    forward = on[0] & (~on[1] | wins)
    backward = on[1] & (~on[0] | ~wins)
    drawn = generate(artifact, scene_of([0, 1]), count=512, seed=3, steps=40)
    found = [
        {r for r in scene.relations if r[1] == "left" and {r[0], r[2]} == {"bed", "lamp"}}
        for scene in drawn
    ]
    for outcome, where in (
        ({("bed", "left", "lamp")}, forward),
        ({("lamp", "left", "bed")}, backward),
        (set(), ~forward & ~backward),
    ):
        expected = float(joint.p[both & where].sum() / joint.p[both].sum())
        error = math.sqrt(expected * (1 - expected) / len(drawn))
        assert abs(found.count(outcome) / len(drawn) - expected) <= 5 * error + 1e-12


def machine_rows(joint):
    """The relation units of all classes, one row a state."""
    return joint.machine.edges(torch.arange(3).expand(len(joint.v), -1))


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAWN)
def test_a_hot_chain_wanders_and_a_cold_one_settles(name):
    """At a high temperature every set of three classes is as likely as any other; near zero the
    chains end in few of them."""
    artifact, _ = drawable(name)
    hot = label_sets(generate(artifact, scene_of([]), count=512, seed=1, steps=10, temperature=1e6))
    cold = label_sets(
        generate(artifact, scene_of([]), count=512, seed=1, steps=60, temperature=0.05)
    )
    assert len(set(cold)) < len(set(hot)) == 8


@pytest.mark.parametrize("name", EXACT)
def test_the_log_score_is_the_log_probability_up_to_a_constant(name):
    """One layer, so exact: seed form against log p(v, r), local form against log p(v) and
    log p(r | v, h1)."""
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
    # An ungated machine may relate absent objects; such states are never returned.
    possible = (joint.r <= edges.ends_present(joint.v)).all(1)
    torch.testing.assert_close(scores[possible], expected[possible])


def test_two_layers_score_below_their_sum():
    """The entropy makes the second layer's mean field a lower bound."""
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
