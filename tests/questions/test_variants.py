"""The closed form of every variant against the same posterior from very many draws."""

from __future__ import annotations

import numpy as np
import pytest

from app.questions.posterior import Posterior
from app.scene import Scene, derive_relations
from tests.questions.artifacts import larger_artifact, scene_of
from training.oracle.drawn import DrawnPosterior

NAMES = ("rbm-wide", "gbm-wide", "triway-deep")
PLACES = [[0.0, 0.0, 0.5], [1.0, 0.2, 0.5], [0.4, 1.1, 0.5], [1.4, 1.2, 0.5]]


def with_poses() -> Scene:
    plain = scene_of([0, 3, 5, 6])
    poses = derive_relations(PLACES, [[0.5, 0.5, 0.5]] * 4)
    triples = tuple((int(a), int(i), int(j)) for a, i, j in np.argwhere(poses.holds))
    return Scene(plain.objects, triples, poses=poses)


# The second number bounds log-odds in nats, the third probabilities. Given relations move the
# context away from the factorial one, and a second layer is held at what the objects say.
SCENES = {
    "bare": (scene_of([0, 3, 5, 6], room=1), 1e-3, 0.01),
    "two instances": (scene_of([0, 0, 3, 5]), 1e-3, 0.01),
    "one relation": (scene_of([0, 3, 5], [(2, 0, 1)]), 0.15, 0.02),
    "poses": (with_poses(), 0.4, 0.12),
}


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x, dtype=np.float64)))


@pytest.fixture(params=NAMES)
def artifact(request):
    return larger_artifact(request.param, scale=0.25)


@pytest.fixture(params=SCENES)
def case(request, artifact, monkeypatch):
    monkeypatch.setattr("training.oracle.evidence.DRAWS", 1 << 13)
    scene, nats, probability = SCENES[request.param]
    return Posterior(artifact, scene), DrawnPosterior(artifact, scene), nats, probability


def test_objects(case):
    closed, drawn, nats, _ = case
    absent = np.setdiff1d(np.arange(9), closed.present.classes)
    for ask in (
        lambda given: given.absent_log_odds(absent),
        lambda given: given.log_odds_given_rest(),
    ):
        np.testing.assert_allclose(ask(closed), ask(drawn), atol=nats)


def test_relations(case):
    closed, drawn, _, probability = case
    np.testing.assert_allclose(
        sigmoid(closed.relation_log_odds()), sigmoid(drawn.relation_log_odds()), atol=probability
    )
    one, other = np.array([0, 1, 0]), np.array([1, 2, 0])
    for found, expected in zip(
        closed.log_odds_apart(one, other), drawn.log_odds_apart(one, other), strict=True
    ):
        np.testing.assert_allclose(sigmoid(found), sigmoid(expected), atol=probability)


def test_placements(case):
    closed, drawn, _, probability = case
    absent = np.setdiff1d(np.arange(9), closed.present.classes)
    anchors = np.arange(len(closed.present.classes))
    for found, expected in zip(
        closed.placement_log_odds(absent, anchors),
        drawn.placement_log_odds(absent, anchors),
        strict=True,
    ):
        np.testing.assert_allclose(sigmoid(found), sigmoid(expected), atol=probability)
    for outgoing in (True, False):
        found, expected = (
            np.exp(given.placed_log_p(absent, 2, 1, outgoing=outgoing)) for given in (closed, drawn)
        )
        np.testing.assert_allclose(found, expected, atol=probability)


def test_some_units_are_asked_as_all_are(case):
    closed, _, _, _ = case
    n = len(closed.present.classes)
    units = tuple(part.reshape(-1) for part in np.indices((4, n, n)))
    found = closed.unit_log_odds(*units).reshape(4, n, n)
    np.testing.assert_allclose(sigmoid(found), sigmoid(closed.relation_log_odds()), atol=5e-3)


def test_reasons_have_the_sign_and_size_of_the_mean_field_s(case):
    closed, drawn, nats, _ = case
    rows = np.arange(len(closed.present.classes))
    absent = np.setdiff1d(np.arange(9), closed.present.classes)[:3]
    for found, expected in (
        (closed.reasons(rows), drawn.reasons(rows)),
        (closed.reasons_for_absent(absent), drawn.reasons_for_absent(absent)),
    ):
        np.testing.assert_allclose(found, expected, atol=0.1 + nats)
