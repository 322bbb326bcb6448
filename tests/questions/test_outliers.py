"""The probability of an outlier, the thresholds, and the companions of an outlier."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.registry.description import CountSlope, Thresholds
from tests.questions.answers import misplaced, outliers
from tests.questions.artifacts import LABELS, STRUCTURE, larger_artifact, scene_of
from training.machines.arrays import machine_of

LINE = CountSlope(intercept=0.2, slope=-0.8, log_count=0.1)
LEVELS = {"low": 0.9, "medium": 0.6, "high": 0.3}
PRESETS = Thresholds(**LEVELS)
VARIANTS = ["rbm", "gbm", "triway-local"]


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_the_popularity_of_a_class_counts_by_its_weight(alpha):
    popularity = tuple(np.linspace(-3, 2, len(LABELS)).tolist())
    artifact = larger_artifact(
        "triway-local", outlier=LINE, popularity=popularity, popularity_weight=alpha
    )
    entries = outliers(artifact, scene_of([0, 1, 1, 2])).outliers
    for entry in entries:
        z = entry.log_odds - alpha * popularity[LABELS.index(entry.label)]
        logit = 0.2 - 0.8 * z + 0.1 * math.log(3)
        assert entry.probability == pytest.approx(1 / (1 + math.exp(-logit)), rel=1e-5)
    probabilities = [entry.probability for entry in entries]
    assert probabilities == sorted(probabilities, reverse=True)


@pytest.mark.parametrize("name", VARIANTS)
def test_the_sensitivity_selects_the_thresholds(name):
    """The threshold of a request replaces that of objects only."""
    artifact = larger_artifact(
        name, outlier=LINE, outlier_thresholds=PRESETS, misplaced_thresholds=PRESETS
    )
    scene = scene_of([0, 1, 2, 3], [(2, 1, 0), (0, 1, 2), (1, 3, 0)])
    for level, threshold in LEVELS.items():
        answer = outliers(artifact, scene, sensitivity=level)
        assert answer.threshold == threshold
        assert all(one.is_outlier == (one.probability >= threshold) for one in answer.outliers)
        assert all(one.is_misplaced == (one.probability >= threshold) for one in answer.misplaced)
        assert answer.misplaced == misplaced(artifact, scene, sensitivity=level)
        own = outliers(artifact, scene, sensitivity=level, threshold=0.5)
        assert (own.threshold, own.misplaced) == (0.5, answer.misplaced)
        assert {one.is_outlier == (one.probability >= 0.5) for one in own.outliers} == {True}
    assert outliers(artifact, scene) == outliers(artifact, scene, sensitivity="medium")


def test_a_list_of_few_classes_has_thresholds_of_its_own():
    """The number counts distinct classes without structure."""
    short = tuple(Thresholds(low=p, medium=p - 0.01, high=p - 0.02) for p in (0.99, 0.95))
    artifact = larger_artifact(
        "triway-local", outlier_thresholds=PRESETS, short_list_thresholds=short
    )
    wall = LABELS.index("wall")
    for classes, high, medium in (
        ([0], 0.97, 0.98),
        ([0, 0, wall], 0.97, 0.98),
        ([0, 1, 1], 0.93, 0.94),
        ([0, 1, 2], 0.3, 0.6),
        ([wall], 0.3, 0.6),
    ):
        scene = scene_of(classes)
        assert outliers(artifact, scene).threshold == medium
        assert outliers(artifact, scene, sensitivity="high").threshold == high
        assert outliers(artifact, scene, threshold=0.5).threshold == 0.5


@pytest.mark.parametrize("name", VARIANTS)
def test_companions_raise_the_log_odds_of_an_outlier_most(name):
    """In a scene with only the companion and the outlier."""
    artifact = larger_artifact(name)
    machine = machine_of(artifact.weights)
    W, c1 = machine.W.double(), machine.c1.double()

    def gain(x, weights):
        return (x + weights).exp().log1p().sum() - x.exp().log1p().sum()

    entries = outliers(artifact, scene_of([0, 1, 2]), threshold=0.0).outliers
    assert any(entry.usually_with for entry in entries)
    for entry in entries:
        i = LABELS.index(entry.label)
        increases = {
            label: float(gain(c1 + W[j], W[i]) - gain(c1, W[i]))
            for j, label in enumerate(LABELS)
            if label not in {*STRUCTURE, *LABELS[:3]}
        }
        largest = max(increases.values())
        assert all(increases[label] >= 0.5 * largest - 1e-4 for label in entry.usually_with)
        assert bool(entry.usually_with) == (largest > 1e-6)
