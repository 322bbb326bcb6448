"""Placements of missing objects: the minimum of an entry, and impossible places."""

from __future__ import annotations

import math
from itertools import compress

import pytest

from app.registry import PairSlope
from app.scene.relations import ON_TOP
from tests.questions.answers import missing, without_minimums
from tests.questions.artifacts import larger_artifact, scene_of


def test_only_likely_places_and_strong_reasons_are_listed() -> None:
    """Places with 3/4 of the first place's probability, and reasons that change odds threefold."""
    scene = scene_of([0, 1, 2, 3], [(2, 1, 0)])
    further_places, reasons = [], []
    for artifact in map(larger_artifact, ("rbm", "triway-seed", "triway-wide")):
        with without_minimums():
            every = missing(artifact, scene)
        for entry, complete in zip(missing(artifact, scene), every, strict=True):
            first, *others = complete.placements
            likely = [place.probability >= 0.75 * first.probability for place in others]
            strong = [abs(one.log_odds_change) >= math.log(3) for one in complete.because]
            assert entry == complete._replace(
                placements=(first, *compress(others, likely)),
                because=(*compress(complete.because, strong),),
            )
            further_places += likely
            reasons += strong
    assert {*further_places} == {*reasons} == {True, False}


# On-top is likelier than all other relations.
SLOPES = tuple(PairSlope(intercept=4.0 if a == ON_TOP else -4.0) for a in range(4))
ARTIFACT = larger_artifact("triway-local", placement=SLOPES)


@pytest.mark.usefixtures("without_minimums")
def test_no_place_is_under_an_object_on_top_of_another() -> None:
    def under(*stated: tuple[int, int, int]) -> set[int]:
        entries = missing(ARTIFACT, scene_of([0, 1, 2], list(stated)), top_k=9)
        places = [place for entry in entries for place in entry.placements]
        return {place.object for place in places if place.relation == "under"}

    assert 0 in under()
    assert 0 not in under((ON_TOP, 0, 1))
    assert 1 in under((ON_TOP, 0, 1))
