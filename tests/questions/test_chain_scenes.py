"""Scenes from compiled chains: reproducible, with the correct score, and in parallel threads."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from app.scene import CANONICAL
from tests.questions.answers import generate
from tests.questions.artifacts import LABELS, larger_artifact, scene_of
from tests.questions.log_score import log_score
from training.machines.arrays import machine_of
from training.machines.edges import present_classes

SCENES = {
    "empty": (scene_of([]), {}),
    "classes": (scene_of([0, 1, 4]), {}),
    "relations": (scene_of([0, 1, 4], [(2, 1, 0), (0, 2, 1)]), {}),
    "complete": (scene_of([0, 1, 1], [(2, 1, 0), (0, 1, 2)], complete=True), {"temperature": 1.5}),
    "context": (scene_of([2], room=1), {"context": {"h1": [3, 50]}}),
}


@pytest.fixture(scope="module")
def artifact():
    return larger_artifact("triway-wide", scale=0.3)


def test_scenes_do_not_depend_on_other_requests(artifact):
    """Neither on earlier requests nor on requests in other threads."""

    def ask(name):
        scene, options = SCENES[name]
        return generate(artifact, scene, count=3, seed=5, steps=6, **options)

    answers = {name: ask(name) for name in SCENES}
    assert {name: ask(name) for name in reversed(SCENES)} == answers
    with ThreadPoolExecutor(4) as pool:
        for name, scenes in zip([*SCENES] * 3, pool.map(ask, [*SCENES] * 3), strict=True):
            assert scenes == answers[name]


@pytest.mark.parametrize("name", SCENES)
def test_the_score_is_that_of_the_definition(artifact, name):
    scene, options = SCENES[name]
    machine = machine_of(artifact.weights)
    for drawn in generate(artifact, scene, count=4, seed=2, steps=5, **options):
        v, h1 = torch.zeros(1, machine.spec.V), torch.zeros(1, machine.spec.H1)
        v[0, [LABELS.index(label) for label in drawn.objects]] = 1
        h1[0, drawn.context.h1] = 1
        classes = present_classes(v)
        row = {LABELS[c]: k for k, c in enumerate(classes[0].tolist())}
        r = torch.zeros(machine.spec.A, len(row), len(row))
        for i, a, j in drawn.relations:
            r[CANONICAL.index(a), row[i], row[j]] = 1
        room = None if scene.room_type is None else torch.tensor([scene.room_type])
        expected = log_score(machine, v, r.view(1, -1), machine.edges(classes), h1, room)
        assert drawn.log_score == pytest.approx(float(expected), rel=1e-4, abs=1e-3)


def test_every_scene_contains_an_object_of_low_confidence(artifact):
    scene = scene_of([0, 3])
    objects = tuple(replace(thing, confidence=0.05) for thing in scene.objects)
    unsure = replace(scene, objects=objects)
    assert generate(artifact, unsure, count=4, seed=1) == generate(artifact, scene, count=4, seed=1)


def test_other_threads_run_while_a_chain_runs(artifact):
    """A thread runs a chain of many sweeps. Meanwhile, this thread wakes up again and again."""

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
