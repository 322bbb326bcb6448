"""Places of objects: average precision by enumeration, and the questions of a small table."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, permutations

import numpy as np
import pytest

from app import questions
from app.scene import Scene, SceneObject, Vocabulary
from tests.training.evaluation.furnished_rooms import VOCABULARY, room_model
from training.datasets.priors import Placing
from training.evaluation.placing_task import average_precision, placing_metrics, rooms_of

# Votes for (object, receptacle) in a room type that the vocabulary knows.
VOTES = {
    ("lamp", "nightstand"): 6,
    ("lamp", "desk"): 5,
    ("book", "desk"): 7,
    ("book", "dresser"): 5,
    ("pillow", "bed"): 9,
}


def placings(votes=VOTES, room="bedroom", source="mine"):
    return [Placing(source, thing, place, count, room) for (thing, place), count in votes.items()]


def precision_of(order, relevant):
    """The definition: the mean over relevant items of the precision at their rank."""
    hits = np.cumsum([relevant[k] for k in order])
    return np.mean([hits[k] / (k + 1) for k, item in enumerate(order) if relevant[item]])


def enumerated(score, relevant):
    """The mean over all orders of the items that agree with the scores."""
    orders = [
        order
        for order in permutations(range(len(score)))
        if all(score[a] >= score[b] for a, b in pairwise(order))
    ]
    return np.mean([precision_of(order, relevant) for order in orders])


def test_average_precision_is_its_mean_over_the_orders_of_ties():
    rng = np.random.default_rng(0)
    for _ in range(40):
        size = int(rng.integers(1, 7))
        score = rng.integers(3, size=size).astype(float)
        score[score == 0] = -np.inf
        relevant = rng.random(size) < 0.5
        relevant[rng.integers(size)] = True
        expected = enumerated(score, relevant)
        assert average_precision(score, relevant) == pytest.approx(expected)


def asked_one_by_one(artifact, thing, place, room_type=None):
    """The sum of the answers about one candidate on, and in, one listed receptacle."""
    index = artifact.vocabulary.index(place)
    scene = Scene((SceneObject("it", place, index),), room_type=room_type)
    candidate = artifact.vocabulary.index(thing)
    answers = [
        questions.missing(artifact, scene, candidates=[candidate], at=(name, 0))["missing"]
        for name in ("on-top", "inside")
    ]
    return sum(answer[0]["probability"] for answer in answers)


@pytest.mark.parametrize(("name", "room_type"), [("mAP", None), ("mAP, room type listed", 0)])
def test_the_service_ranks_the_receptacles_of_a_room(name, room_type):
    artifact = room_model()
    if room_type is not None:
        room_type = artifact.vocabulary.room_index("bedroom")
    places = sorted({place for _, place in VOTES})
    expected = []
    for thing in ("book", "lamp", "pillow"):
        score = [asked_one_by_one(artifact, thing, place, room_type) for place in places]
        relevant = np.array([(thing, place) in VOTES for place in places])
        expected.append(enumerated(score, relevant))
    metrics = placing_metrics(artifact, rooms_of(placings()))
    assert len(metrics[name].groups) == 3
    assert metrics[name].value == pytest.approx(np.mean(expected))
    assert metrics[name].n == 3


def test_popularity_leaves_the_object_out():
    metrics = placing_metrics(room_model(), rooms_of(placings()))
    # Votes of the other objects for bed, desk, dresser and nightstand: book 9 5 0 6, lamp 9 7 5 0,
    # pillow 0 12 5 6. Random order: mean over all orders.
    book = (1 / 3 + 2 / 4) / 2
    lamp = (1 / 2 + 2 / 4) / 2
    assert metrics["mAP of popularity"].value == pytest.approx((book + lamp + 1 / 4) / 3)
    two, one = np.array([True, True, False, False]), np.array([True, False, False, False])
    random = (2 * enumerated([0] * 4, two) + enumerated([0] * 4, one)) / 3
    assert metrics["mAP of random order"].value == pytest.approx(random)
    for name in ("popularity", "random order"):
        difference = metrics["mAP"].value - metrics[f"mAP of {name}"].value
        assert metrics[f"mAP minus {name}"].value == pytest.approx(difference)


def test_an_unknown_receptacle_ranks_last():
    votes = {("pillow", "bed"): 5, ("lamp", "bed"): 5, ("lamp", "zeppelin"): 5}
    metrics = placing_metrics(room_model(), rooms_of(placings(votes)))
    assert metrics["mAP"].value == 1.0
    assert (metrics["mAP"].n, metrics["unknown receptacles"].value) == (1, 0.5)
    votes = {("pillow", "zeppelin"): 5, ("lamp", "bed"): 5}
    metrics = placing_metrics(room_model(), rooms_of(placings(votes)))
    assert metrics["mAP"].value == pytest.approx((1 / 2 + 1) / 2)


def test_questions_that_are_left_out_are_counted():
    # The service never proposes structure.
    objects = [replace(entry, structure=entry.label == "door") for entry in VOCABULARY.objects]
    words = Vocabulary(objects, VOCABULARY.room_types, VOCABULARY.room_aliases)
    artifact = replace(room_model(), vocabulary=words)
    votes = VOTES | {("zeppelin", "bed"): 5, ("door", "bed"): 5}
    votes |= {("plant", place): 5 for place in ("bed", "desk", "dresser", "nightstand")}
    metrics = placing_metrics(artifact, rooms_of(placings(votes)))
    assert len(metrics["left out: unknown object"].groups) == 6
    assert metrics["mAP"].n == 3
    assert metrics["left out: unknown object"].value == pytest.approx(2 / 6)
    assert metrics["left out: all receptacles are right"].value == pytest.approx(1 / 6)
    plain = placing_metrics(room_model(), rooms_of(placings()))
    assert metrics["mAP"].value == pytest.approx(plain["mAP"].value)


def test_without_known_objects_only_the_counts_remain():
    metrics = placing_metrics(room_model(), rooms_of(placings({("zeppelin", "bed"): 5})))
    assert list(metrics) == ["left out: unknown object", "left out: all receptacles are right"]
    assert metrics["left out: unknown object"].value == 1.0


def test_rooms_are_apart_and_votes_add_up():
    rows = placings() + placings({("lamp", "nightstand"): 2, ("cup", "desk"): 0})
    rows += placings({("cup", "sink"): 5}, room="kitchen")
    bedroom, kitchen = rooms_of(rows)
    assert (bedroom.name, kitchen.name) == ("bedroom", "kitchen")
    assert kitchen.receptacles == ("sink",)
    # A cup without votes does not count as an object of the bedroom.
    assert bedroom.objects == ("book", "lamp", "pillow")
    assert bedroom.receptacles == ("bed", "desk", "dresser", "nightstand")
    assert bedroom.votes.tolist() == [[0, 7, 5, 0], [0, 5, 0, 8], [9, 0, 0, 0]]
