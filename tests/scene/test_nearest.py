"""The names nearest to an unknown one."""

from __future__ import annotations

import pytest

from app.scene.nearest import ACCEPTED
from app.scene.vocabulary import ObjectClass, Vocabulary

VOCABULARY = Vocabulary(
    [
        ObjectClass("fridge", ("refrigerator",)),
        ObjectClass("magnet", ("fridge magnet",)),
        ObjectClass("tree"),
        ObjectClass("bridge"),
        ObjectClass("mug"),
        ObjectClass("chair", ("wooden chair",)),
        ObjectClass("computer chair", ("office chair", "desk chair")),
        ObjectClass("toilet paper", ("toilet paper roll",)),
        ObjectClass("nightstand"),
        ObjectClass("door", structure=True),
    ],
    ("bedroom", "living room", "bathroom"),
)


def nearest(label: str) -> tuple[str, float]:
    best = VOCABULARY.nearest(label)[0]
    return VOCABULARY.labels[best.entry], best.similarity


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("fridgee", "fridge"),
        ("Refridgerator", "fridge"),
        ("nigthstand", "nightstand"),
        ("coffee mugs", "mug"),
        ("office swivel chair", "computer chair"),
        ("roll of toilet paper", "toilet paper"),
        ("big white mug", "mug"),
        ("red office chair", "computer chair"),
    ],
)
def test_a_name_like_a_known_one_is_taken_for_it(label: str, expected: str) -> None:
    found, similarity = nearest(label)
    assert found == expected
    assert similarity >= ACCEPTED


@pytest.mark.parametrize("label", ["swivel chair", "droid", "asdf", "x" * 100, "∞", "mug rack"])
def test_what_may_be_anything_is_taken_for_nothing(label: str) -> None:
    """Also a kind of chair: there are several, and the last word alone does not tell which."""
    assert all(match.similarity < ACCEPTED for match in VOCABULARY.nearest(label))


def test_names_that_begin_otherwise_are_seldom_misspelt() -> None:
    assert nearest("magnot")[1] >= ACCEPTED > nearest("tagnet")[1]


def test_only_plausible_names_are_suggested_best_first() -> None:
    assert VOCABULARY.suggest("fridgee") == ("fridge",)
    assert VOCABULARY.suggest("swivel chair") == ("chair",)
    assert VOCABULARY.suggest("droid") == ()
    assert len(VOCABULARY.nearest("chair of fridge", limit=1)) <= 1
    similarities = [match.similarity for match in VOCABULARY.nearest("desk chairs x", limit=9)]
    assert similarities == sorted(similarities, reverse=True)
    assert all(0 <= similarity <= 1 for similarity in similarities)


def test_room_types_have_neighbours_too() -> None:
    assert [match.entry for match in VOCABULARY.nearest_room("bedrom")] == [0]
    assert VOCABULARY.nearest_room("garage") == ()
