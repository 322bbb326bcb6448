"""Coverage: the effect of the listed share of a scene on the answers about missing objects.

`test_object_gains` compares the bias kappa with its formula.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.inference.weights import Weights
from tests.questions.answers import missing
from tests.questions.artifacts import LABELS, LARGER, larger_artifact, scene_of

ARTIFACTS = {name: larger_artifact(name) for name in LARGER}
every_machine = pytest.mark.parametrize("name", LARGER)
SCENES = [scene_of([]), scene_of([0, 3, 3, 8]), scene_of([0, 1, 2], [(2, 1, 0), (0, 0, 2)], 1)]


def log_odds(artifact, scene, **options):
    return {entry.label: entry.log_odds for entry in missing(artifact, scene, top_k=9, **options)}


@every_machine
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("coverage", [0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 0.95, 1.0])
def test_a_coverage_adds_its_bias_to_each_class(name, scene, coverage):
    """Against the last row of kappa: all classes but one are listed."""
    artifact = ARTIFACTS[name]
    kappa = artifact.weights["kappa"]
    full = log_odds(artifact, scene, coverage=1.0)
    for label, z in log_odds(artifact, scene, coverage=coverage).items():
        column = kappa[:, LABELS.index(label)]
        expected = full[label] + np.interp(coverage, [0.15, 0.45, 0.8, 1.0], column) - column[-1]
        assert z == pytest.approx(expected, abs=1e-4)


@every_machine
def test_the_default_is_the_coverage_of_the_model(name):
    artifact, scene = larger_artifact(name, coverage=0.25), scene_of([0, 1])
    assert log_odds(artifact, scene) == log_odds(artifact, scene, coverage=0.25)
    assert log_odds(artifact, scene) != log_odds(artifact, scene, coverage=0.5)
    assert log_odds(artifact, scene, coverage=0.0) != log_odds(artifact, scene, coverage=0.5)


@every_machine
def test_falling_biases_make_unlisted_classes_less_likely_at_a_higher_coverage(name):
    artifact = ARTIFACTS[name]
    kappa = np.array([[1.0], [0.4], [-0.5], [-3.0]], np.float32) * np.ones(9, np.float32)
    weights = Weights(artifact.spec, {**artifact.weights.arrays, "kappa": kappa})
    falling = replace(artifact, weights=weights)
    rows = [log_odds(falling, scene_of([0]), coverage=c) for c in np.linspace(0, 1, 21)]
    for label in rows[0]:
        column = [row[label] for row in rows]
        assert column == sorted(column, reverse=True)
        assert column[0] - column[-1] == pytest.approx(4.0, abs=1e-4)


@given(
    st.sampled_from(sorted(LARGER)),
    st.lists(st.integers(0, 8), max_size=6),
    st.floats(0, 1),
    st.booleans(),
)
@settings(max_examples=60)
def test_probabilities_at_every_coverage(name, classes, coverage, placed):
    options = {"coverage": coverage, "at": ("on-top", 0) if placed and classes else None}
    entries, again = (
        missing(ARTIFACTS[name], scene_of(classes), top_k=9, **options) for _ in range(2)
    )
    assert entries == again
    assert {entry.label for entry in entries} == set(LABELS[:8]) - {LABELS[c] for c in classes}
    p = [entry.probability for entry in entries]
    assert p == sorted(p, reverse=True)
    assert all(0 <= value <= 1 for value in p)
