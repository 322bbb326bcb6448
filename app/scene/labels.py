"""How labels are compared: one key for every spelling of a name.

Detectors, annotators and programmers write one thing in many ways ("Trash_Cans", "trash can",
"trashcan"). `label_key` folds case, separators and a final plural, so that equal keys mean the same
label. Synonyms ("tv", "television") are the business of alias tables, not of spelling.

`head_of` names the thing of a phrase with "of": a bottle of milk is a bottle, a pair of shoes is
shoes.
"""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache
from typing import Final

_SEPARATORS: Final = re.compile(r"[\s_\-./'’‐-―]+")

# Endings that are no plural, or whose singular is another thing or no word: also in compounds
# ("rain pants", "camera lens").
_NOT_PLURAL_ENDINGS: Final = (
    *("ss", "us", "is"),
    *("clothes", "pants", "jeans", "shorts", "trousers", "tights", "overalls", "pyjamas"),
    *("scissors", "pliers", "tweezers", "tongs", "binoculars", "goggles"),
    *("sunglasses", "eyeglasses", "readingglasses", "safetyglasses"),
    *("canvas", "lens", "thermos", "atlas", "christmas"),
)
# The same for whole words: a wine glass has the plural "wine glasses", but "glasses" are worn.
_NOT_PLURAL: Final = frozenset({"glasses", "gas", "news", "series", "vhs", "gps", "ups"})
# Plurals that no rule below forms, recognised at the end of a compound ("bookshelves").
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
# A container with its contents is the container; a collection is its members.
_CONTAINERS: Final = frozenset(
    (
        *("bag", "basket", "bottle", "bowl", "box", "bucket", "can", "canister", "carton"),
        *("crate", "cup", "glass", "jar", "jug", "mug", "pack", "package", "packet"),
        *("pitcher", "plate", "pot", "tin", "tray", "tube", "vase"),
    )
)
_COLLECTIONS: Final = frozenset({"bunch", "pair", "piece", "pile", "row", "slice", "stack"})


def head_of(label: str) -> str | None:
    """The thing that a phrase names: "bottle of milk" is "bottle", "pile of books" is "books".

    None where the label is another phrase.
    """
    parts = _OF.split(label, maxsplit=1)
    if len(parts) != 2:
        return None
    first = label_key(parts[0])
    if first in _CONTAINERS:
        return first
    return parts[1] if first in _COLLECTIONS else None


def singular(word: str) -> str:
    """The singular of a folded English noun; a word that is not a plural is returned as it is.

    Regular endings (-ies, -ches, -shes, -xes, -sses, -oes, -s) and a short list of irregular ones.
    Compared with a general inflection library in docs/decisions/data.md.
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


# The models of a store name mostly the same classes.
@lru_cache(maxsize=4096)
def label_key(label: str) -> str:
    """The key under which every spelling of ``label`` is found; idempotent.

    Case, compatibility characters, separators (whitespace, ``_ - . / '``) and a final plural are
    folded away: "Night-Stands", "night_stand" and "nightstand" share the key "nightstand". A label
    of separators alone has the empty key.
    """
    if label.isascii():
        return singular(_SEPARATORS.sub("", label.casefold()))
    # Folding can leave text that folds further: a spaced accent joins its letter, and so on.
    while (folded := _fold_unicode(label)) != label:
        label = folded
    return label


def split_words(label: str) -> tuple[str, ...]:
    """The words of a label in the singular, folded as in `label_key`."""
    folded = unicodedata.normalize("NFKC", label).casefold()
    return tuple(singular(word) for word in _SEPARATORS.split(folded) if word)


def _fold_unicode(label: str) -> str:
    composed = unicodedata.normalize("NFKC", label).casefold()
    return singular(_SEPARATORS.sub("", unicodedata.normalize("NFKC", composed)))
