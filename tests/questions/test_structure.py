"""Structure (floor, wall): listing it changes no other answer, and it is never counted."""

from __future__ import annotations

import pytest

from app.registry.description import CountSlope, PlaceFit
from tests.questions.answers import missing, outliers, relations
from tests.questions.artifacts import LARGER, STRUCTURE, larger_artifact, lines, scene_of

# Every calibration depends on the number of classes.
COUNTED = CountSlope(intercept=-0.3, slope=0.8, log_count=-0.2)
COUNTS = {
    "missing": CountSlope(intercept=0.1, slope=0.9, log_count=-0.5),
    "outlier": CountSlope(intercept=0.2, slope=-0.8, log_count=0.3),
    "outlier_lines": lines(2.0, 1.0, 0.0, log_count=-0.4),
    "at": (PlaceFit(relation=0.5, counts=0.5, intercept=-0.2, slope=0.9),) * 5,
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


def test_a_list_of_structure_alone_is_a_list_of_one_class(artifact):
    """The logarithm of the number needs at least 1."""
    assert (
        outliers(artifact, scene_of([8])).threshold == outliers(artifact, scene_of([0])).threshold
    )
    of_wall, of_nothing = (
        {entry.label: entry.probability for entry in missing(artifact, scene_of(classes), top_k=9)}
        for classes in ([8], [])
    )
    assert of_wall == pytest.approx(of_nothing, rel=1e-5)
