from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.labels import label_key, singular
from app.scene.vocabulary import ObjectClass, Vocabulary

VOCABULARY = Vocabulary(
    [
        ObjectClass("garbage bin", ("trash can", "dustbin")),
        ObjectClass("tv", ("television",)),
        ObjectClass("glass", ("wine glass",), parent="glasses"),
        ObjectClass("glasses", ("spectacles",)),
        ObjectClass("curtain", size=(0.3, 0.3, 2.0)),
        ObjectClass("wall", structure=True),
        ObjectClass("dog", anywhere=True),
    ],
    ["bedroom", "living room"],
)


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("Trash_Cans", "garbage bin"),
        ("garbage_bin", "garbage bin"),
        ("TV", "tv"),
        ("Televisions", "tv"),
        ("curtains", "curtain"),
        ("glasses", "glasses"),
        ("wine glasses", "glass"),
        ("WALLS", "wall"),
    ],
)
def test_labels_are_found_under_any_spelling(label: str, expected: str) -> None:
    index = VOCABULARY.index(label)
    assert index is not None
    assert VOCABULARY.labels[index] == expected


@pytest.mark.parametrize("label", ["", "  ", "sofa", "trash", "can", "curtain rod"])
def test_unknown_labels_are_not_found(label: str) -> None:
    assert VOCABULARY.index(label) is None


def test_rooms_have_synonyms() -> None:
    aliases = {"storage room": ["pantry", "storeroom"]}
    words = Vocabulary([ObjectClass("box")], ["bedroom", "storage room"], aliases)
    assert [words.room_index(name) for name in ("Store Room", "pantry", "storage_room")] == [1] * 3
    assert words.nearest("storerom", is_room=True)[0].entry == 1
    assert Vocabulary.from_dict(words.to_dict()) == words
    with pytest.raises(ValueError, match="unknown room types"):
        Vocabulary([ObjectClass("box")], ["bedroom"], aliases)
    with pytest.raises(ValueError, match="same name"):
        Vocabulary([ObjectClass("box")], ["pantry", "storage room"], aliases)


def test_masks_and_sizes() -> None:
    assert VOCABULARY.structure.tolist() == [False] * 5 + [True, False]
    assert VOCABULARY.anywhere.tolist() == [False] * 6 + [True]
    assert VOCABULARY.parents.tolist() == [-1, -1, 3, -1, -1, -1, -1]
    assert VOCABULARY.sizes[4].tolist() == [0.3, 0.3, 2.0]
    assert np.isnan(VOCABULARY.sizes[[0, 1, 2, 3, 5, 6]]).all()
    with pytest.raises(ValueError, match="read-only"):
        VOCABULARY.structure[0] = True


def test_the_dictionary_form_survives_json() -> None:
    again = Vocabulary.from_dict(json.loads(json.dumps(VOCABULARY.to_dict())))
    assert again == VOCABULARY
    assert hash(again) == hash(VOCABULARY)
    assert again != Vocabulary(VOCABULARY.objects)
    assert len(again) == 7


def test_two_classes_cannot_share_a_name() -> None:
    with pytest.raises(ValueError, match=r"have the name 'Trash-Cans': 'bin' and 'can'"):
        Vocabulary([ObjectClass("bin", ("trash can",)), ObjectClass("can", ("Trash-Cans",))])
    with pytest.raises(ValueError, match="'bed room' and 'bedroom' have the same name"):
        Vocabulary([ObjectClass("bed")], ["bed room", "bedroom"])
    # An alias that is only another spelling of its own class is harmless.
    assert len(Vocabulary([ObjectClass("book", ("books",))])) == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "the field 'objects'"),
        ({"objects": []}, "at least one object class"),
        ({"objects": ["bed"]}, "mapping with a string 'label'"),
        ({"objects": [{"label": "bed", "aliases": "cot"}]}, "aliases of 'bed'"),
        ({"objects": [{"label": "bed", "aliases": ["_"]}]}, "empty name"),
        ({"objects": [{"label": "bed", "size": [1, 2, -1]}]}, "size of 'bed'"),
        ({"objects": [{"label": "bed", "size": [1, 2, float("nan")]}]}, "size of 'bed'"),
        ({"objects": [{"label": "bed", "colour": "red"}]}, "unknown fields.*colour"),
        ({"objects": [{"label": "bed", "parent": "cot"}]}, "parent 'cot' of 'bed' is not"),
        ({"objects": [{"label": "bed", "parent": "bed"}]}, "'bed' is its own ancestor"),
        (
            {"objects": [{"label": a, "parent": b} for a, b in ("ab", "bc", "cb")]},
            "'b' is its own ancestor",
        ),
        ({"objects": [{"label": "bed"}], "room_types": "attic"}, "room_types"),
        (
            {"objects": [{"label": "bed"}], "room_types": ["a"], "room_aliases": {"a": "b"}},
            "lists of strings",
        ),
        ({"objects": [{"label": "bed"}], "room_types": [""]}, "room type has an empty name"),
    ],
)
def test_malformed_dictionaries_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Vocabulary.from_dict(values)


# ------------------------------------------------------------------------------------------- labels


PLURALS = """
chairs/chair curtains/curtain sofas/sofa photos/photo tvs/tv boxes/box dishes/dish benches/bench
dresses/dress buses/bus batteries/battery shelves/shelf bookshelves/bookshelf knives/knife
gloves/glove vases/vase cases/case potatoes/potato shoes/shoe ties/tie wineglasses/wineglass
stairs/stair people/person women/woman mice/mouse
"""


@pytest.mark.parametrize("pair", PLURALS.split())
def test_plurals(pair: str) -> None:
    plural, single = pair.split("/")
    assert singular(plural) == singular(single) == single


@pytest.mark.parametrize(
    "word",
    [
        *("glass", "glasses", "sunglasses", "clothes", "scissors", "pants", "jeans", "shorts"),
        *("bus", "mattress", "grass", "dress", "cactus", "tennis", "gas", "canvas", "lens"),
        *("thermos", "chess", "as", "s", ""),
    ],
)
def test_words_that_are_not_plural_stay(word: str) -> None:
    assert singular(word) == word


def test_compatibility_characters_fold() -> None:
    assert label_key("TV") == label_key("ＴＶ") == "tv"
    assert label_key("Straße") == label_key("STRASSE")


@given(st.text(max_size=30), st.sampled_from(["_", " ", "-", ".", "  "]))
def test_keys_ignore_case_and_separators(label: str, separator: str) -> None:
    assert label_key(separator + label + separator) == label_key(label)
    assert label_key(label.casefold()) == label_key(label)
