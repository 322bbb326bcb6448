"""Comparison of labels: one key for all spellings of a name.

Detectors, annotators and programmers spell a name in many ways ("Trash_Cans", "trash can",
"trashcan"). `label_key` removes differences of case, separators and a final plural, so that equal
keys mean the same label. Alias tables handle synonyms ("tv", "television").

`head_of` returns the object in a phrase with "of": a "bottle of milk" is a bottle, and a "pair of
shoes" is shoes.
"""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache
from typing import Final

_SEPARATORS: Final = re.compile(r"[\s_\-./'’‐-―]+")

# Endings that are not plurals, or whose singular has another meaning or does not exist. They also
# occur in compounds ("rain pants", "camera lens").
_NOT_PLURAL_ENDINGS: Final = (
    *("ss", "us", "is"),
    *("clothes", "pants", "jeans", "shorts", "trousers", "tights", "overalls", "pyjamas"),
    *("scissors", "pliers", "tweezers", "tongs", "binoculars", "goggles"),
    *("sunglasses", "eyeglasses", "readingglasses", "safetyglasses"),
    *("canvas", "lens", "thermos", "atlas", "christmas"),
)
# The same for whole words: "wine glasses" is a plural, but "glasses" alone means spectacles.
_NOT_PLURAL: Final = frozenset({"glasses", "gas", "news", "series", "vhs", "gps", "ups"})
# Plurals outside the rules below, also recognised at the end of a compound ("bookshelves").
_IRREGULAR: Final = (
    ("shelves", "shelf"),
    ("knives", "knife"),
    ("leaves", "leaf"),
    ("loaves", "loaf"),
    ("scarves", "scarf"),
    ("wolves", "wolf"),
    ("calves", "calf"),
    ("women", "woman"),
    ("men", "man"),
    ("people", "person"),
    ("children", "child"),
    ("feet", "foot"),
    ("teeth", "tooth"),
    ("geese", "goose"),
    ("mice", "mouse"),
    ("buses", "bus"),
    ("lenses", "lens"),
    ("skis", "ski"),
    ("taxis", "taxi"),
    ("menus", "menu"),
    ("cookies", "cookie"),
    ("brownies", "brownie"),
    ("movies", "movie"),
    ("hoodies", "hoodie"),
    ("selfies", "selfie"),
    ("smoothies", "smoothie"),
    ("shoes", "shoe"),
    ("canoes", "canoe"),
)
_IRREGULAR_ENDINGS: Final = tuple(plural for plural, _ in _IRREGULAR)


_OF: Final = re.compile(r"[\s_\-.]+of[\s_\-.]+", re.IGNORECASE)
# "bottle of milk" means the container; "pile of books" means the members of the collection.
_CONTAINERS: Final = frozenset(
    (
        *("bag", "basket", "bottle", "bowl", "box", "bucket", "can", "canister", "carton"),
        *("crate", "cup", "glass", "jar", "jug", "mug", "pack", "package", "packet"),
        *("pitcher", "plate", "pot", "tin", "tray", "tube", "vase"),
    )
)
_COLLECTIONS: Final = frozenset({"bunch", "pair", "piece", "pile", "row", "slice", "stack"})


def head_of(label: str) -> str | None:
    """Return the object in a phrase: "bottle" for "bottle of milk", "books" for "pile of books".

    Other labels give None.
    """
    parts = _OF.split(label, maxsplit=1)
    if len(parts) != 2:
        return None
    first = label_key(parts[0])
    if first in _CONTAINERS:
        return first
    return parts[1] if first in _COLLECTIONS else None


def singular(word: str) -> str:
    """Return the singular of a folded English noun; other words are returned unchanged.

    Covers regular endings (-ies, -ches, -shes, -xes, -sses, -oes, -s) and a short list of irregular
    plurals. docs/decisions/data.md compares it with a general inflection library.
    """
    if word.endswith(_IRREGULAR_ENDINGS):
        for plural, single in _IRREGULAR:
            if word.endswith(plural):
                return word[: -len(plural)] + single
    if (
        len(word) < 3
        or not word.endswith("s")
        or word in _NOT_PLURAL
        or word.endswith(_NOT_PLURAL_ENDINGS)
    ):
        return word
    if word.endswith("ies") and len(word) > 4:
        stem = word[:-3] + "y"
    elif word.endswith(("ches", "shes", "xes", "sses", "oes")) and len(word) > 4:
        stem = word[:-2]
    else:
        stem = word[:-1]
    return singular(stem)  # "childrens" is a double plural


# Cached, because the models of a store mostly share their classes.
@lru_cache(maxsize=4096)
def label_key(label: str) -> str:
    """Return the key that all spellings of ``label`` share; idempotent.

    The key ignores case, compatibility characters, separators (whitespace, ``_ - . / '``) and a
    final plural: "Night-Stands", "night_stand" and "nightstand" have the key "nightstand". A label
    that consists of separators only has the empty key.
    """
    if label.isascii():
        return singular(_SEPARATORS.sub("", label.casefold()))
    # Repeated, because a fold can enable another one: a separate accent joins its letter.
    while (folded := _fold_unicode(label)) != label:
        label = folded
    return label


def split_words(label: str) -> tuple[str, ...]:
    """Return the words of a label in the singular, folded as in `label_key`."""
    folded = unicodedata.normalize("NFKC", label).casefold()
    return tuple(singular(word) for word in _SEPARATORS.split(folded) if word)


def _fold_unicode(label: str) -> str:
    composed = unicodedata.normalize("NFKC", label).casefold()
    return singular(_SEPARATORS.sub("", unicodedata.normalize("NFKC", composed)))
