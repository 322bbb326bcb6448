"""What decides that an object does not belong, and what supports the verdict."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.registry.description import CountSlope, Thresholds
from tests.questions.answers import misplaced, outliers
from tests.questions.artifacts import LABELS, STRUCTURE, larger_artifact, scene_of
from training.machines.arrays import machine_of

LINE = CountSlope(intercept=0.2, slope=-0.8, log_count=0.1)
PRESETS = Thresholds(low=0.9, medium=0.6, high=0.3)
VARIANTS = ["rbm", "gbm", "triway-local"]
POPULARITY = tuple(np.linspace(-3, 2, len(LABELS)).tolist())


def test_popularity_counts_by_its_weight():
    for alpha in (0.0, 0.5, 1.0):
        artifact = larger_artifact(
            "triway-local", outlier=LINE, popularity=POPULARITY, popularity_weight=alpha
        )
        found = outliers(artifact, scene_of([0, 1, 1, 2])).outliers
        for answer in found:
            z = answer.log_odds - alpha * POPULARITY[LABELS.index(answer.label)]
            expected = 0.2 - 0.8 * z + 0.1 * math.log(3)
            assert answer.probability == pytest.approx(1 / (1 + math.exp(-expected)), abs=1e-6)
        probabilities = [answer.probability for answer in found]
        assert probabilities == sorted(probabilities, reverse=True)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_higher_sensitivity_raises_every_alarm_of_a_lower_one(name):
    artifact = larger_artifact(
        name, outlier=LINE, outlier_thresholds=PRESETS, misplaced_thresholds=PRESETS
    )
    scene = scene_of([0, 1, 2, 3], [(2, 1, 0), (0, 1, 2), (1, 3, 0)])
    alarms = []
    for level, threshold in (("low", 0.9), ("medium", 0.6), ("high", 0.3)):
        found = outliers(artifact, scene, sensitivity=level)
        assert found.threshold == threshold
        assert all(one.is_outlier == (one.probability >= threshold) for one in found.outliers)
        assert all(one.is_misplaced == (one.probability >= threshold) for one in found.misplaced)
        assert found.misplaced == misplaced(artifact, scene, sensitivity=level)
        alarms.append({one.object for one in found.outliers if one.is_outlier})
    assert alarms[0] <= alarms[1] <= alarms[2]
    assert outliers(artifact, scene) == outliers(artifact, scene, sensitivity="medium")


def test_a_list_of_few_classes_has_a_threshold_of_its_own():
    """By its distinct classes without structure; the request's own threshold still wins."""
    short = tuple(Thresholds(low=p, medium=p - 0.01, high=p - 0.02) for p in (0.99, 0.95))
    artifact = larger_artifact(
        "triway-local", outlier_thresholds=PRESETS, short_list_thresholds=short
    )
    wall = LABELS.index("wall")
    for listed, high, medium in (
        ([0], 0.97, 0.98),
        ([0, 0, wall], 0.97, 0.98),
        ([0, 1, 1], 0.93, 0.94),
        ([0, 1, 2], 0.3, 0.6),
        ([wall], 0.3, 0.6),
    ):
        scene = scene_of(listed)
        assert outliers(artifact, scene).threshold == pytest.approx(medium)
        assert outliers(artifact, scene, sensitivity="high").threshold == pytest.approx(high)
        assert outliers(artifact, scene, threshold=0.5).threshold == 0.5


def test_a_threshold_replaces_that_of_objects_only():
    artifact = larger_artifact(
        "triway-local", outlier_thresholds=PRESETS, misplaced_thresholds=PRESETS
    )
    scene = scene_of([0, 1, 2], [(2, 1, 0), (0, 1, 2)])
    strict = outliers(artifact, scene, threshold=1.0)
    assert strict.threshold == 1.0
    assert strict.misplaced == outliers(artifact, scene).misplaced


@pytest.mark.parametrize("name", VARIANTS)
def test_companions_would_make_an_outlier_likely(name):
    """Each named class, alone with the outlier, raises the log-odds of a context without others."""
    artifact = larger_artifact(name)
    W, c1 = machine_of(artifact.weights).W.double(), machine_of(artifact.weights).c1.double()
    scene = scene_of([0, 1, 2])
    found = outliers(artifact, scene, threshold=0.0).outliers
    assert any(answer.usually_with for answer in found)
    for answer in found:
        i = LABELS.index(answer.label)
        assert not set(answer.usually_with) & {*STRUCTURE, *LABELS[:3]}
        increases = {
            label: float(_gain(c1 + W[j], W[i]) - _gain(c1, W[i])) for j, label in enumerate(LABELS)
        }
        largest = max(increases[label] for label in LABELS[3:] if label not in STRUCTURE)
        assert all(increases[label] >= 0.5 * largest - 1e-4 for label in answer.usually_with)
        assert bool(answer.usually_with) == (largest > 1e-6)


def _gain(x, weights):
    return (x + weights).exp().log1p().sum() - x.exp().log1p().sum()
