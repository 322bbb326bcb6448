"""Comparison of labels: all spellings of a name have the same key.

Detectors, annotators and programmers spell a name in many ways ("Trash_Cans", "trash can",
"trashcan"). The key of a label (`label_key`) has no separators, capitals or final plural. Labels
with the same key name the same class. The vocabulary lists synonyms ("tv", "television") as
aliases.

`head_of` returns the object in a phrase with "of": a "bottle of milk" is a bottle, and a "pair of
shoes" is shoes. `readings` removes the syntax of detectors: a "mouse_(computer_equipment)" is a
mouse, and "chair_12" is a chair. `names_nothing` finds labels without an object, such as "unknown".
"""

import re
import unicodedata
from collections.abc import Iterator, Set
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
_INNER: Final = re.compile(r"(?<=[a-z])(?=[A-Z])|:")  # between the words of "cls:DeskLamp"
# Unicode has no decomposition of these letters.
_STROKES: Final = str.maketrans("łŁøØđĐħĦŧŦı", "lLoOdDhHtTi")

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


def plain_words(label: str) -> list[str]:
    """Return the words of a label in lower case; none of one longer than `LONGEST`."""
    folded = unicodedata.normalize("NFKC", label)
    if len(folded) > LONGEST:
        return []
    parts = _SEPARATORS.split(_INNER.sub(" ", folded).casefold())
    return [word for word in parts if word]


def split_words(label: str) -> tuple[str, ...]:
    """Return the words of a label in lower case and singular; none of one longer than `LONGEST`."""
    return tuple(map(singular, plain_words(label)))


def without_accents(label: str) -> str:
    """Return "lamp" for "łamp": a label without the accents and strokes of its letters."""
    decomposed = unicodedata.normalize("NFKD", label).translate(_STROKES)
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


def _fold_unicode(label: str) -> str:
    """Fold case, compatibility variants, separators and plural of a label; keep a long label."""
    composed = unicodedata.normalize("NFKC", label)
    if len(composed) > LONGEST:
        return label
    composed = unicodedata.normalize("NFKC", composed.casefold())
    return singular(_SEPARATORS.sub("", composed))


# ------------------------------------------------------------------------------------ no object

# Words of annotators and tools for the lack of an object. A label of such words alone names none.
_NOTHING: Final = frozenset(
    (
        *("unknown", "unk", "undefined", "undef", "unlabeled", "unlabelled", "unannotated"),
        *("unidentified", "unclassified", "uncategorized", "unrecognized", "unnamed", "untitled"),
        *("none", "null", "nil", "nan", "na", "notapplicable", "void", "invalid", "dontcare"),
        *("ignore", "ignored", "remove", "removed", "delete", "deleted", "split", "merge"),
        *("merged", "background", "groundplane", "placeholder", "todo", "tbd"),
    )
)
NEGATIONS: Final = frozenset(("no", "not", "non", "without", "never", "missing"))
# Catalogue numbers: offsets of WordNet, mids of Freebase, uuids and other hexadecimal ids.
_CATALOGUE: Final = re.compile(
    r"[nvars]\d{8}|/[mg]/[\da-z_]{2,}|(?=[a-f\-]*\d)[\da-f][\da-f\-]{5,}", re.IGNORECASE
)


def names_nothing(label: str, more: Set[str] = frozenset()) -> bool:
    """Return True for numbers, catalogue numbers and words such as "unknown", "REMOVE_2", "N/A".

    ``more`` are further words for the lack of an object.
    """
    if not any(map(str.isalpha, label)) or _CATALOGUE.fullmatch(label.strip()) is not None:
        return True
    words = [word for word in split_words(label) if not word.isdigit()]
    empty = _NOTHING | more
    return "".join(words) in empty or (bool(words) and empty.issuperset(words))


def names_an_object(label: str) -> bool:
    """Return False for labels that name nothing, and for negations such as "no chair"."""
    name = _end_of_path(label)
    is_negated = NEGATIONS.issuperset(plain_words(name)[:1])
    return not (is_negated or names_nothing(label) or (name != label and names_nothing(name)))


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
_WORD: Final = re.compile(r"[^\W_]+")
# These words describe an object also after its name: "dining_table_large".
_DESCRIPTIONS: Final = frozenset(
    "small medium large big tiny huge mini tall short long wide narrow upper lower left right "  # noqa: SIM905
    "open closed empty full old new red orange yellow green blue purple violet pink brown "
    "black white grey gray beige silver golden wooden metallic".split()
)
# Slashes separate the folders of a path, such as "/World/Table_1/Mug_2", if the label starts with
# one, or if it has "::", CamelCase, the number of an instance or one of these folders. Otherwise
# they separate alternatives.
_STEP: Final = re.compile(r"[/\\]+|::")
_PATH: Final = re.compile(r"\A[./\\~]|:[:/\\]|_\d+(?=[/\\]|\Z)|[a-z](?=[A-Z])")
_FOLDERS: Final = frozenset(("object", "model", "asset", "mesh", "prop", "world", "scene"))
_SPACED: Final = re.compile(r"\s[/\\]|[/\\]\s")
_FILE: Final = re.compile(
    r"\.(?:usd[acz]?|obj|dae|stl|glb|gltf|ply|fbx|off|urdf|sdf)\Z", re.IGNORECASE
)
# The last parts of a path often name parts of the object in a simulator.
_LINKS: Final = frozenset(
    ("link", "baselink", "body", "visual", "collision", "mesh", "geom", "geometry", "model")
)
_COORDINATES: Final = re.compile(r"[^\W\d_]\|")
# Versions ("couch_v2"), counts ("cup x2"), numbers, and hexadecimal ids that contain a digit
# ("Mug_b045e42b").
_ID: Final = re.compile(r"[vx]\d+|(?=[a-f]*\d)[\da-f]+", re.IGNORECASE)
_SENSES: Final = frozenset("nvars")  # of WordNet: "sofa.n.01"


def readings(label: str) -> Iterator[tuple[Rule, str]]:
    """Yield pairs (rule, name) of the names in a detector's label, most certain name first."""
    if not names_an_object(label):
        return
    name = _end_of_path(label)
    if name != label:
        yield "instance", name
    for rule, reading in islice(_readings(name), _MOST_READINGS):
        yield rule if name == label else "instance", reading


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
    elif (name := _without_description(label)) != label:
        pairs.append(("qualifier", name))
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
    parts = [part for part in map(str.strip, _OR.split(label, _MOST_READINGS)) if part]
    if len(parts) < 2:
        return []
    last_words = parts[-1].split()
    if len(last_words) > 1 and " " not in parts[0]:
        return [f"{parts[0]} {last_words[-1]}", *parts]
    return parts


def _without_description(label: str) -> str:
    """Return the label without sizes and colours after the name."""
    words = list(_WORD.finditer(label))
    end = len(words)
    while end > 1 and words[end - 1][0].casefold() in _DESCRIPTIONS:
        end -= 1
    return label[: words[end - 1].end()] if end < len(words) else label


def _end_of_path(label: str) -> str:
    """Return the last part of a path that names an object. Other labels stay unchanged."""
    parts = [part for part in _STEP.split(label) if part] or [label]
    is_path = _PATH.search(label) is not None or label_key(parts[0]) in _FOLDERS
    if not is_path or parts == [label] or _SPACED.search(label) is not None:
        parts = [label]
    while len(parts) > 1 and label_key(parts[-1].rstrip("_0123456789")) in _LINKS:
        parts.pop()
    return _FILE.sub("", parts[-1])


def without_instance(label: str) -> str:
    """Return the label without path, numbers, sense, coordinates, ids and outer punctuation."""
    name = _end_of_path(label)
    if (coordinates := _COORDINATES.search(name)) is not None:
        name = name[: coordinates.start() + 1]
    words = list(_WORD.finditer(name))
    first, end = 0, len(words)
    while end > 1 and _ID.fullmatch(words[end - 1][0]):
        end -= 1
    if 1 < end < len(words) and words[end - 1][0] in _SENSES:
        end -= 1
    while first < end - 1 and words[first][0].isdecimal():
        first += 1
    if not words:
        return label
    return name[words[first].start() : words[end - 1].end()].rstrip("0123456789") or label
