"""Comparison of labels: all spellings of a name have the same key.

Detectors, annotators and programmers spell a name in many ways ("Trash_Cans", "trash can",
"trashcan"). The key of a label (`label_key`) has no separators, capitals or final plural. Labels
with the same key name the same class. The vocabulary lists synonyms ("tv", "television") as
aliases.

`head_of` returns the object in a phrase with "of": a "bottle of milk" is a bottle, and a "pair of
shoes" is shoes. `readings` removes the syntax of detectors: a "mouse_(computer_equipment)" is a
mouse, and "chair_12" is a chair.
"""

import re
import unicodedata
from collections.abc import Iterator
from functools import lru_cache
from itertools import islice
from typing import Final, Literal, NamedTuple

Rule = Literal[
    "label", "alias", "phrase", "qualifier", "alternative", "article", "instance", "prompt",
    "spelling", "head",
]  # fmt: skip
"""How a label was read. The rules "spelling" and "head" are guesses of `app.scene.nearest`."""


class LookUp(NamedTuple):
    """The index of the class or room type that a label becomes, and the rule."""

    entry: int
    similarity: float  # of both names, from 0 to 1
    rule: Rule

    @property
    def is_certain(self) -> bool:
        """Whether every request accepts the label. Other labels need `unknown_labels: nearest`."""
        return self.rule not in ("spelling", "head")


LONGEST: Final = 256
"""Maximum length of a name after Unicode normalisation, which can turn one character into 18."""

# The time of each pattern grows linearly with the length of a label: two repetitions that follow
# each other never match the same character.
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
    "knives": "knife", "women": "woman", "men": "man", "people": "person", "children": "child",
    "feet": "foot", "teeth": "tooth", "geese": "goose", "mice": "mouse", "buses": "bus",
    "lenses": "lens",
}  # fmt: skip
_IRREGULAR_ENDINGS: Final = tuple(_IRREGULAR)

_OF: Final = re.compile(r"[\s_\-.]of[\s_\-.]+", re.IGNORECASE)
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
    """Return "bottle" for "bottle of milk", "books" for "pile of books", None for other labels."""
    parts = _OF.split(label, maxsplit=1)
    if len(parts) != 2:
        return None
    first = label_key(parts[0])
    if first in _CONTAINERS:
        return first
    return parts[1] if first in _COLLECTIONS else None


def singular(word: str) -> str:
    """Return the singular of an English noun in lower case, or another word unchanged."""
    if word.endswith(_IRREGULAR_ENDINGS):
        for plural, single in _IRREGULAR.items():
            if word.endswith(plural):
                return word[: -len(plural)] + single
    if len(word) < 3 or not word.endswith("s"):
        return word
    if word in _NOT_PLURAL or word.endswith(_NOT_PLURAL_ENDINGS):
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
    a final plural: "Night-Stands", "night_stand" and "nightstand" have the key "nightstand". The
    key of a key is the same key. A label with more than `LONGEST` characters is its own key.
    """
    if label.isascii():
        return singular(_SEPARATORS.sub("", label.casefold()))
    # Without a separator, an accent can combine with the letter before it, so repeat this.
    while (folded := _fold_unicode(label)) != label:
        label = folded
    return label


def split_words(label: str) -> tuple[str, ...]:
    """Return the words of a label in lower case and singular; none of one longer than `LONGEST`."""
    folded = unicodedata.normalize("NFKC", label)
    if len(folded) > LONGEST:
        return ()
    return tuple(singular(word) for word in _SEPARATORS.split(folded.casefold()) if word)


def _fold_unicode(label: str) -> str:
    """Fold case, compatibility variants, separators and plural of a label; keep a long label."""
    composed = unicodedata.normalize("NFKC", label)
    if len(composed) > LONGEST:
        return label
    composed = unicodedata.normalize("NFKC", composed.casefold())
    return singular(_SEPARATORS.sub("", composed))


# ------------------------------------------------------------------------------------ syntax

# Labels of real detectors need at most four readings.
_MOST_READINGS: Final = 5
_MOST_READ_AGAIN: Final = 2

_QUALIFIED: Final = re.compile(r"([^\W_])[\s_]*\(([^()]*)\)")
_OR: Final = re.compile(r"[/\\,;]+")
_ARTICLE: Final = re.compile(r"(?:an?|the)[\s_]+", re.IGNORECASE)
_PROMPT: Final = re.compile(
    r"(?:an?|the)[\s_](?:[^\s_]+[\s_]){0,2}(?:photo|photograph|picture|image)[\s_]of[\s_]"
    r"(?:(?:an?|the|some|one)[\s_])?",
    re.IGNORECASE,
)
# Prefixes of instances: folders ("objects/bed"), scopes ("kitchen::table_1::link") and numbers
# ("011_banana"). Suffixes: senses of WordNet ("sofa.n.01"), coordinates ("Bed|-01.0|+00.0"),
# numbers ("chair_12", "cup.001", "chair12"), versions ("couch_v2") and hexadecimal ids that
# contain a digit ("Mug_b045e42b").
_FOLDER: Final = re.compile(r"(?:objects?|models?|assets?|meshes)/", re.IGNORECASE)
_LINKS: Final = frozenset({"", "link", "base_link", "body", "visual", "collision"})
_SENSE: Final = re.compile(r"([^\W\d][\w\-]*)\.[nvars]\.\d\d(?!\d)")
_NUMBER: Final = re.compile(r"\d+_")
_COORDINATES: Final = re.compile(r"[^\W\d_]\|")
# This pattern matches the reversed label. A search from the front would start at each letter.
_IDS: Final = re.compile(
    r"(?:(?:(?:%?(?=[a-f]*\d)[\da-f]+|\d+v)[\s_\-#.:]+)+|\d*)(?=[^\W\d_])", re.IGNORECASE
)


def readings(label: str) -> Iterator[tuple[Rule, str]]:
    """Yield pairs (rule, name) of the names in a detector's label, most certain name first."""
    return islice(_readings(label), _MOST_READINGS)


def _readings(label: str) -> Iterator[tuple[Rule, str]]:
    """Yield the readings by one rule, then those by a second rule on the first readings."""
    pairs = _by_one_rule(label)
    yield from pairs
    # Not "coffee table" of "table (coffee)", which joins two parts of the label.
    parts = [pair for pair in pairs if pair[1] in label]
    for first, name in parts[:_MOST_READ_AGAIN]:
        for rule, inner in _by_one_rule(name):
            if rule != first:
                yield first, inner


def _by_one_rule(label: str) -> list[tuple[Rule, str]]:
    """Return the readings by a single rule."""
    pairs: list[tuple[Rule, str]] = []
    if (match := _QUALIFIED.search(label)) is not None:
        name, qualifier = label[: match.end(1)], match[2]
        # The vocabulary can have a class for name and qualifier together.
        names = (f"{qualifier} {name}", f"{name} {qualifier}", name)
        pairs += [("qualifier", reading) for reading in names]
    pairs += [("alternative", part) for part in _alternatives(label)]
    prompt, article = _PROMPT.match(label), _ARTICLE.match(label)
    if prompt is None and article is not None:
        pairs.append(("article", label[article.end() :]))
    if (name := without_instance(label)) != label:
        pairs.append(("instance", name))
    if prompt is not None:
        pairs.append(("prompt", label[prompt.end() :]))
    return pairs


def _alternatives(label: str) -> list[str]:
    """Return the alternatives. In "coffee/side table", the alternatives share the last word."""
    parts = [part for part in map(str.strip, _OR.split(_in_folder(label), _MOST_READINGS)) if part]
    if len(parts) < 2:
        return []
    last_words = parts[-1].split()
    if len(last_words) > 1 and " " not in parts[0]:
        return [f"{parts[0]} {last_words[-1]}", *parts]
    return parts


def _in_folder(label: str) -> str:
    """Return the label without a folder of all objects, such as "objects/"."""
    return label if (folder := _FOLDER.match(label)) is None else label[folder.end() :]


def without_instance(label: str) -> str:
    """Return the label without the folder, scopes, sense, number, coordinates and ids."""
    scopes = [part for part in _in_folder(label).split("::") if part.casefold() not in _LINKS]
    whole = scopes[-1] if scopes else label
    if (sense := _SENSE.match(whole)) is not None:
        return sense[1]
    number = _NUMBER.match(whole)
    name = whole if number is None else whole[number.end() :]
    if (coordinates := _COORDINATES.search(name)) is not None:
        return name[: coordinates.start() + 1]
    ids = _IDS.match(name[::-1])
    return whole if ids is None else name[: len(name) - ids.end()]
