"""Calibration: the right answers are collected, with the right truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.reasoning import missing, relations
from tests.reasoning.artifacts import LARGER, artifact_of
from tests.training.evaluation.scenes import random_scenes, tensors
from tests.training.evaluation.test_completion import larger_machine
from training.cases import scene_of
from training.evaluation.answers import QUESTIONS, collect, uncalibrated

ARTIFACT = artifact_of(larger_machine("triway-local"))
V = LARGER["triway-local"].V
DATA = tensors(random_scenes(30, V - 1), V)


@pytest.mark.parametrize("question", QUESTIONS)
def test_every_question_is_asked_and_some_answers_are_true(question):
    found = collect(ARTIFACT, DATA, QUESTIONS[question])
    assert found.scenes == 30
    assert 0 < found.truth.sum() < len(found.truth)
    assert found.probability.min() >= 0
    assert found.probability.max() <= 1
    assert np.isfinite(found.ece().value)
    assert found.brier_skill().value <= 1


def test_relations_are_compared_with_what_was_listed():
    found = collect(ARTIFACT, DATA, QUESTIONS["relations"])
    entry = DATA.scenes[4]
    scene = replace(scene_of(entry, range(len(entry.instance_classes)), ()), room_type=None)
    answers, _ = relations(ARTIFACT, scene)
    names = ("left", "front", "on-top", "above")
    listed = [
        bool(entry.instance_holds[names.index(a.relation), a.subject, a.object]) for a in answers
    ]
    ours = found.scene == 4
    assert found.probability[ours].tolist() == [answer.probability for answer in answers]
    assert found.truth[ours].tolist() == listed


def test_what_was_taken_away_is_true_at_most_once_a_scene():
    for question in ("missing", "missing at a place"):
        found = collect(ARTIFACT, DATA, QUESTIONS[question])
        assert np.bincount(found.scene, weights=found.truth).max() == 1
    # All absent classes are answered here, so what was taken away is always among them.
    found = collect(ARTIFACT, DATA, QUESTIONS["missing"])
    assert np.bincount(found.scene, weights=found.truth).tolist() == [1.0] * 30
    assert np.bincount(found.scene, weights=found.probability) == pytest.approx(np.ones(30))


def test_half_of_the_scenes_have_an_intruder():
    """Of 30 fair draws fewer than 5 or more than 25 happen with probability below 1e-4."""
    found = collect(ARTIFACT, DATA, QUESTIONS["outliers"])
    intruders = np.bincount(found.scene, weights=found.truth, minlength=30)
    assert set(intruders.tolist()) == {0.0, 1.0}
    assert 5 <= intruders.sum() <= 25


def test_the_uncalibrated_model_answers_with_its_log_odds():
    plain = uncalibrated(ARTIFACT)
    scene = replace(scene_of(DATA.scenes[0], range(2), ()), room_type=None)
    odds = np.array([answer.log_odds for answer in missing(plain, scene)])
    p = np.array([answer.probability for answer in missing(plain, scene)])
    assert p == pytest.approx(np.exp(odds) / np.exp(odds).sum(), rel=1e-4)
