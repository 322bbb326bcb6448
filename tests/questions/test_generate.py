"""Generated scenes: the evidence, the distribution of the model, and implausible scenes."""

import copy
import math
from dataclasses import replace
from functools import cache
from graphlib import CycleError, TopologicalSorter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from app.inference.weights import pack_scenes
from app.questions.generate import staying
from app.scene import CANONICAL
from app.scene.spatial_relations import ABOVE, FRONT, LEFT, ON_TOP
from tests.enumeration.small_machines import enumerate_joint, with_mean_rates
from tests.questions.answers import generate, outliers
from tests.questions.artifacts import (
    DOUBTING,
    EXACT,
    LABELS,
    LARGER,
    STRUCTURE,
    artifact_of,
    larger_artifact,
    lines,
    random_machine,
    scene_of,
)
from tests.questions.test_properties import scenes

NAMES = tuple(LARGER)
ARTIFACTS = {name: larger_artifact(name, outlier=DOUBTING) for name in NAMES}
every_model = pytest.mark.parametrize("artifact", ARTIFACTS.values(), ids=NAMES)


@settings(max_examples=25)
@given(st.sampled_from(NAMES), scenes(minimum=0), st.integers(0, 2**63 - 1))
def test_scenes_contain_the_evidence_and_no_contradiction(name, scene, seed):
    evidence = {thing.label for thing in scene.objects}
    labels = [thing.label for thing in scene.objects]
    stated = {(labels[i], CANONICAL[a], labels[j]) for a, i, j in scene.triples}
    pairs = [{subject, object_} for subject, _, object_ in stated]
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
                assert {subject, object_} not in pairs
                free.append((CANONICAL.index(relation), subject, object_))
        assert not {(a, j, i) for a, i, j in free}.intersection(free)
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


@cache
def with_joint(name, room=None, profile=None, evidence=()):
    """An artifact, and its joint; without a profile, with the mean rates given the evidence."""
    machine = random_machine(EXACT[name], 1.3)
    double, source = copy.deepcopy(machine).double(), profile
    if source is None:
        double, source = with_mean_rates(machine, evidence), -1
    return artifact_of(machine), enumerate_joint(double, room, source=source)


def share(joint, event, condition):
    """p(event | condition), of bool tensors over the states."""
    return float(joint.p[event & condition].sum() / joint.p[condition].sum())


def check_share(count, drawn, p):
    """Within five standard errors. By chance, this fails with a probability of 6e-7."""
    error = math.sqrt(p * (1 - p) / len(drawn))
    assert abs(count / len(drawn) - p) <= 5 * error + 1e-12


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("evidence", [[], [0]])
@pytest.mark.parametrize("clamped", [False, True])
def test_objects_have_the_distribution_of_the_model(name, evidence, clamped):
    """The frequency of every set of classes; also under a room type and a profile."""
    spec = EXACT[name]
    room = 1 if clamped and spec.C else None
    profile = 1 if clamped and spec.profiles else None
    # The mean base rates depend on the evidence only if the machine has data sources.
    artifact, joint = with_joint(name, room, profile, tuple(evidence) if spec.profiles else ())
    scene = scene_of(evidence, room=room, profile=profile)
    scenes = generate(artifact, scene, count=512, seed=0, steps=40)
    drawn = [frozenset(map(LABELS.index, one.objects)) for one in scenes]
    condition = (joint.v[:, evidence] > 0).all(1)
    codes = (joint.v.long() << torch.arange(3)).sum(1)
    for code in range(8):
        classes = frozenset(i for i in range(3) if code >> i & 1)
        check_share(drawn.count(classes), drawn, share(joint, codes == code, condition))


# Alarm lines at which every object is an intruder, none is, and some are.
ALL, NONE, SOME = (lines(z, z, z) for z in (-1e3, 1e3, 0.0))


def draw(name, scene, **calibration):
    artifact = larger_artifact(name, outlier=DOUBTING, **calibration)
    return generate(artifact, scene, count=24, seed=3, steps=4)


@pytest.mark.parametrize("name", NAMES)
def test_too_small_scenes_are_drawn_again(name):
    """The last attempt is accepted, so some scenes may still be small."""
    free = sorted(len(scene.objects) for scene in draw(name, scene_of([])))
    # About half of the scenes are smaller.
    least = free[12] if free[12] > free[0] else free[-1]
    scenes = draw(name, scene_of([]), smallest=(least,) * (LARGER[name].C + 1))
    assert sum(size < least for size in free) > sum(len(one.objects) < least for one in scenes)


@pytest.mark.parametrize("name", NAMES)
def test_the_last_attempt_is_accepted(name):
    scenes = draw(name, scene_of([0]), outlier_lines=ALL)
    assert len(scenes) == 24
    assert all("bed" in scene.objects for scene in scenes)
    assert scenes == draw(name, scene_of([0]), outlier_lines=ALL)
    assert scenes != draw(name, scene_of([0]), outlier_lines=NONE)


def test_scenes_with_intruders_are_drawn_again():
    plain, counts = ARTIFACTS["triway"], []
    for limits in (NONE, SOME):
        scenes = draw("triway", scene_of([]), outlier_lines=limits)
        judged = [outliers(plain, scene_of(list(map(LABELS.index, one.objects)))) for one in scenes]
        counts.append(sum(entry.probability > 0.5 for one in judged for entry in one.outliers))
    assert counts[1] < counts[0]


@pytest.mark.parametrize("rare", [(), (0,)])
def test_a_scene_has_the_room_type_of_its_start_but_rarely_a_rare_one(rare):
    """Half of the stored scenes are of each type. A rare type starts e^-6 times as often."""
    machine = random_machine(replace(LARGER["triway-states"], N=64), 0.7)
    machine.fantasies.copy_(torch.from_numpy(pack_scenes(np.eye(9, dtype=np.uint8)[[0, 1] * 32])))
    machine.fantasy_rooms.copy_(torch.arange(64) % 2)
    artifact = artifact_of(machine, rare_rooms=rare)
    drawn = generate(artifact, scene_of([]), count=40, seed=4, steps=1)
    types = [scene.room_type for scene in drawn]
    assert types.count("bedroom") == 0 if rare else 5 < types.count("bedroom") < 35
    (asked,) = generate(artifact, scene_of([], room=0), seed=4, steps=1)
    assert asked.room_type == "bedroom"


V = 6
CLASSES = st.integers(0, V - 1)
TRIPLES = st.tuples(st.sampled_from([ON_TOP, ABOVE, LEFT, FRONT]), CLASSES, CLASSES)
LOGITS = st.dictionaries(TRIPLES, st.sampled_from([-1.0, 0.0, 0.5, 2.0]), max_size=24)


def is_possible(triples):
    """One relation per pair, one support per class, and no cycle in any direction."""
    pairs = [frozenset((i, j)) for _, i, j in triples]
    if len(set(pairs)) < len(pairs) or any(len(pair) == 1 for pair in pairs):
        return False
    supported = [i for a, i, _ in triples if a == ON_TOP]
    if len(set(supported)) < len(supported):
        return False
    try:
        for direction in ({ON_TOP, ABOVE}, {LEFT}, {FRONT}):
            graph = {}
            for a, i, j in triples:
                if a in direction:
                    graph.setdefault(i, set()).add(j)
            TopologicalSorter(graph).prepare()
    except CycleError:
        return False
    return True


def kept(drawn):
    units = np.array(list(drawn), dtype=np.int64).reshape(-1, 3)
    logits = np.array(list(drawn.values()), dtype=np.float32)
    stay = staying(units, logits, frozenset(), np.zeros(V, bool))
    return {triple for triple, stays in zip(drawn, stay.tolist(), strict=True) if stays}


@given(LOGITS)
def test_kept_relations_are_possible_and_removed_relations_contradict_likelier_ones(drawn):
    stay = kept(drawn)
    assert is_possible(stay)
    for triple in drawn.keys() - stay:
        likelier = {other for other in stay if drawn[other] >= drawn[triple]}
        assert not is_possible(likelier | {triple})
