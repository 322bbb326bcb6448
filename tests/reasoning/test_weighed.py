"""Compiled draws given relations against the general ones."""

from __future__ import annotations

import numpy as np
import pytest

from app.reasoning import misplaced, missing, outliers, relations
from app.reasoning.drawn import DrawnPosterior
from app.reasoning.posterior import posterior
from app.reasoning.weighed import WeighedPosterior
from app.scene import Scene, SceneObject, derive_relations
from tests.reasoning.artifacts import larger_artifact, scene_of

# With the weights of a trained machine, not those that stretch the generic tests.
ARTIFACT = larger_artifact("triway-wide", scale=0.25)


def with_poses():
    plain = scene_of([0, 1, 2, 3])
    places = [[1, 0, 0], [1, 0.8, 0], [1.6, 0.8, 0], [30, 0, 0]]
    return Scene(plain.objects, poses=derive_relations(places, [[0.5, 0.5, 0.5]] * 4))


SCENES = {
    "one relation": scene_of([0, 3], [(2, 0, 1)]),
    "several": scene_of([0, 1, 2, 3, 4], [(0, 0, 1), (1, 1, 2), (2, 2, 0), (3, 4, 1)], room=1),
    "instances": scene_of([2, 2, 4, 4, 7], [(0, 0, 1), (1, 1, 2), (1, 3, 4)], room=0),
    "complete": scene_of([0, 5, 6], [(0, 0, 1)], complete=True),
    "nothing holds": scene_of([0, 5, 6], [], complete=True),
    "poses": with_poses(),
    "unsure": Scene(
        (SceneObject("a", "bed", 0, 0.3), SceneObject("b", "desk", 2, 0.8)), ((1, 1, 0),)
    ),
}


def sigmoid(x):
    return 1 / (1 + np.exp(-x.astype(np.float64)))


@pytest.fixture(params=SCENES)
def scene(request):
    return SCENES[request.param]


@pytest.fixture
def pair(scene):
    weighed = posterior(ARTIFACT, scene)
    assert isinstance(weighed, WeighedPosterior)
    return weighed, DrawnPosterior(ARTIFACT, scene)


def absent(given):
    return np.setdiff1d(np.arange(9), given.present.classes)


def test_absent_objects_are_the_same_estimate(pair):
    """The same uniforms behind both; a draw may still fall on the other side of one."""
    weighed, drawn = pair
    where = absent(weighed)
    np.testing.assert_allclose(
        weighed.absent_log_odds(where), drawn.absent_log_odds(where), atol=0.01
    )


def test_relations_are_the_same_estimate(pair):
    weighed, drawn = pair
    np.testing.assert_allclose(
        sigmoid(weighed.relation_log_odds()), sigmoid(drawn.relation_log_odds()), atol=0.01
    )


def test_placements_are_the_same_estimate(pair):
    weighed, drawn = pair
    anchors = np.arange(len(weighed.present.classes))
    both = [given.placement_log_odds(absent(weighed), anchors) for given in pair]
    for found, expected in zip(*both, strict=True):
        np.testing.assert_allclose(sigmoid(found), sigmoid(expected), atol=0.01)
    for relation in range(4):
        for outgoing in (True, False):
            found, expected = (
                given.placed_log_p(absent(weighed), relation, 1, outgoing=outgoing)
                for given in pair
            )
            np.testing.assert_allclose(np.exp(found), np.exp(expected), atol=0.01)


def test_present_objects_given_the_rest_are_as_good_an_estimate(pair, scene, monkeypatch):
    """One set of draws for all classes errs no more than a set for each."""
    weighed, drawn = (given.log_odds_given_rest() for given in pair)
    monkeypatch.setattr("app.reasoning.evidence.DRAWS", 1 << 14)
    exact = DrawnPosterior(ARTIFACT, scene).log_odds_given_rest()
    assert np.abs(weighed - exact).mean() < 1.5 * np.abs(drawn - exact).mean() + 0.03


def test_reasons(pair):
    """One holds what relations add as it is in the whole scene, the other lets it settle anew."""
    weighed, drawn = pair
    rows = np.arange(len(weighed.present.classes))
    difference = np.abs(weighed.reasons(rows) - drawn.reasons(rows))
    assert difference.max() < 0.15
    assert difference.mean() < 0.03
    np.testing.assert_array_equal(weighed.reasons(rows[-1:]), weighed.reasons(rows)[-1:])


def test_the_same_scene_gets_the_same_bits(scene):
    def ask():
        return (
            relations(ARTIFACT, scene),
            missing(ARTIFACT, scene),
            missing(ARTIFACT, scene, at=("on-top", 0)),
            outliers(ARTIFACT, scene),
            misplaced(ARTIFACT, scene),
        )

    first = ask()
    missing(ARTIFACT, SCENES["several"])
    assert ask() == first
