"""The formulas of the calibration, and that the answers use them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.questions import rooms
from app.questions.ranking import relation_probability
from app.registry.description import (
    Calibration,
    CountSlope,
    PairSlope,
    RelationSlopes,
    Sharpness,
    Slope,
)
from tests.questions.answers import misplaced, missing, relations, without_minimums
from tests.questions.artifacts import larger_artifact, scene_of


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-0.9, 3)), max_size=4),
    st.lists(st.floats(-6, 6), min_size=1, max_size=5),
)
def test_a_line_bends_at_the_bends_of_its_entry(bends, log_odds):
    """The entry of the other relation has no bends."""
    entry = PairSlope(intercept=0.5, slope=0.8, bends=tuple(bends))
    neutral = Calibration.neutral(2)
    slopes = RelationSlopes.of(
        neutral.model_copy(update={"relation": (entry, PairSlope())})
    ).relation
    values = np.array([[log_odds, log_odds]])
    p = relation_probability(slopes, values, np.zeros(len(log_odds)), 1)[0]
    for k, z in enumerate(log_odds):
        x = 0.5 + 0.8 * z
        y = x + sum(change * max(x - at, 0) for at, change in bends)
        assert p[:, k] == pytest.approx([sigmoid(y), sigmoid(z)], abs=1e-5)


def test_scenes_with_relations_have_entries_of_their_own():
    alone, given = (PairSlope(intercept=b, slope=0.0, log_classes=-0.5) for b in (-1.0, 1.0))
    artifact = larger_artifact("triway", relation=(alone,) * 4, relation_given=(given,) * 4)
    # At an intercept of 1, opposite relations exclude each other.
    for stated, p in ((None, sigmoid(-1 - 0.5 * math.log(3))), ([(0, 0, 1)], 0.5)):
        for entry in relations(artifact, scene_of([0, 1, 2], stated)):
            assert entry.probability == pytest.approx(p, rel=1e-5)


def test_placements_have_entries_of_their_own():
    """A missing object is one more class. The place of `at` has an entry of its own, too."""
    placement = (PairSlope(intercept=-1.0, slope=0.0, log_classes=-0.5),) * 4
    at_place = (PairSlope(intercept=-0.5, slope=0.0),) * 4
    artifact = larger_artifact("triway", placement=placement, asked_place=at_place)
    p = sigmoid(-1 - 0.5 * math.log(4))
    for entry in missing(artifact, scene_of([0, 1, 2])):
        assert [place.probability for place in entry.placements] == [pytest.approx(p, rel=1e-5)] * 3
    with without_minimums():
        entries = missing(artifact, scene_of([0, 1, 1]), at=("left", 1), top_k=9)
    for entry in entries:
        first, *others = entry.placements
        assert (first.relation, first.object) == ("left", 1)
        assert first.probability == pytest.approx(sigmoid(-0.5), rel=1e-5)
        p = sigmoid(-1 - 0.5 * math.log(3))
        assert [place.probability for place in others] == [pytest.approx(p, rel=1e-5)] * 2


def test_instances_count_in_relations():
    """Three chairs and two lamps: log 6 for a pair of both classes, log 9 among the chairs."""
    entry = PairSlope(intercept=-2.0, slope=0.0, log_count=-0.5)
    artifact = larger_artifact("triway", relation=(entry,) * 4)
    entries = relations(artifact, scene_of([3, 3, 3, 1, 1]), top_k=100)
    p = {(entry.subject, entry.object): entry.probability for entry in entries}
    assert p[0, 3] == pytest.approx(sigmoid(-2 - 0.5 * math.log(6)), rel=1e-5)
    assert p[0, 1] == pytest.approx(sigmoid(-2 - 0.5 * math.log(9)), rel=1e-5)


def test_room_types_are_as_sharp_as_their_entry():
    """Four listed classes; two chairs are one class."""
    scene = scene_of([3, 3, 1, 0, 2])
    plain, sharp = (
        [one["probability"] for one in rooms(larger_artifact("triway", **own), scene)["room_types"]]
        for own in ({}, {"rooms": Sharpness(slope=0.75, log_count=-0.25)})
    )
    powers = [p ** (0.75 - 0.25 * math.log(4)) for p in plain]
    assert sharp == pytest.approx([power / sum(powers) for power in powers], rel=1e-4)
    assert sharp != pytest.approx(plain, rel=1e-2)


def test_false_relations():
    scene = scene_of([0, 1, 2], [(2, 1, 0), (0, 1, 2)])
    plain = misplaced(larger_artifact("triway"), scene)
    slope = Slope(intercept=0.4, slope=-0.5)
    scaled = misplaced(larger_artifact("triway", misplaced=slope), scene)
    for one, other in zip(plain, scaled, strict=True):
        assert one[:3] == other[:3]
        z = math.log(one.probability / (1 - one.probability))
        assert other.probability == pytest.approx(sigmoid(0.4 + 0.5 * z), rel=1e-4)


@pytest.mark.parametrize(
    ("classes", "listed"), [([0, 1, 1, 8], 2), ([0, 1, 2], 3), ([8], 1), ([], 1)]
)
def test_missing_classes_by_log_odds_and_number_of_listed_classes(classes, listed):
    """Structure and further instances do not count. The number is at least 1."""
    slope = CountSlope(intercept=0.4, slope=0.6, log_count=-0.5)
    artifact = larger_artifact("triway", missing=slope)
    for entry in missing(artifact, scene_of(classes), top_k=9):
        z = 0.4 + 0.6 * entry.log_odds - 0.5 * math.log(listed)
        assert entry.probability == pytest.approx(sigmoid(z), rel=1e-5)


@pytest.mark.parametrize("relation", ["left", "behind"])
def test_the_probability_at_a_place_is_a_product(relation):
    """p(present) · p(relation holds), both from the answer without a place."""
    slope = CountSlope(intercept=-0.2, slope=0.8, log_count=0.3)
    # The intercept is so low that no relation excludes its opposite.
    slopes = (PairSlope(intercept=-3.0, slope=0.7, log_count=-0.4, bends=((-3.5, 0.5),)),) * 4
    artifact = larger_artifact("triway", missing=slope, placement=slopes)
    scene = scene_of([0, 1, 1])
    present = {entry.label: entry.probability for entry in missing(artifact, scene, top_k=9)}
    entries = missing(artifact, scene, at=(relation, 1), top_k=9)
    assert {entry.label for entry in entries} == present.keys()
    for entry in entries:
        place = entry.placements[0]
        assert (place.relation, place.object) == (relation, 1)
        p = present[entry.label] * place.probability
        assert entry.probability == pytest.approx(p, rel=1e-5)
