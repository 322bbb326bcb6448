"""Where a missing object cannot stand."""

from __future__ import annotations

from app.registry import PairSlope
from app.scene.relations import ON_TOP
from tests.questions.answers import missing
from tests.questions.artifacts import larger_artifact, scene_of

# On-top is likelier than all other relations.
SLOPES = tuple(PairSlope(intercept=4.0 if a == ON_TOP else -4.0) for a in range(4))
ARTIFACT = larger_artifact("triway-local", placement=SLOPES)


def under(*stated: tuple[int, int, int]) -> set[int]:
    """Objects that any missing one would stand under."""
    found = missing(ARTIFACT, scene_of([0, 1, 2], list(stated)), top_k=9)
    places = [place for one in found for place in one.placements]
    return {place.object for place in places if place.relation == "under"}


def test_nothing_is_put_under_what_stands_on_something() -> None:
    assert 0 in under()
    assert 0 not in under((ON_TOP, 0, 1))
    assert 1 in under((ON_TOP, 0, 1))
