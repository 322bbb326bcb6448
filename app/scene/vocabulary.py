"""The object classes and room types of a model, and their accepted spellings."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, ClassVar, Final, NamedTuple, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike, NDArray

from app.scene.labels import (
    LookUp,
    Rule,
    head_of,
    label_key,
    names_an_object,
    readings,
    split_words,
    without_accents,
    without_instance,
)
from app.scene.nearest import Match, NameIndex
from app.scene.scene import SceneObject
from app.scene.words import Vectors, class_vectors, word_vectors

Extents = tuple[float, float, float]

_TIGHT: Final = 1.2  # ratio of extents up to which a box fits into another box
_MOST_REMEMBERED: Final = 4096  # results of searches
_LONGEST: Final = 100  # characters of a remembered label, the maximum in a request
_MOST_GUESSED: Final = 3  # alternatives of a label
_MOST_BROADER: Final = 16  # broader classes of a class; shipped classes have up to 4


class Word(NamedTuple):
    """A word without a class, and its meaning."""

    name: str  # in lower case and in the singular
    vector: Vectors  # word vector of length 1
    nearest: int  # class with the most similar word vector
    similarity: float  # cosine of the angle between both vectors, from 0 to 1


SearchT = TypeVar("SearchT", bound=Callable[..., Any])


def _remembered(search: SearchT) -> SearchT:
    """Return a method of `Vocabulary` that remembers the results of another one."""

    @wraps(search)
    def recall(self: "Vocabulary", label: str, *, is_room: bool = False) -> Any:
        """Return the remembered result for a label, or search and remember the result."""
        memory, key = self._memory, (search.__name__, label, is_room)
        result = memory.get(key, memory)  # a result may be None
        if result is memory:
            result = search(self, label, is_room=is_room)
            if len(memory) >= _MOST_REMEMBERED:
                memory.clear()  # in one step, because other threads read the memory
            if len(label) <= _LONGEST:
                memory[key] = result
        return result

    return cast("SearchT", recall)


@dataclass(frozen=True, slots=True)
class ObjectClass:
    """An object class.

    A structural class is a part of the building (floor, wall) or a vague name (object). Scenes may
    contain structural classes, but a model never proposes them.

    Raises:
        ValueError: the size is not three positive finite numbers.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid"}  # for classes in JSON

    label: str
    aliases: tuple[str, ...] = ()  # synonyms; other spellings and plurals do not need an alias
    structure: bool = False
    size: Extents | None = None  # typical extents (x, y, z) in metres, z vertical
    parent: str | None = None  # label of the broader class, such as "lamp" for "floor lamp"
    anywhere: bool = False  # whether its objects belong in every room (pets, people, bags, toys)

    def __post_init__(self) -> None:
        sides: Sequence[float] = (1.0, 1.0, 1.0) if self.size is None else self.size
        if len(sides) != 3 or not all(math.isfinite(side) and side > 0 for side in sides):
            raise ValueError(
                f"size of {self.label!r} must be three positive numbers (metres), not {self.size!r}"
            )


@dataclass(unsafe_hash=True, repr=False)
class Vocabulary:
    """The V object classes and C room types of a model, in a fixed order. Do not change it.

    `parents` has the index of the parent of each class, -1 without a parent. The first `trained`
    classes are not those of words (`with_words`). `stand_in` is the class whose counts and
    relations each class has: itself, or the nearest class for a word.

    Raises:
        ValueError: the list of classes is empty, a name is empty, a key of `room_aliases` is not a
            room type, a parent is not a class or its own ancestor, a class has too many broader
            classes, or two classes, or two room types, have names with the same `label_key`.
    """

    objects: Sequence[ObjectClass]
    room_types: Sequence[str] = ()
    room_aliases: Mapping[str, Sequence[str]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        """Validate the names, and build the tables for look-ups by spelling and by `label_key`."""
        if not self.objects:
            raise ValueError("a vocabulary needs at least one object class")
        self.objects = tuple(self.objects)
        self.room_types = tuple(self.room_types)
        self.room_aliases = {room: tuple(names) for room, names in self.room_aliases.items()}
        if others := self.room_aliases.keys() - set(self.room_types):
            raise ValueError(f"room_aliases names unknown room types: {sorted(others)}")
        names = [(entry.label, *entry.aliases) for entry in self.objects]
        clash = "two object classes have the name {name!r}: {first!r} and {second!r}"
        self._by_spelling, self._by_key = _tables(names, "an object class", clash)
        self._bare = {name: SceneObject(name, name, k) for name, k in self._by_spelling.items()}
        self.parents = self._parent_indices()
        self.trained = len(self.objects)
        self.stand_in = _read_only(np.arange(self.trained))
        names = [(room, *self.room_aliases.get(room, ())) for room in self.room_types]
        clash = "room types {first!r} and {second!r} have the same name"
        self._room_by_spelling, self._room_by_key = _tables(names, "a room type", clash)
        self._memory: dict[tuple[str, str, bool], Any] = {}

    def _parent_indices(self) -> NDArray[np.int64]:
        """Return the index of the parent of each class, or -1. Refuse circles of parents."""
        index_of = {entry.label: index for index, entry in enumerate(self.objects)}
        parents = np.full(len(self.objects), -1, dtype=np.int64)
        for index, entry in enumerate(self.objects):
            if entry.parent is not None:
                if (parent := index_of.get(entry.parent)) is None:
                    text = f"the parent {entry.parent!r} of {entry.label!r}"
                    raise ValueError(f"{text} is not the label of a class")
                parents[index] = parent
        # Each pass goes one parent up. In a circle, a class becomes its own ancestor.
        ancestors = parents.copy()
        for _ in range(_MOST_BROADER):
            if (own := np.flatnonzero(ancestors == np.arange(len(ancestors)))).size:
                raise ValueError(f"{self.objects[own[0]].label!r} is its own ancestor")
            ancestors = np.where(ancestors < 0, -1, parents[ancestors])
        if (deep := np.flatnonzero(ancestors >= 0)).size:
            label = self.objects[deep[0]].label
            raise ValueError(f"{label!r} has more than {_MOST_BROADER} broader classes")
        return _read_only(parents)

    def __len__(self) -> int:
        return len(self.objects)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The canonical labels in the order of the class indices."""
        return tuple(entry.label for entry in self.objects)

    # The arrays are read-only.

    @cached_property
    def structure(self) -> Bool[NDArray[np.bool_], "V"]:
        """True for structural classes, which a model never proposes."""
        return _read_only([entry.structure for entry in self.objects])

    @cached_property
    def anywhere(self) -> Bool[NDArray[np.bool_], "V"]:
        """True for classes whose objects belong in every room."""
        return _read_only([entry.anywhere for entry in self.objects])

    @cached_property
    def judged(self) -> Bool[NDArray[np.bool_], "V"]:
        """True for classes that can be intruders: neither structure nor `anywhere`."""
        return _read_only(~(self.structure | self.anywhere))

    @cached_property
    def sizes(self) -> Float[NDArray[np.float64], "V 3"]:
        """Typical extents in metres, or NaN for classes of unknown size."""
        return _read_only([entry.size or (math.nan,) * 3 for entry in self.objects])

    @cached_property
    def broader(self) -> Bool[NDArray[np.bool_], "V V"]:
        """True if class j is the parent of class i, or a parent of its parent."""
        is_broader = np.zeros((len(self), len(self)), np.bool_)
        rows, ancestors = np.arange(len(self)), self.parents
        while (has_parent := ancestors >= 0).any():
            is_broader[rows[has_parent], ancestors[has_parent]] = True
            ancestors = np.where(has_parent, self.parents[ancestors], -1)
        return _read_only(is_broader)

    @cached_property
    def broader_labels(self) -> tuple[tuple[str, ...], ...]:
        """The labels of the broader classes of each class, nearest first."""
        chains: list[tuple[str, ...]] = []
        for parent in self.parents.tolist():
            chain = []
            while parent >= 0:
                chain.append(self.labels[parent])
                parent = int(self.parents[parent])
            chains.append(tuple(chain))
        return tuple(chains)

    @cached_property
    def related(self) -> Bool[NDArray[np.bool_], "V V"]:
        """True if one of the classes i and j is broader than the other: one family."""
        return _read_only(self.broader | self.broader.T)

    def bare_objects(self, labels: Sequence[str]) -> tuple[SceneObject, ...] | None:
        """Return stored objects without id and pose, or None if a label has a new spelling."""
        objects = tuple(map(self._bare.get, labels))
        return None if None in objects else objects  # type: ignore[return-value]

    def index(self, label: str) -> int | None:
        """Return the index of the class with this label, or None for an unknown label.

        The method accepts all spellings with the same `label_key`. For an unknown phrase such as
        "bottle of milk", it looks up the object in the phrase, a bottle (`head_of`).
        """
        index = self._by_spelling.get(label)
        if index is None:
            index = self._by_key.get(label_key(label))
        if index is None and (head := head_of(label)) is not None:
            index = self._by_key.get(label_key(head))
        return index

    def look_up(self, label: str) -> LookUp | None:
        """Return the class that a label names or probably stands for, or None."""
        return self.read(label) or self.guess(label)

    @_remembered
    def read(self, label: str, *, is_room: bool = False) -> LookUp | None:
        """Return the class or room type that a label or one of its `readings` names, or None."""
        index_of = self.room_index if is_room else self.index
        if (index := index_of(label)) is not None:
            return LookUp(index, 1.0, self._rule_of(label, index, is_room=is_room))
        for rule, name in readings(label):
            if (index := index_of(name)) is not None:
                return LookUp(index, 1.0, rule)
        words = split_words(without_instance(label))
        # "trash bin can": a trash bin, and a trash can.
        index = index_of("".join(words[:-1]))
        if index is not None and index == index_of("".join((*words[:-2], words[-1]))):
            return LookUp(index, 1.0, "alternative")
        plain = without_accents(label)
        return None if plain == label else self.read(plain, is_room=is_room)

    def _rule_of(self, label: str, index: int, *, is_room: bool) -> Rule:
        """Return why `index` or `room_index` gives this index for a label."""
        key = label_key(label)
        if key == label_key((self.room_types if is_room else self.labels)[index]):
            return "label"
        return "alias" if key in (self._room_by_key if is_room else self._by_key) else "phrase"

    def room_index(self, room: str) -> int | None:
        """Return the index of a room type in any spelling, or None for an unknown room type."""
        return self._room_by_key.get(label_key(room))

    @cached_property
    def _names(self) -> NameIndex:
        return NameIndex(list(self._by_spelling.items()), self.parents.tolist())

    @cached_property
    def _room_names(self) -> NameIndex:
        return NameIndex(list(self._room_by_spelling.items()))

    @_remembered
    def nearest(self, label: str, *, is_room: bool = False) -> tuple[Match, ...]:
        """Return up to three plausible classes or room types, most similar name first.

        The search compares every label and alias, so it is much slower than `index`.
        """
        return (self._room_names if is_room else self._names).nearest(label, 3)

    @_remembered
    def guess(self, label: str, *, is_room: bool = False) -> LookUp | None:
        """Return the class or room type that an unknown label probably stands for, or None."""
        if not is_room and self.room_index(label) is not None:
            return None  # the "hall" of "dining hall" is a corridor
        names = self._room_names if is_room else self._names
        guesses = (names.guess(name) for name in _names_to_guess(label))
        return next((guess for guess in guesses if guess is not None), None)

    @cached_property
    def vectors(self) -> tuple[Vectors, NDArray[np.bool_]]:
        """Word vectors of the classes, (V, dimensions), and True for known vectors, (V,)."""
        names = [(entry.label, *entry.aliases) for entry in self.objects]
        return class_vectors(word_vectors(), names, self.parents.tolist())

    def meaning(self, label: str) -> Word | None:
        """Return the word that a label names and the class nearest to it by word vectors, or None.

        The method is for labels that `read` and `guess` do not know. It compares the label with all
        classes. The result is None for a label without a word vector.
        """
        for text in _names_to_guess(label):
            name = " ".join(split_words(text))
            vector, (vectors, has_vector) = word_vectors().of(name), self.vectors
            # Structure has no weights, so it cannot predict those of a word.
            if vector is not None and (has_vector & ~self.structure).any():
                cosines = np.where(has_vector, vectors @ vector, -1.0)
                nearest = int(cosines.argmax())
                similarity = round(min(max(float(cosines[nearest]), 0.0), 1.0), 3)
                return Word(name, vector, nearest, similarity)
        return None

    def with_words(self, words: Sequence[Word]) -> "Vocabulary":
        """Return a vocabulary with a further class for each word, like its nearest class."""
        return _WithWords(self, words) if words else self

    def remembers(self, label: str, searches: Sequence[str], *, is_room: bool = False) -> bool:
        """Return whether methods, tried one after the other, know a label without a new search."""
        if label in (self._room_by_spelling if is_room else self._by_spelling):
            return True
        keys = [(search, label, is_room) for search in searches]
        # The first search with a result is the last one, or all searches were without a result.
        return keys[-1] in self._memory or any(map(self._memory.get, keys))

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-compatible values, without absent parents and flags."""
        aliases = {room: list(names) for room, names in self.room_aliases.items()}
        return {
            "objects": [
                {
                    "label": entry.label,
                    "aliases": list(entry.aliases),
                    "structure": entry.structure,
                    "size": None if entry.size is None else list(entry.size),
                }
                | ({"parent": entry.parent} if entry.parent is not None else {})
                | ({"anywhere": True} if entry.anywhere else {})
                for entry in self.objects
            ],
            "room_types": list(self.room_types),
        } | ({"room_aliases": aliases} if aliases else {})


class _WithWords(Vocabulary):
    """A vocabulary and the classes of some words, faster than a new one; see `with_words`."""

    def __init__(self, base: Vocabulary, words: Sequence[Word]) -> None:
        """Append a class for each word. The tables in `_SHARED` stay those of the base."""
        vars(self).update({name: vars(base)[name] for name in _SHARED})
        self._base, self._nearest = base, [word.nearest for word in words]
        self.trained = len(base)
        nearest = [base.objects[index] for index in self._nearest]
        self.objects = (
            *base.objects,
            *(
                replace(entry, label=word.name, aliases=(), size=None, parent=None)
                for word, entry in zip(words, nearest, strict=True)
            ),
        )
        self.parents = _read_only([*base.parents, *(-1 for _ in words)])
        self.stand_in = _read_only([*base.stand_in, *self._nearest])

    @cached_property
    def sizes(self) -> NDArray[np.float64]:
        return np.pad(self._base.sizes, ((0, len(self._nearest)), (0, 0)), constant_values=math.nan)

    @cached_property
    def broader(self) -> NDArray[np.bool_]:
        return np.pad(self._base.broader, (0, len(self._nearest)))

    @cached_property
    def broader_labels(self) -> tuple[tuple[str, ...], ...]:
        return (*self._base.broader_labels, *(() for _ in self._nearest))


# Attributes of a vocabulary that words leave as they are.
_SHARED: Final = (
    *("room_types", "room_aliases", "_by_spelling", "_by_key", "_bare"),
    *("_room_by_spelling", "_room_by_key", "_memory"),
)


def _names_to_guess(label: str) -> list[str]:
    """Return alternatives of an unknown label and the label, or its last reading, or the label."""
    if not names_an_object(label):
        return []
    pairs = list(readings(label))
    alternatives = [name for rule, name in pairs if rule == "alternative"]
    if alternatives:
        return [*alternatives, label][:_MOST_GUESSED]
    return [name for _, name in pairs][-1:] or [label]


def do_not_fit(
    sizes: Float[NDArray[np.float64], "N 3"], others: Float[NDArray[np.float64], "m 3"]
) -> tuple[Bool[NDArray[np.bool_], "N m"], Bool[NDArray[np.bool_], "N m"]]:
    """Return which of N boxes do not fit into which of m boxes, and which of the m into the N.

    A box fits into another box if each of its extents, in order of size, is at most `_TIGHT` times
    that of the other. A box of unknown size (NaN) fits everywhere.
    """
    sides, other_sides = np.sort(sizes, axis=1)[:, None], np.sort(others, axis=1)
    # A comparison with NaN is False.
    larger = sides > _TIGHT * other_sides, other_sides > _TIGHT * sides
    return np.any(larger[0], axis=2), np.any(larger[1], axis=2)


def _tables(
    names: Sequence[tuple[str, ...]], kind: str, clash: str
) -> tuple[dict[str, int], dict[str, int]]:
    """Return the index of each entry, a label and its aliases, by these names and by their keys."""
    by_spelling: dict[str, int] = {}
    by_key: dict[str, int] = {}
    for index, spellings in enumerate(names):
        for name in spellings:
            if not (key := label_key(name)):
                raise ValueError(f"{kind} has an empty name: {name!r}")
            if not name.isprintable():
                raise ValueError(f"{kind} has a name with a control character: {name!r}")
            if (first := by_key.setdefault(key, index)) != index:
                labels = {"first": names[first][0], "second": spellings[0]}
                raise ValueError(clash.format(name=name, **labels))
            by_spelling[name] = index
    return by_spelling, by_key


def _read_only(values: ArrayLike) -> NDArray[Any]:
    array = np.array(values)
    array.flags.writeable = False
    return array
