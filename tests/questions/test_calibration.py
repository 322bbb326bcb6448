"""The calibration's formulas, number by number, and that the answers go through them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.questions.calibration import relation_probability
from app.registry.description import Calibration, CountSlope, PairSlope, RelationSlopes, Slope
from tests.questions.answers import missing, outliers, relations
from tests.questions.artifacts import larger_artifact, scene_of


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-0.9, 3)), max_size=4),
    st.lists(st.floats(-6, 6), min_size=1, max_size=5),
)
def test_a_line_bends_where_its_entry_says(bends, log_odds):
    entry = PairSlope(intercept=0.5, slope=0.8, bends=tuple(bends))
    # An entry of fewer bends stands beside it.
    neutral = Calibration.neutral(2)
    slopes = RelationSlopes.of(
        neutral.model_copy(update={"relation": (entry, PairSlope())})
    ).relation
    values = np.array([[log_odds, log_odds]])
    p = relation_probability(slopes, values, np.zeros(len(log_odds)), 1)[0]
    for k, z in enumerate(log_odds):
        x = 0.5 + 0.8 * z
        y = x + sum(change * max(x - at, 0) for at, change in bends)
        assert p[0, k] == pytest.approx(sigmoid(y), abs=1e-5)
        assert p[1, k] == pytest.approx(sigmoid(z), abs=1e-5)


def test_scenes_that_state_relations_have_entries_of_their_own():
    alone, given = (PairSlope(intercept=b, slope=0.0, log_classes=-0.5) for b in (-1.0, 1.0))
    artifact = larger_artifact("triway-local", relation=(alone,) * 4, relation_given=(given,) * 4)
    for stated, b in ((None, -1.0), ([(0, 0, 1)], 1.0)):
        scene = scene_of([0, 1, 2], stated)
        wanted = pytest.approx(sigmoid(b - 0.5 * math.log(3)) if b < 0 else 0.5, abs=1e-6)
        assert all(answer.probability == wanted for answer in relations(artifact, scene)[0])


def test_placements_have_entries_of_their_own():
    """A missing thing would be one more class; of a(x, y) and a(y, x) at most one holds."""
    entry = (PairSlope(intercept=-1.0, slope=0.0, log_classes=-0.5),) * 4
    artifact = larger_artifact("triway-local", placement=entry)
    answers = missing(artifact, scene_of([0, 1, 2]))
    p = {place.probability for answer in answers for place in answer.placements}
    assert list(p) == [pytest.approx(sigmoid(-1 - 0.5 * math.log(4)), abs=1e-6)]


def test_instances_count_in_relations():
    """Three chairs and two lamps: log 6 a pair of classes, log 9 among the chairs."""
    entry = PairSlope(intercept=-2.0, slope=0.0, log_count=-0.5)
    artifact = larger_artifact("triway-local", relation=(entry,) * 4)
    answers, _ = relations(artifact, scene_of([3, 3, 3, 1, 1]), top_k=100)
    p = {(a.subject, a.object): a.probability for a in answers}
    assert p[0, 3] == pytest.approx(sigmoid(-2 - 0.5 * math.log(6)), abs=1e-6)
    assert p[0, 1] == pytest.approx(sigmoid(-2 - 0.5 * math.log(9)), abs=1e-6)


def test_false_relations():
    scene = scene_of([0, 1, 2], [(2, 1, 0), (0, 1, 2)])
    plain = outliers(larger_artifact("triway-local"), scene).misplaced
    changed = larger_artifact("triway-local", misplaced=Slope(intercept=0.4, slope=-0.5))
    scaled = outliers(changed, scene).misplaced
    for one, other in zip(plain, scaled, strict=True):
        assert (one.subject, one.relation, one.object) == (
            other.subject,
            other.relation,
            other.object,
        )
        z = math.log(one.probability / (1 - one.probability))
        assert other.probability == pytest.approx(sigmoid(0.4 + 0.5 * z), abs=1e-4)


@pytest.mark.parametrize(
    ("classes", "listed"), [([0, 1, 1, 8], 2), ([0, 1, 2], 3), ([8], 1), ([], 1)]
)
def test_missing_by_log_odds_and_listed_things(classes, listed):
    """Structure and further instances do not count; there is at least one."""
    entry = CountSlope(intercept=0.4, slope=0.6, log_count=-0.5)
    artifact = larger_artifact("triway-local", missing=entry)
    answers = missing(artifact, scene_of(classes), top_k=9)
    for answer in answers:
        z = 0.4 + 0.6 * answer.log_odds - 0.5 * math.log(listed)
        assert answer.probability == pytest.approx(sigmoid(z), abs=1e-5)
    assert [a.log_odds for a in answers] == sorted((a.log_odds for a in answers), reverse=True)


@pytest.mark.parametrize("relation", ["left", "behind"])
def test_missing_at_a_place_is_there_and_stands_so(relation):
    """The two probabilities that the answer without a place gives, multiplied."""
    entry = CountSlope(intercept=-0.2, slope=0.8, log_count=0.3)
    # So low that no relation excludes its opposite.
    slopes = (PairSlope(intercept=-3.0, slope=0.7, log_count=-0.4, bends=((-3.5, 0.5),)),) * 4
    artifact = larger_artifact("triway-local", missing=entry, placement=slopes)
    scene = scene_of([0, 1, 1])
    anywhere = {a.label: a.probability for a in missing(artifact, scene, top_k=9)}
    answers = missing(artifact, scene, at=(relation, 1), top_k=9)
    assert {a.label for a in answers} == anywhere.keys()
    for answer in answers:
        place = answer.placements[0]
        assert (place.relation, place.object) == (relation, 1)
        expected = anywhere[answer.label] * place.probability
        assert answer.probability == pytest.approx(expected, rel=1e-4)


def test_a_place_that_is_asked_about_has_entries_of_its_own():
    """The others keep those of placements."""
    listed, asked = (PairSlope(intercept=b, slope=0.0) for b in (-2.0, -1.0))
    artifact = larger_artifact("triway-local", placement=(listed,) * 4, asked_place=(asked,) * 4)
    for answer in missing(artifact, scene_of([0, 1, 1]), at=("left", 1), top_k=9):
        first, *others = answer.placements
        assert (first.relation, first.object) == ("left", 1)
        assert first.probability == pytest.approx(sigmoid(-1.0), abs=1e-6)
        assert [p.probability for p in others] == pytest.approx([sigmoid(-2.0)] * 2, abs=1e-6)


def test_structure_is_never_an_intruder():
    """Class 8 is structure."""
    found = outliers(larger_artifact("triway-local"), scene_of([8, 0, 1, 8])).outliers
    assert [one.object for one in found[-2:]] == [0, 3]
    assert [one.probability for one in found[-2:]] == [0.0, 0.0]
    assert not any(one.is_outlier for one in found[-2:])
    assert all(one.probability > 0 for one in found[:-2])
