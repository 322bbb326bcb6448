from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.labels import label_key, singular

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
