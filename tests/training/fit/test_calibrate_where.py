import numpy as np
import pytest
from scipy.special import expit, logsumexp

from app.inference.elementary import softmax
from app.model import WhereFit
from app.questions.doubt import believed
from app.questions.missing import VIEWER
from app.questions.placements import every_placement
from app.questions.where import place_weights, room_log_odds
from app.scene.spatial_relations import canonicalise
from tests.questions.artifacts import LABELS, larger_artifact
from tests.training.evaluation.scenes import scene
from training.datasets.homes import NOWHERE, HomeCase
from training.evaluation.where_task import rooms_of
from training.fit import calibrate_where
from training.fit.calibrate_where import fit_where

V = len(LABELS)
WALL = LABELS.index("wall")


@pytest.fixture(scope="module")
def model():
    return larger_artifact("triway-states")


FIT = WhereFit(slope=0.6, here=0.9, intercept=0.5, place_slope=0.7, place_intercept=0.8)


def with_thing(model, room, thing, rng):
    """The room with the thing at a place that is drawn by `FIT`."""
    (bare,) = rooms_of(model, HomeCase([room], thing, NOWHERE, 0))
    posterior = believed(model, bare.scene)
    placed = every_placement(model, posterior, bare.scene, thing, VIEWER)
    weights = np.append(place_weights(FIT, np.array([p for p, _ in placed])), 1.0)
    number, triples = int(rng.choice(len(weights), p=weights / weights.sum())), []
    if number < len(placed):
        place = placed[number][1][0]
        other = next(one.class_index for one in bare.scene.objects if one.id == place["object"])
        relation, subject, _ = canonicalise(str(thing), place["relation"], str(other))
        ends = (thing, other) if subject == str(thing) else (other, thing)
        triples = [(relation, *ends)]
    classes = sorted([*room.instance_classes.tolist(), thing])
    return scene(classes, triples, room=room.room_type)


def test_the_fit_that_draws_the_places_is_found(model, monkeypatch):
    """3,000 things determine the slopes within .1, and the others within .3."""
    rng, cases = np.random.default_rng(0), []
    for number in range(3000):
        thing = int(rng.integers(V - 1))
        others = np.setdiff1d(np.arange(V - 1), thing)
        rooms = [
            scene(np.sort(rng.permutation(others)[: rng.integers(1, 6)]).tolist(), room=int(kind))
            for kind in rng.integers(0, 2, 3)
        ]
        case = HomeCase(rooms, thing, NOWHERE, number)
        log_odds = room_log_odds(model, rooms_of(model, case), thing)
        if rng.random() < expit(FIT.intercept + FIT.here * logsumexp(log_odds)):
            room = int(rng.choice(3, p=softmax(FIT.slope * log_odds)))
            rooms[room] = with_thing(model, rooms[room], thing, rng)
            case = HomeCase(rooms, thing, room, number)
        cases.append(case)
    monkeypatch.setattr(calibrate_where, "home_cases", lambda *_: cases)
    found = fit_where(model, [])
    assert found.slope == pytest.approx(FIT.slope, abs=0.1)
    assert found.here == pytest.approx(FIT.here, abs=0.3)
    assert found.intercept == pytest.approx(FIT.intercept, abs=0.3)
    assert found.place_slope == pytest.approx(FIT.place_slope, abs=0.1)
    assert found.place_intercept == pytest.approx(FIT.place_intercept, abs=0.3)


def test_rooms_are_shown_without_the_thing_and_structure(model):
    """Also a second object of its class is left out, which another room has."""
    rooms = [scene([0, 1, 2, WALL], room=0), scene([0, 3, WALL], room=1)]
    shown = rooms_of(model, HomeCase(rooms, 0, 0, 0))
    assert [[thing.class_index for thing in room.scene.objects] for room in shown] == [[1, 2], [3]]
    assert [room.scene.room_type for room in shown] == [0, 1]


def test_few_homes_leave_the_places_as_they_are(model):
    rooms = [
        scene([0, k % 5 + 1], room=0, source="procthor", group=f"home {k // 3}") for k in range(57)
    ]
    assert fit_where(model, rooms) == WhereFit()
