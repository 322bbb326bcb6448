"""Comparison of labels: all spellings of a name have the same key.

Detectors, annotators and programmers spell a name in many ways ("Trash_Cans", "trash can",
"trashcan"). The key of a label (`label_key`) has no separators, capitals or final plural. Labels
with the same key name the same class. The vocabulary lists synonyms ("tv", "television") as
aliases.

`head_of` returns the object in a phrase with "of": a "bottle of milk" is a bottle, and a "pair of
shoes" is shoes. `readings` removes the syntax of detectors: a "mouse_(computer_equipment)" is a
mouse, and "chair_12" is a chair.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Final, Literal

Rule = Literal[
    "alias",
    "phrase",
    "qualifier",
    "alternative",
    "article",
    "instance",
    "prompt",
    "spelling",
    "head",
]
"""How a label was read. The rules "spelling" and "head" are guesses of `app.scene.nearest`."""

_SEPARATORS: Final = re.compile(r"[\s_\-./'’‐-―]+")

# Words with these endings stay unchanged. Such words are not plurals, or their singular has another
# meaning or does not exist. Compounds with these endings also stay unchanged ("rain pants").
_NOT_PLURAL_ENDINGS: Final = (
    *("ss", "us", "is"),
    *("clothes", "pants", "jeans", "shorts", "trousers", "tights", "overalls", "pyjamas"),
    *("scissors", "pliers", "tweezers", "tongs", "binoculars", "goggles"),
    *("sunglasses", "eyeglasses", "readingglasses", "safetyglasses"),
    *("canvas", "lens", "thermos", "atlas", "christmas"),
)
# These words also stay unchanged, but compounds that end with them do not. For example, "glasses"
# means spectacles, but "wine glasses" is a plural.
_NOT_PLURAL: Final = frozenset({"glasses", "gas", "news", "series", "vhs", "gps", "ups"})
# Irregular plurals and their singulars. Compounds can end with these plurals ("bookshelves").
_ONLY_S: Final = (
    *("ski", "taxi", "menu", "shoe", "canoe"),
    *("cookie", "brownie", "movie", "hoodie", "selfie", "smoothie"),
)
_IRREGULAR: Final = {
    **{f"{word}s": word for word in _ONLY_S},
    **{f"{stem}ves": f"{stem}f" for stem in ("shel", "lea", "loa", "scar", "wol", "cal")},
    "knives": "knife",
    "women": "woman",
    "men": "man",
    "people": "person",
    "children": "child",
    "feet": "foot",
    "teeth": "tooth",
    "geese": "goose",
    "mice": "mouse",
    "buses": "bus",
    "lenses": "lens",
}
_IRREGULAR_ENDINGS: Final = tuple(_IRREGULAR)

_OF: Final = re.compile(r"[\s_\-.]+of[\s_\-.]+", re.IGNORECASE)
# The phrase "bottle of milk" means the container, a bottle. "pile of books" means the members,
# books.
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

    The result is None if the label is not such a phrase.
    """
    parts = _OF.split(label, maxsplit=1)
    if len(parts) != 2:
        return None
    first = label_key(parts[0])
    if first in _CONTAINERS:
        return first
    return parts[1] if first in _COLLECTIONS else None


def singular(word: str) -> str:
    """Return the singular of an English noun in lower case. Return other words unchanged.

    The function knows the regular endings (-ies, -ches, -shes, -xes, -sses, -oes, -s) and a short
    list of irregular plurals. docs/decisions/data.md compares it with a general inflection library.
    """
    if word.endswith(_IRREGULAR_ENDINGS):
        for plural, single in _IRREGULAR.items():
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
    return singular(stem)  # repeated for double plurals such as "childrens"


# The cache saves time, because the models of a store mostly have the same classes.
@lru_cache(maxsize=4096)
def label_key(label: str) -> str:
    """Return the key that all spellings of ``label`` share.

    The key ignores case, Unicode compatibility variants, separators (whitespace, ``_ - . / '``) and
    a final plural: "Night-Stands", "night_stand" and "nightstand" have the key "nightstand". A
    label that contains only separators has the empty key. The key of a key is the same key.
    """
    if label.isascii():
        return singular(_SEPARATORS.sub("", label.casefold()))
    # The loop repeats the normalisation until the label does not change. One pass is not enough: if
    # it removes a separator, an accent can combine with the letter before the separator.
    while (folded := _fold_unicode(label)) != label:
        label = folded
    return label


def split_words(label: str) -> tuple[str, ...]:
    """Return the words of a label in lower case and in the singular."""
    folded = unicodedata.normalize("NFKC", label).casefold()
    return tuple(singular(word) for word in _SEPARATORS.split(folded) if word)


def _fold_unicode(label: str) -> str:
    composed = unicodedata.normalize("NFKC", label).casefold()
    return singular(_SEPARATORS.sub("", unicodedata.normalize("NFKC", composed)))


# ------------------------------------------------------------------------------------ syntax

_QUALIFIED: Final = re.compile(r"(.*?[^\W_])[\s_]*\(([^()]*)\).*")
_OR: Final = re.compile(r"[/\\,;]+")
_MOST_ALTERNATIVES: Final = 8
_ARTICLE: Final = re.compile(r"(?:an?|the)[\s_]+(.+)", re.IGNORECASE)
# Suffixes: coordinates ("Bed|-01.0|+00.0"), numbers ("chair_12", "cup.001", "chair12") and
# hexadecimal ids that contain a digit ("Mug_b045e42b"). Prefixes: numbers ("011_banana").
_INSTANCE: Final = re.compile(
    r"(?:\d+_)?(.*?[^\W\d_])(?:\|.*|\d+|(?:[\s_\-#.:]+(?=[a-f]*\d)[\da-f]+%?)*)", re.IGNORECASE
)
_PROMPT: Final = re.compile(
    r"(?:an?|the)[\s_](?:[\w-]+[\s_]){0,2}(?:photo|photograph|picture|image)[\s_]of[\s_]"
    r"(?:(?:an?|the|some|one)[\s_])?(.+)",
    re.IGNORECASE,
)


def readings(label: str, depth: int = 2) -> Iterator[tuple[Rule, str]]:
    """Yield pairs (rule, name) of the names in a detector's label, most certain name first.

    Args:
        depth: maximum number of rules in sequence. For example, "a photo of a sofa/couch" needs
            two rules. The pair contains the first rule.
    """
    pairs = [(rule, name) for rule, read in _RULES.items() for name in read(label)]
    yield from pairs
    if depth > 1:
        for rule, name in pairs:
            yield from ((rule, inner) for _, inner in readings(name, depth - 1))


def _qualifier(label: str) -> list[str]:
    """Return name and qualifier together in both orders, and the name alone."""
    if (match := _QUALIFIED.fullmatch(label)) is None:
        return []
    name, qualifier = match.groups()
    return [f"{qualifier} {name}", f"{name} {qualifier}", name]


def _alternative(label: str) -> list[str]:
    """Return the alternatives. In "coffee/side table", the alternatives share the last word."""
    parts = [part for part in map(str.strip, _OR.split(label, _MOST_ALTERNATIVES)) if part]
    if len(parts) < 2:
        return []
    last_words = parts[-1].split()
    if len(last_words) > 1 and " " not in parts[0]:
        return [f"{parts[0]} {last_words[-1]}", *parts]
    return parts


def _matched(pattern: re.Pattern[str]) -> Callable[[str], list[str]]:
    """Return a function that returns group 1 of the pattern, unless it is the whole label."""

    def read(label: str) -> list[str]:
        match = pattern.fullmatch(label)
        return [] if match is None or match[1] == label else [match[1]]

    return read


_RULES: Final[dict[Rule, Callable[[str], list[str]]]] = {
    "qualifier": _qualifier,
    "alternative": _alternative,
    "article": _matched(_ARTICLE),
    "instance": _matched(_INSTANCE),
    "prompt": _matched(_PROMPT),
}
