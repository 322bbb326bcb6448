"""Scenes from compiled chains: the same bytes wherever and beside whatever they are drawn, from
the model, and without holding the interpreter's lock."""

from __future__ import annotations

import copy
import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from app.scene import CANONICAL
from tests.enumeration.small_machines import enumerate_joint
from tests.questions.answers import generate
from tests.questions.artifacts import LABELS, artifact_of, exact_artifact, larger_artifact, scene_of
from tests.questions.log_score import log_score
from training.machines.arrays import machine_of
from training.machines.edges import present_classes

SCENES = {
    "nothing": (scene_of([]), {}),
    "classes": (scene_of([0, 1, 4]), {}),
    "relations": (scene_of([0, 1, 4], [(2, 1, 0), (0, 2, 1)]), {}),
    "complete": (scene_of([0, 1, 1], [(2, 1, 0), (0, 1, 2)], complete=True), {"temperature": 1.5}),
    "context": (scene_of([2], room=1), {"context": {"h1": [3, 50]}}),
}


@pytest.fixture(scope="module")
def artifact():
    made = larger_artifact("triway-wide", scale=0.3)
    assert made.scene_chains is not None
    return made


def single(name):
    """An exact artifact in float32, which has compiled chains, and its joint."""
    made = artifact_of(machine_of(exact_artifact(name).weights).float())
    assert made.scene_chains is not None
    return made, enumerate_joint(copy.deepcopy(machine_of(made.weights)).double())


@pytest.mark.slow
def test_stated_relations_tell_of_the_objects():
    """Of four units seen between two classes: how often the third class is there, within five
    standard errors of the joint, over 2,048 chains; other relations make for another share."""
    artifact, joint = single("triway-local")
    e = joint.edges

    def share(seen):
        where = (joint.v[:, :2] > 0).all(1)
        for i, j, on in seen:
            unit = (e.subject[0] == i) & (e.object[0] == j)
            where &= (joint.r[:, int(unit.nonzero()[0])] > 0) == on
        p = torch.where(where, joint.p, 0.0)
        return float(p[joint.v[:, 2] > 0].sum() / p.sum())

    shares = []
    for relations in ([(0, 0, 1)], [(0, 1, 0)]):
        scene = scene_of([0, 1], relations, complete=True)
        drawn = generate(artifact, scene, count=2048, seed=1, steps=40)
        frequency = sum(LABELS[2] in one.objects for one in drawn) / len(drawn)
        _, i, j = relations[0]
        expected = share([(i, j, True), (j, i, False)])
        assert abs(frequency - expected) <= 5 * math.sqrt(expected * (1 - expected) / 2048)
        shares.append(expected)
    assert abs(shares[0] - shares[1]) > 0.05


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_the_same_in_any_company(artifact, name):
    """Alone, after others, beside others in threads, and as part of a longer answer."""
    scene, options = SCENES[name]
    alone = generate(artifact, scene, count=3, seed=5, steps=6, **options)
    for other, more in SCENES.values():
        generate(artifact, other, count=2, seed=8, steps=3, **more)
    assert generate(artifact, scene, count=3, seed=5, steps=6, **options) == alone
    assert generate(artifact, scene, count=9, seed=5, steps=6, **options)[:3] == alone
    asked = [*SCENES.values()] * 3

    def ask(entry):
        return generate(artifact, entry[0], count=3, seed=5, steps=6, **entry[1])

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(ask, asked))
    assert all(
        answer == alone for entry, answer in zip(asked, answers, strict=True) if entry[0] is scene
    )


@pytest.mark.parametrize("name", SCENES)
def test_the_score_is_that_of_the_tensors(artifact, name):
    scene, options = SCENES[name]
    machine = machine_of(artifact.weights)
    for drawn in generate(artifact, scene, count=4, seed=2, steps=5, **options):
        v, h1 = torch.zeros(1, machine.spec.V), torch.zeros(1, machine.spec.H1)
        v[0, [LABELS.index(label) for label in drawn.objects]] = 1
        h1[0, list(drawn.context["h1"])] = 1
        classes = present_classes(v)
        edges, place = machine.edges(classes), {c: k for k, c in enumerate(classes[0].tolist())}
        r = torch.zeros(machine.spec.A, len(place), len(place))
        for i, a, j in drawn.relations:
            r[CANONICAL.index(a), place[LABELS.index(i)], place[LABELS.index(j)]] = 1
        room = None if scene.room_type is None else torch.tensor([scene.room_type])
        expected = log_score(machine, v, r.view(1, -1), edges, h1, room)
        assert drawn.log_score == pytest.approx(float(expected), rel=1e-4, abs=1e-3)


def test_confidence_leaves_an_object_in_every_scene(artifact):
    """As a clamp, presence is not soft."""
    scene = scene_of([0, 3])
    unsure = replace(
        scene, objects=tuple(replace(thing, confidence=0.05) for thing in scene.objects)
    )
    assert generate(artifact, unsure, count=4, seed=1) == generate(artifact, scene, count=4, seed=1)


def test_other_threads_go_on_while_a_chain_runs(artifact):
    """A chain of many sweeps in a thread; meanwhile this one wakes up again and again."""

    def draw(steps):
        generate(artifact, scene_of([]), count=1, seed=0, steps=steps)

    draw(1)
    begin = time.perf_counter()
    draw(20_000)
    sweeps = int(20_000 / (time.perf_counter() - begin))  # about a second
    thread = threading.Thread(target=draw, args=(sweeps,))
    thread.start()
    turns = 0
    while thread.is_alive():
        time.sleep(0.005)
        turns += thread.is_alive()
    thread.join()
    assert turns > 5
