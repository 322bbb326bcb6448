"""The question `where`: its rooms and places by hand, listed things and searches."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.model import RealFit, WhereFit
from app.questions.doubt import believed
from app.questions.missing import VIEWER
from app.questions.placements import every_placement
from app.questions.where import LOOK, Room, Search, place_weights, room_log_odds, where
from tests.questions.answers import missing
from tests.questions.artifacts import LABELS, LARGER, larger_artifact, scene_of

FIT = WhereFit(slope=0.8, here=0.5, intercept=0.7, place_slope=0.9, place_intercept=0.4)
THING = LABELS.index("vase")
HOME = [Room("a", scene_of([0, 1, 2])), Room("b", scene_of([6, 6, 3])), Room("c", scene_of([]))]


@pytest.fixture(params=LARGER)
def artifact(request):
    return larger_artifact(request.param, where=FIT)


def by_room(answer):
    return {entry["room"]: entry["probability"] for entry in answer["rooms"]}


def test_the_log_odds_are_those_of_missing(artifact):
    """`/missing` and `/where` agree about each room."""
    for room in HOME:
        for coverage in (None, 0.8):
            one = replace(room, coverage=coverage)
            (value,) = room_log_odds(artifact, [one], THING)
            options = {"coverage": coverage, "candidates": [THING]}
            (entry,) = missing(artifact, room.scene, **options)
            assert value == pytest.approx(entry.log_odds, rel=1e-4)


def test_the_rooms_follow_the_formula(artifact):
    log_odds = room_log_odds(artifact, HOME, THING)
    weights = np.exp(0.8 * log_odds)
    here = 1 / (1 + math.exp(-(0.7 + 0.5 * math.log(np.exp(log_odds).sum()))))
    answer = where(artifact, HOME, THING)
    expected = dict(zip("abc", here * weights / weights.sum(), strict=True))
    assert by_room(answer) == pytest.approx(expected, abs=1e-5)
    assert answer["not_here"] == pytest.approx(1 - here, abs=1e-5)
    shown = [entry["probability"] for entry in answer["rooms"]]
    assert shown == sorted(shown, reverse=True)


def test_the_places_of_a_room_follow_the_formula():
    artifact, room = larger_artifact("triway", where=FIT), HOME[1]
    placed = every_placement(artifact, believed(artifact, room.scene), room.scene, THING, VIEWER)
    weights = {
        (fields["relation"], fields["object"]): math.exp(0.4) * (p / (1 - p)) ** 0.9 / len(alike)
        for p, alike in placed
        for fields in alike
    }
    total_weight = 1 + sum(weights.values())
    answer = where(artifact, [room], THING, top_k=500)
    found = {
        (one.get("relation"), one.get("object")): one["probability"] for one in answer["places"]
    }
    here = by_room(answer)["b"]
    assert found.pop((None, None)) == pytest.approx(here / total_weight, rel=1e-3)
    assert len(found) == len(weights) > 0
    for place, weight in weights.items():
        assert found[place] == pytest.approx(here * weight / total_weight, rel=1e-3)


def test_by_default_the_places_are_independent_events_of_which_at_most_one_holds():
    """By enumeration of all combinations of three places."""
    p = np.array([0.3, 0.9, 0.05])
    combinations = np.array(list(itertools.product([False, True], repeat=3)))
    probability = np.where(combinations, p, 1 - p).prod(1)
    single = combinations.sum(1) == 1
    expected = [probability[single & combinations[:, k]].sum() for k in range(3)]
    none = probability[combinations.sum(1) == 0].sum()
    assert place_weights(WhereFit(), p) == pytest.approx(np.array(expected) / none)


def total(answer):
    return sum(place["probability"] for place in answer["places"]) + answer["not_here"]


searches = st.lists(
    st.builds(
        Search,
        st.integers(0, 2),
        st.sampled_from([None, "bed_0", "shelf_0", "shelf_1"]),
        st.floats(0, 1),
    ),
    max_size=5,
)


@given(st.sampled_from(list(LARGER)), searches)
def test_probabilities_sum_to_one_and_places_to_their_rooms(name, searched):
    artifact = larger_artifact(name, where=FIT)
    answer = where(artifact, HOME, THING, searched=searched, top_k=500)
    assert total(answer) == pytest.approx(1, abs=1e-4)
    for name_of, p in by_room(answer).items():
        places = [one["probability"] for one in answer["places"] if one["room"] == name_of]
        assert sum(places) == pytest.approx(p, abs=1e-4)


def test_a_searched_room_keeps_the_share_that_a_look_misses(artifact):
    before, seen = where(artifact, HOME, THING), 0.6
    after = where(artifact, HOME, THING, searched=[Search(0, None, seen)])
    factor = 1 - LOOK * seen
    old, new = by_room(before), by_room(after)
    assert new["a"] / new["b"] == pytest.approx(factor * old["a"] / old["b"], rel=1e-3)
    assert after["not_here"] / new["b"] == pytest.approx(before["not_here"] / old["b"], rel=1e-3)


def test_a_searched_object_loses_its_places_only(artifact):
    before = where(artifact, HOME, THING, top_k=500)
    after = where(artifact, HOME, THING, top_k=500, searched=[Search(1, "shelf_0", 1.0)])
    ratio = after["not_here"] / before["not_here"]

    def of(answer):
        return {
            (one["room"], one.get("relation"), one.get("object")): one["probability"]
            for one in answer["places"]
        }

    for place, p in of(before).items():
        factor = (1 - LOOK) * ratio if place[2] == "shelf_0" else ratio
        assert of(after)[place] == pytest.approx(factor * p, rel=2e-3, abs=1e-6)


def test_objects_of_one_class_share_their_places():
    answer = where(larger_artifact("triway", where=FIT), HOME, THING, top_k=500)
    of_shelf = {"shelf_0": set(), "shelf_1": set()}
    for one in answer["places"]:
        if one.get("object") in of_shelf:
            of_shelf[one["object"]].add((one["relation"], one["probability"]))
    assert of_shelf["shelf_0"] == of_shelf["shelf_1"] != set()


def test_a_listed_thing_is_the_thing_with_its_confidence(artifact):
    objects = scene_of([0, THING, 2]).objects
    unsure = replace(HOME[0].scene, objects=(objects[0], replace(objects[1], confidence=0.7)))
    home = [Room("a", unsure), *HOME[1:]]
    hidden = [Room("a", replace(unsure, objects=objects[:1])), *HOME[1:]]
    answer, without = where(artifact, home, THING), where(artifact, hidden, THING)
    first = answer["places"][0]
    assert first == {"room": "a", "probability": 0.7, "object": "vase_1", "is_listed": True}
    assert answer["not_here"] == pytest.approx(0.3 * without["not_here"], rel=1e-4)
    room = by_room(without)["b"]
    assert by_room(answer)["b"] == pytest.approx(0.3 * room, rel=1e-4)


def test_a_listed_thing_may_have_been_carried_away(artifact):
    """Searches without success move even a certain thing."""
    home = [*HOME, Room("d", scene_of([THING]))]
    answer = where(artifact, home, THING)
    assert answer["places"][0]["probability"] == 0.98
    for name, count in (("vase_0", 7), (None, 1024)):
        answer = where(artifact, home, THING, searched=[Search(3, name, 1.0)] * count)
        assert answer["places"][0]["room"] != "d"
        assert total(where(artifact, home, THING, top_k=500)) == pytest.approx(1, abs=1e-4)


def test_a_thing_of_a_broader_class_may_be_the_wanted_one():
    artifact = larger_artifact("triway")
    broader = np.zeros((9, 9), np.bool_)
    broader[THING, 3] = True  # a chair may be a vase here
    vars(artifact.vocabulary)["broader"] = broader
    home = [*HOME[:1], Room("b", scene_of([6, 3]))]
    first = where(artifact, home, THING)["places"][0]
    assert (first["object"], first["is_listed"], first["probability"]) == ("chair_1", True, 0.5)
    kinds = where(artifact, [*HOME[:1], Room("b", scene_of([6, THING]))], 3)["places"][0]
    assert (kinds["object"], kinds["probability"]) == ("vase_1", 0.98)


def test_a_wrong_detection_is_not_the_thing():
    fit = RealFit(intercept=-9.0, confidence=1.0, context=0.0, log_count=0.0)
    artifact = larger_artifact("triway", where=FIT, real=fit)
    objects = scene_of([0, THING, 2]).objects
    weak = replace(HOME[0].scene, objects=(objects[0], replace(objects[1], confidence=0.6)))
    answer = where(artifact, [Room("a", weak), *HOME[1:]], THING, top_k=500)
    listed = [one["probability"] for one in answer["places"] if one.get("is_listed")]
    assert sum(listed) < 0.001


def test_top_k_limits_the_places_but_not_the_rooms():
    answer = where(larger_artifact("triway"), HOME, THING, top_k=1)
    assert (len(answer["places"]), len(answer["rooms"])) == (1, 3)
