from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.questions.answers import generate
from tests.questions.artifacts import LABELS, larger_artifact, scene_of
from tests.training.evaluation.scenes import scene, tensors, values_of
from training.evaluation import generation_task as task
from training.evaluation.generation_task import generated_rooms_task
from training.evaluation.setting import Setting

V = len(LABELS)
STRUCTURE = torch.arange(V) == V - 1


def metrics_of(artifact, scenes):
    outcome = generated_rooms_task(artifact, Setting(tensors(scenes, V), STRUCTURE))
    return values_of(outcome), outcome


def test_refused_rooms_are_those_below_the_limits():
    """4 of 16 bedrooms have fewer than two things; all 12 offices have enough."""
    artifact = larger_artifact("triway", smallest=(2, 1, 0))
    small, large = scene([0, V - 1], room=0), scene([0, 1, 2], room=0)
    office, bare = scene([2], room=1), scene([V - 1], room=0)
    scenes = [small] * 4 + [large] * 12 + [office] * 12 + [bare] + [scene([0, 1])] * 5
    found, outcome = metrics_of(artifact, scenes)
    assert found["refused"] == pytest.approx(4 / 28)
    assert found["refused, bedroom"] == pytest.approx(1 / 4)
    assert found["refused, office"] == 0
    assert (outcome.scenes, outcome.skipped) == (34, 6)
    few, _ = metrics_of(artifact, [small] * 9 + [office] * 12)
    assert "refused, bedroom" not in few


def test_sizes_are_those_of_the_answers_of_the_service(monkeypatch):
    """The same seed gives the same scenes. Structure and rooms in camera frames do not count."""
    monkeypatch.setattr(task, "_DRAWS", 16)
    artifact = larger_artifact("triway", smallest=(3, 0, 0))
    whole = [scene([0, 1, 2, V - 1], room=0)] * 10 + [scene([0, 1, 2, 3, 4], room=0)] * 10
    frames = [replace(one, source="sunrgbd") for one in [scene([0], room=1)] * 20]
    found, _ = metrics_of(artifact, whole + frames)
    drawn = generate(artifact, scene_of([], room=0), count=16, seed=0)
    expected = np.mean([len(one.objects) for one in drawn]) / 4 - 1
    assert found["change of the number of classes, bedroom"] == pytest.approx(expected)
    assert "change of the number of classes, free" in found
    assert "change of the number of classes, office" not in found
    assert "refused, office" in found
