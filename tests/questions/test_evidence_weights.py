"""How strongly given relations act on questions about objects and about relations."""

from __future__ import annotations

import numpy as np
import pytest

from app.questions.posterior import posterior
from app.registry.description import EvidenceWeights
from app.scene import Scene, derive_relations
from tests.questions.artifacts import LARGER, larger_artifact, scene_of
from training.oracle.drawn import DrawnPosterior

STATED = scene_of([0, 1, 2, 3], [(2, 1, 0), (0, 2, 3), (1, 0, 3)])
PLACES = [[1, 0, 0], [1, 0.8, 0], [1.6, 0.8, 0], [30, 0, 0]]
POSED = Scene(scene_of([0, 1, 2, 3]).objects, poses=derive_relations(PLACES, [[0.5] * 3] * 4))
SCENES = {"relations": STATED, "poses": POSED}
BARE = scene_of([0, 1, 2, 3])
ABSENT = np.arange(4, 9)
ROWS = np.arange(4)


def artifact_with(name, kind, objects=1.0, relations=1.0, scale=0.3):
    weights = {f"{kind}_on_objects": objects, f"{kind}_on_relations": relations}
    return larger_artifact(name, scale=scale, evidence=EvidenceWeights(**weights))


def asked(name, kind, objects=1.0, relations=1.0, scene=None):
    return posterior(artifact_with(name, kind, objects, relations), scene or SCENES[kind])


def about_objects(given):
    return (
        given.absent_log_odds(ABSENT),
        given.log_odds_given_rest(),
        given.reasons(ROWS),
        given.reasons_for_absent(ABSENT),
    )


def about_relations(given):
    one, other = np.array([0, 1]), np.array([1, 3])
    return (
        given.relation_log_odds(),
        given.unit_log_odds(np.array([2, 0]), np.array([1, 2]), np.array([0, 3])),
        *given.log_odds_apart(one, other),
        *given.placement_log_odds(ABSENT, ROWS),
        given.placed_log_p(ABSENT, 2, 0, outgoing=True),
    )


@pytest.fixture(params=LARGER)
def name(request):
    return request.param


@pytest.fixture(params=SCENES)
def kind(request):
    return request.param


def test_without_weight_objects_are_judged_as_without_relations(name, kind):
    found, bare = (
        about_objects(asked(name, kind, 0.0, scene=scene)) for scene in (SCENES[kind], BARE)
    )
    full = about_objects(asked(name, kind))
    for one, other, with_all in zip(found, bare, full, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
        assert np.abs(with_all - other).max() > 1e-3


def test_each_weight_is_for_its_own_questions(name, kind):
    full = asked(name, kind)
    objects, relations = (asked(name, kind, *weights) for weights in ((0.3, 1.0), (1.0, 0.3)))
    other = asked(name, "poses" if kind == "relations" else "relations", 0.3, 0.3, SCENES[kind])
    for ask, same, changed in (
        (about_objects, relations, objects),
        (about_relations, objects, relations),
    ):
        for all_, alike, as_well in zip(ask(full), ask(same), ask(other), strict=True):
            np.testing.assert_array_equal(all_, alike)
            np.testing.assert_array_equal(all_, as_well)
        pairs = zip(ask(full), ask(changed), strict=True)
        assert max(np.abs(one - two).max() for one, two in pairs) > 1e-3


def test_half_the_weight_is_between(kind):
    none, half, full = (
        asked("triway-wide", kind, w).absent_log_odds(ABSENT) for w in (0.0, 0.5, 1.0)
    )
    assert np.abs(half - (none + full) / 2).max() < 0.2 * np.abs(full - none).max()


@pytest.mark.parametrize("weight", [0.0, 0.3, 0.7])
def test_both_posteriors_agree(kind, weight, monkeypatch):
    """The closed form scales the pull of its mean field, draws the likelihood of relations.

    Bounds, and weights of the machine, as in `test_closed_given`.
    """
    artifact = artifact_with("triway-wide", kind, weight, weight, scale=0.12)
    closed = posterior(artifact, SCENES[kind])
    monkeypatch.setattr("training.oracle.evidence.DRAWS", 1 << 13)
    drawn = DrawnPosterior(artifact, SCENES[kind])
    for ask in (lambda p: p.absent_log_odds(ABSENT), lambda p: p.log_odds_given_rest()):
        assert np.abs(ask(closed) - ask(drawn)).max() < 0.12
    one, other = (1 / (1 + np.exp(-p.relation_log_odds())) for p in (closed, drawn))
    assert np.abs(one - other).max() < 0.03


def test_a_share_goes_out_with_its_class():
    """Judged by the rest: as in the scene without it, the slopes of the others held."""
    scene = scene_of([0, 1, 2], [(2, 1, 0)])
    found = asked("triway-wide", "relations", 0.4, scene=scene).log_odds_given_rest()
    alone = asked("triway-wide", "relations", 0.4, scene=scene_of([0, 2]))
    # Without class 1 no relation is left.
    assert found[1] == pytest.approx(float(alone.absent_log_odds(np.array([1]))[0]), abs=1e-4)
