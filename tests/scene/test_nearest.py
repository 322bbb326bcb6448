"""The class that an unknown name probably stands for, and names similar to it."""

from __future__ import annotations

import pytest

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
        ObjectClass("wall", ("moulding",)),
        ObjectClass("flower", ("vase flower",)),
        ObjectClass("floor"),
        ObjectClass("vase"),
        ObjectClass("cell phone", ("cell",)),
        ObjectClass("toy"),
    ],
    ("bedroom", "living room", "bathroom"),
)


@pytest.mark.parametrize(
    ("label", "expected", "rule"),
    [
        ("fridgee", "fridge", "spelling"),
        ("Refridgerator", "fridge", "spelling"),
        ("nigthstand", "nightstand", "spelling"),
        ("fridge magnett", "magnet", "spelling"),
        ("toiled paper", "toilet paper", "spelling"),  # the other word confirms it
        ("walll", "wall", "spelling"),
        ("the refridgerator_3", "fridge", "spelling"),
        ("coffee mugs", "mug", "head"),
        ("swivel chair", "chair", "head"),
        ("red office chair", "computer chair", "head"),
        ("chair on wheels", "chair", "head"),
        ("vase with sand", "vase", "head"),
        ("a photo of a big chair", "chair", "head"),
        ("toy mug", "toy", "head"),
    ],
)
def test_a_name_is_guessed_by_its_spelling_or_its_last_words(
    label: str, expected: str, rule: str
) -> None:
    found = VOCABULARY.guess(label)
    assert found is not None
    assert (VOCABULARY.labels[found.entry], found.rule) == (expected, rule)
    assert 0.7 < found.similarity <= 1


@pytest.mark.parametrize(
    "label",
    [
        *("droid", "asdf", "x" * 100, "∞", "mug rack", "chair leg", "tres", "tagnet"),
        "floer",  # two classes are near
        "jail cell",  # another meaning
        "wal",  # a short word can be anything
        *("mug and chair", "vase with flowers"),  # two objects
        " ".join(["refrigeratr", "nigthstand", "wodden", "chairr"] * 2),
    ],
)
def test_an_ambiguous_name_has_no_guess(label: str) -> None:
    assert VOCABULARY.guess(label) is None


def test_only_plausible_names_are_suggested_best_first() -> None:
    def suggest(label: str) -> list[str]:
        return [VOCABULARY.labels[match.entry] for match in VOCABULARY.nearest(label)]

    assert suggest("fridgee") == ["fridge"]
    assert suggest("swivel chair")[0] == "chair"
    assert suggest("droid") == []
    assert len(VOCABULARY.nearest("chair of fridge", limit=1)) <= 1
    similarities = [match.similarity for match in VOCABULARY.nearest("desk chairs x", limit=9)]
    assert similarities == sorted(similarities, reverse=True)
    assert all(0 <= similarity <= 1 for similarity in similarities)


def test_similar_room_types_are_found() -> None:
    assert [match.entry for match in VOCABULARY.nearest("bedrom", is_room=True)] == [0]
    assert VOCABULARY.nearest("garage", is_room=True) == ()
    found = VOCABULARY.guess("bedrom", is_room=True)
    assert found is not None
    assert found.entry == 0
    assert VOCABULARY.guess("garage", is_room=True) is None
