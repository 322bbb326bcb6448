"""The answers at a place, on pairs of classes whose distribution is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.registry import Calibration, PlaceFit
from app.scene.relations import LATERAL, ON_TOP, STACKED
from tests.training.evaluation.scenes import scene, tensors
from training.fit import calibrate_at
from training.fit.calibrate_at import fit_at

A, V = 5, 20
LISTED = 10
RELATION, COUNTS = 0.8, 0.4
RNG = np.random.default_rng(0)
PRESENCE = RNG.normal(0, 1, V)
TABLES = RNG.normal(0, 1, (2, V, V))
ARTIFACT = SimpleNamespace(
    spec=SimpleNamespace(A=A, V=V),
    vocabulary=SimpleNamespace(structure=np.zeros(V, dtype=np.bool_)),
    calibration=Calibration.neutral(A),
)


def scores(relation: float, counts: float):
    """The score of each class i at each class j, (V, V)."""
    return PRESENCE[:, None] + relation * TABLES[0] + counts * TABLES[1]


def pairs(count: int, seed: int):
    """Draw i on j with p ∝ exp(presence of i + presence of j + .8 relation + .4 counts).

    Given j, class i then has a softmax over the scores. Given i, class j has one too.
    """
    joint = np.exp(scores(RELATION, COUNTS) + PRESENCE)
    np.fill_diagonal(joint, 0.0)
    drawn = np.random.default_rng(seed).choice(V * V, count, p=(joint / joint.sum()).ravel())
    return np.stack(np.divmod(drawn, V), 1)


def scenes_of(drawn, sources: int = 8):
    """Scenes of two classes, of which one is on the other."""
    made = [
        scene(sorted((i, j)), [(ON_TOP, i, j)], source=f"source {k % sources}", name=f"pair {k}")
        for k, (i, j) in enumerate(drawn.tolist())
    ]
    return tensors(made, V)


@pytest.fixture(autouse=True)
def _terms(monkeypatch):
    monkeypatch.setattr(calibrate_at, "place_terms", terms)


def terms(artifact, scene, place, coverage):
    anchor = scene.objects[place.anchor].class_index
    relation, counts = TABLES[:, :, anchor] if place.outgoing else TABLES[:, anchor]
    return PRESENCE.copy(), relation, counts


@pytest.fixture(scope="module")
def drawn():
    return pairs(1200, seed=1)


def test_the_weights_are_those_of_the_distribution(drawn):
    """1,200 questions. A standard error is about .03, so .15 is five of them."""
    entries = fit_at(ARTIFACT, scenes_of(drawn))
    assert entries[ON_TOP].relation == pytest.approx(RELATION, abs=0.15)
    assert entries[ON_TOP].counts == pytest.approx(COUNTS, abs=0.15)
    # Relations of stacked objects share an entry. No scene shows left or front.
    assert {entries[a] for a in STACKED} == {entries[ON_TOP]}
    assert {entries[a] for a in LATERAL} == {PlaceFit()}


def test_listed_classes_are_as_likely_as_the_entry_states(drawn):
    """The 10 likeliest classes at the places of 4,000 other pairs; the default is far off."""
    entry = fit_at(ARTIFACT, scenes_of(drawn))[ON_TOP]
    losses = []
    for fit in (entry, PlaceFit()):
        table = scores(fit.relation, fit.counts)
        logits, truth = [], []
        for i, j in pairs(4000, seed=2).tolist():
            score = np.delete(table[:, j], j)
            first = np.argsort(-score)[:LISTED]
            logits.append(fit.intercept + fit.slope * score[first])
            truth.append(np.delete(np.arange(V), j)[first] == i)
        z, y = np.concatenate(logits), np.concatenate(truth)
        losses.append(np.mean(np.logaddexp(0, z) - y * z))
        if fit is entry:
            assert np.mean(1 / (1 + np.exp(-z))) == pytest.approx(y.mean(), abs=0.01)
    assert losses[0] < losses[1] - 0.05


def test_scenes_without_relations_keep_the_default_entry():
    alone = tensors([scene([k % V, (k + 1) % V]) for k in range(30)], V)
    assert fit_at(ARTIFACT, alone) == (PlaceFit(),) * A


def test_few_true_classes_keep_the_log_odds():
    """Four pairs give at most four true classes."""
    entry = fit_at(ARTIFACT, scenes_of(pairs(4, seed=3)))[ON_TOP]
    assert (entry.intercept, entry.slope) == (0.0, 1.0)


def test_a_score_that_misleads_keeps_the_log_odds(drawn, monkeypatch):
    """The likeliest classes get the lowest scores, and the other terms say nothing."""
    nothing = np.zeros(V)
    monkeypatch.setattr(calibrate_at, "place_terms", lambda *_: (-PRESENCE, nothing, nothing))
    entry = fit_at(ARTIFACT, scenes_of(drawn[:400]))[ON_TOP]
    assert (entry.intercept, entry.slope) == (0.0, 1.0)
