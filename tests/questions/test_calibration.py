"""The formulas of the calibration, and that the answers use them."""

import math

import pytest
from scipy.special import expit as sigmoid

from app.model.calibration import CountSlope, CoverageFit, PlaceFit
from tests.questions.answers import missing, outliers, relations, without_minimums
from tests.questions.artifacts import LARGER, STRUCTURE, larger_artifact, lines, scene_of

PLAIN = larger_artifact("triway")


def test_scenes_with_relations_have_entries_of_their_own():
    alone, given = (CountSlope(intercept=b, slope=0.0) for b in (-1.0, 1.0))
    artifact = larger_artifact("triway", relation=(alone,) * 5, relation_given=(given,) * 5)
    # At an intercept of 1, opposite relations exclude each other.
    for stated, p in ((None, sigmoid(-1)), ([(0, 0, 1)], 0.5)):
        entries = relations(artifact, scene_of([0, 1, 2], stated), top_k=99)
        of_others = [entry for entry in entries if {entry.subject, entry.object} != {0, 1}]
        assert len(of_others) == 20
        for entry in of_others:
            assert entry.probability == pytest.approx(p, rel=1e-5)


def test_placements_have_entries_of_their_own():
    """The place of `at` comes first, with an entry of its own."""
    placement = (CountSlope(intercept=-1.0, slope=0.0, log_count=-0.5),) * 5
    at = (PlaceFit(intercept=-2.0, relation=0.0),) * 5
    artifact = larger_artifact("triway", placement=placement, at=at)
    p = sigmoid(-1)
    for entry in missing(artifact, scene_of([0, 1, 2])):
        assert [place.probability for place in entry.placements] == [pytest.approx(p, rel=1e-5)] * 3
    with without_minimums():
        entries = missing(artifact, scene_of([0, 1, 1]), at=("left", 1), top_k=9)
    for entry in entries:
        first, *others = entry.placements
        assert (first.relation, first.object) == ("left", 1)
        assert first.probability == pytest.approx(sigmoid(-2), rel=1e-5)
        assert [place.probability for place in others] == [pytest.approx(p, rel=1e-5)] * 2


def test_instances_count_in_relations():
    """Three chairs and two lamps: log 6 for a pair of both classes, log 9 among the chairs."""
    entry = CountSlope(intercept=-2.0, slope=0.0, log_count=-0.5)
    artifact = larger_artifact("triway", relation=(entry,) * 5)
    entries = relations(artifact, scene_of([3, 3, 3, 1, 1]), top_k=100)
    p = {(entry.subject, entry.object): entry.probability for entry in entries}
    assert p[0, 3] == pytest.approx(sigmoid(-2 - 0.5 * math.log(6)), rel=1e-5)
    assert p[0, 1] == pytest.approx(sigmoid(-2 - 0.5 * math.log(9)), rel=1e-5)


@pytest.mark.parametrize(
    ("classes", "listed"), [([0, 1, 1, 8], 2), ([0, 1, 2], 3), ([8], 1), ([], 1)]
)
def test_missing_classes_by_log_odds_and_number_of_listed_classes(classes, listed):
    """Structure and further instances do not count. The number is at least 1."""
    slope = CountSlope(intercept=0.4, slope=0.6, log_count=-0.5)
    z = {entry.label: entry.log_odds for entry in missing(PLAIN, scene_of(classes), top_k=9)}
    for entry in missing(larger_artifact("triway", missing=slope), scene_of(classes), top_k=9):
        expected = 0.4 + 0.6 * z[entry.label] - 0.5 * math.log(listed)
        assert entry.log_odds == pytest.approx(expected, rel=1e-4, abs=1e-5)
        assert entry.probability == pytest.approx(sigmoid(expected), rel=1e-4)


@pytest.mark.parametrize("coverage", [0.1, 0.15, 0.4, 0.9, 1.0])
def test_missing_classes_at_a_stated_coverage(coverage):
    """All but one listed class counts as complete. A share below .15 counts as .15."""
    entry = CoverageFit(intercept=0.4, slope=0.6, log_count=-0.5, log_share=0.3, both=0.2, last=-1)
    artifact = larger_artifact("triway", covered=entry)
    scene = scene_of([0, 1, 2])
    raw = {e.label: e.log_odds for e in missing(PLAIN, scene, coverage=coverage, top_k=9)}
    log_n, log_s = math.log(3), math.log(max(coverage, 0.15))
    change = 0.4 - 0.5 * log_n + 0.3 * log_s + 0.2 * log_n * log_s - (coverage == 1)
    for found in missing(artifact, scene, coverage=coverage, top_k=9):
        expected = change + 0.6 * raw[found.label]
        assert found.log_odds == pytest.approx(expected, rel=1e-4, abs=1e-5)
        assert found.probability == pytest.approx(sigmoid(expected), rel=1e-4)


# Every calibration depends on the number of classes.
COUNTED = CountSlope(intercept=-0.3, slope=0.8, log_count=-0.2)
COUNTS = {
    "missing": CountSlope(intercept=0.1, slope=0.9, log_count=-0.5),
    "outlier": CountSlope(intercept=0.2, slope=-0.8, log_count=0.3),
    "outlier_lines": lines(2.0, 1.0, 0.0, log_count=-0.4),
    "at": (PlaceFit(relation=0.5, counts=0.5, intercept=-0.2),) * 5,
    **dict.fromkeys(("relation", "relation_given", "placement"), (COUNTED,) * 5),
}
STATED = [(2, 1, 0), (0, 1, 2)]


@pytest.fixture(params=LARGER)
def artifact(request):
    return larger_artifact(request.param, **COUNTS)


@pytest.mark.parametrize("stated", [None, STATED])
@pytest.mark.parametrize("room", [None, 1])
@pytest.mark.usefixtures("without_minimums")
def test_listed_structure_changes_no_answer_about_other_classes(artifact, stated, room):
    bare, with_wall = scene_of([0, 1, 2, 3], stated, room), scene_of([0, 1, 2, 3, 8], stated, room)
    assert missing(artifact, with_wall, at=("left", 0)) == missing(artifact, bare, at=("left", 0))
    assert relations(artifact, with_wall, top_k=99) == relations(artifact, bare, top_k=99)
    assert missing(artifact, with_wall) == missing(artifact, bare)
    one, two = (outliers(artifact, scene) for scene in (with_wall, bare))
    assert (one.threshold, one.misplaced) == (two.threshold, two.misplaced)
    judged = tuple(entry for entry in one.outliers if entry.label not in STRUCTURE)
    assert judged == two.outliers
