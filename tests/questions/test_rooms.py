"""The question `rooms`: its probabilities by hand, its candidates and its reasons."""

import math

import numpy as np
import pytest
import torch

from app.model import Sharpness
from tests.questions.answers import rooms
from tests.questions.artifacts import LARGER, larger_artifact, scene_of
from training.machines import machine_of

pytestmark = pytest.mark.usefixtures("without_minimums")

NAMES = [name for name, spec in LARGER.items() if spec.C]
SHARPNESS = Sharpness(slope=0.8, log_count=0.3)
CLASSES = [1, 3, 8]  # the last one is structure


@pytest.fixture(params=NAMES)
def artifact(request):
    return larger_artifact(request.param, rooms=SHARPNESS)


def log_odds_by_tensors(artifact, classes, profile=None):
    """log p(t) - log(1 - p(t)) before calibration, (C,)."""
    v = torch.zeros(1, artifact.spec.V)
    v[0, classes] = 1
    source = torch.tensor([-1 if profile is None else profile])
    return machine_of(artifact.weights).room_log_p(v, source)[0].double().exp().logit()


def by_type(artifact, entries):
    p = {entry.room_type: entry.probability for entry in entries}
    return np.array([p[name] for name in artifact.vocabulary.room_types])


@pytest.mark.parametrize("profile", [None, 1])
def test_probabilities_are_those_of_the_machine_to_a_power(artifact, profile):
    """The power is for two classes: structure does not count. The sum over all types is 1."""
    profile = profile if artifact.spec.profiles else None
    entries = rooms(artifact, scene_of(CLASSES, profile=profile))
    p = log_odds_by_tensors(artifact, CLASSES, profile).sigmoid() ** (0.8 + 0.3 * math.log(2))
    np.testing.assert_allclose(by_type(artifact, entries), p / p.sum(), rtol=2e-4)
    probabilities = [entry.probability for entry in entries]
    assert probabilities == sorted(probabilities, reverse=True)


def test_probabilities_of_candidates_sum_to_one(artifact):
    every = by_type(artifact, rooms(artifact, scene_of(CLASSES)))
    (only,) = rooms(artifact, scene_of(CLASSES), candidates={1: []})
    assert (only.room_type, only.probability) == (artifact.vocabulary.room_types[1], 1.0)
    both = by_type(artifact, rooms(artifact, scene_of(CLASSES), candidates={1: [], 0: []}))
    # Candidates are equally likely in a scene without objects.
    empty = log_odds_by_tensors(artifact, []).sigmoid().numpy() ** (0.8 + 0.3 * math.log(2))
    np.testing.assert_allclose(both, (ratio := every[:2] / empty[:2]) / ratio.sum(), rtol=1e-4)
    assert rooms(artifact, scene_of(CLASSES), candidates={}) == ()


@pytest.mark.parametrize("profile", [None, 1])
def test_candidates_are_equally_likely_without_objects(artifact, profile):
    profile = profile if artifact.spec.profiles else None
    entries = rooms(artifact, scene_of([8], profile=profile), candidates={1: [], 0: []})
    assert by_type(artifact, entries) == pytest.approx([0.5, 0.5], abs=1e-4)


def test_reasons_are_changes_of_log_odds(artifact):
    """Each object is left out in turn. Structure is never a reason."""
    for entry in rooms(artifact, scene_of(CLASSES)):
        t = artifact.vocabulary.room_types.index(entry.room_type)
        full = log_odds_by_tensors(artifact, CLASSES)[t]
        expected = {
            k: float(full - log_odds_by_tensors(artifact, np.delete(CLASSES, k))[t]) for k in (0, 1)
        }
        changes = {cause.object: cause.log_odds_change for cause in entry.because}
        assert changes == pytest.approx(expected, rel=1e-3, abs=1e-3)
        assert list(changes) == sorted(changes, key=lambda k: -abs(changes[k]))


def test_top_k_and_scores_shorten_the_answer(artifact):
    full = rooms(artifact, scene_of(CLASSES))
    (first,) = rooms(artifact, scene_of(CLASSES), top_k=1, details=False)
    assert first._fields == ("room_type", "probability")
    assert first == (full[0].room_type, full[0].probability)
