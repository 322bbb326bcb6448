import numpy as np
import pytest
from scipy.special import expit, logsumexp

from app.inference.elementary import softmax
from app.model import WhereFit
from app.questions.where import room_log_odds
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


@pytest.mark.parametrize("fit", [WhereFit(slope=0.6, here=0.9, intercept=0.5)])
def test_the_fit_that_draws_the_rooms_is_found(model, monkeypatch, fit):
    """3,000 things determine the slope within .1, and the two others within .3."""
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
        if rng.random() < expit(fit.intercept + fit.here * logsumexp(log_odds)):
            room = int(rng.choice(3, p=softmax(fit.slope * log_odds)))
            case = HomeCase(rooms, thing, room, number)
        cases.append(case)
    monkeypatch.setattr(calibrate_where, "home_cases", lambda *_: cases)
    found = fit_where(model, [])
    assert found.slope == pytest.approx(fit.slope, abs=0.1)
    assert found.here == pytest.approx(fit.here, abs=0.3)
    assert found.intercept == pytest.approx(fit.intercept, abs=0.3)


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
