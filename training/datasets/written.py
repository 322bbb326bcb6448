"""The vocabulary of written knowledge, from `things.csv` and inventories alone."""

import math
from collections import defaultdict
from collections.abc import Container, Iterable, Mapping
from dataclasses import replace
from functools import cache
from typing import Final

from app.scene import ObjectClass, Vocabulary, label_key
from training.datasets.inventories import Thing, shipped_inventory
from training.datasets.vocabulary import (
    INDOOR_FILE,
    curated_names,
    is_kind,
    read_vocabulary,
    with_room_aliases,
)

# A thing becomes a class if so many kinds of places are expected to have it.
LEAST_PLACES: Final = 0.5


@cache
def written_vocabulary() -> Vocabulary:
    """Build the vocabulary: the commonest things of the written places come first."""
    names, indoor = curated_names(), read_vocabulary(INDOOR_FILE)
    inventory = shipped_inventory()
    things, places = inventory.things, inventory.places
    expected: defaultdict[str, float] = defaultdict(float)
    for place in places:
        for group, item in place.items:
            expected[label_key(item.label)] += group.share * item.share
    indoor_class = {label_key(entry.label): entry for entry in indoor.objects}
    classes = {
        label: thing
        for label, thing in sorted(things.items(), key=lambda x: -expected[label_key(x[0])])
        if label_key(label) in indoor_class or expected[label_key(label)] >= LEAST_PLACES
    }
    # A thing without a class is a name of its nearest broader class. Curated names come last.
    aliases = _Aliases(classes)
    for thing in things.values():
        label = thing.label if thing.label in classes else _broader(thing, things, classes)
        aliases.add(label, (thing.label, *thing.other_names))
    for label in classes:
        if entry := indoor_class.get(label_key(label)):
            aliases.add(label, entry.aliases)
    structure = set(map(label_key, names.structure))
    objects = [
        ObjectClass(
            label,
            tuple(aliases.of[label]),
            structure=label_key(label) in structure,
            size=_size(thing),
            parent=_broader(thing, things, classes),
            anywhere=label in names.anywhere,
        )
        for label, thing in classes.items()
    ]
    rooms = {room for place in places if (room := names.canonical_room(place.room_type))}
    return with_room_aliases(Vocabulary(objects, sorted(rooms.union(indoor.room_types))))


def with_present_names(vocabulary: Vocabulary) -> Vocabulary:
    """Return the vocabulary with the names that its classes have in the written vocabulary today.

    The other classes keep their names. A name of two classes stays with the first.
    """
    present = {label_key(entry.label): entry.aliases for entry in written_vocabulary().objects}
    taken = set(map(label_key, vocabulary.labels))
    objects = []
    for entry in vocabulary.objects:
        names = present.get(label_key(entry.label), entry.aliases)
        aliases = {key: name for name in names if (key := label_key(name)) not in taken}
        taken.update(aliases)
        objects.append(replace(entry, aliases=tuple(aliases.values())))
    return with_room_aliases(Vocabulary(objects, vocabulary.room_types))


def with_things(vocabulary: Vocabulary, things: Mapping[str, Thing]) -> Vocabulary:
    """Return the vocabulary with described sizes, parents and names. Its own entries stay."""
    described = {label_key(thing.label): thing for thing in things.values()}
    for thing in things.values():
        for name in thing.other_names:
            described.setdefault(label_key(name), thing)
    classes = {label_key(label): label for label in vocabulary.labels}
    names = {thing.label: classes.get(label_key(thing.label)) for thing in things.values()}
    with_class = {label for label, name in names.items() if name is not None}
    parents = {entry.label: entry.parent for entry in vocabulary.objects}
    aliases = _Aliases(vocabulary.labels)
    for entry in vocabulary.objects:
        aliases.add(entry.label, entry.aliases)
    objects = []
    for entry in vocabulary.objects:
        keys = map(label_key, (entry.label, *entry.aliases))
        if (match := next(filter(None, map(described.get, keys)), None)) is not None:
            if not is_kind(entry.label, match.label):
                aliases.add(entry.label, (match.label, *match.other_names))
            parent = names.get(_broader(match, things, with_class) or "")
            if parents[entry.label] is None and entry.label not in _ancestors(parent, parents):
                parents[entry.label] = parent
            entry = replace(entry, size=entry.size or _size(match))
        objects.append(entry)
    objects = [
        replace(entry, parent=parents[entry.label], aliases=tuple(aliases.of[entry.label]))
        for entry in objects
    ]
    return Vocabulary(objects, vocabulary.room_types, vocabulary.room_aliases)


def _ancestors(label: str | None, parents: Mapping[str, str | None]) -> set[str]:
    """Return a class and its broader classes, or nothing without a class.

    A class must not become the child of a class that has it among its ancestors: a circle.
    """
    ancestors: set[str] = set()
    while label is not None:
        ancestors.add(label)
        label = parents[label]
    return ancestors


class _Aliases:
    """Names of classes; the first class that claims a name has it."""

    def __init__(self, classes: Iterable[str]) -> None:
        self.of: dict[str, list[str]] = {label: [] for label in classes}
        self._taken = set(map(label_key, classes))

    def add(self, label: str | None, names: tuple[str, ...]) -> None:
        """Give names without a class to a class. A label of None changes nothing."""
        for name in names:
            if label is not None and (key := label_key(name)) not in self._taken:
                self._taken.add(key)
                self.of[label].append(name)


def _broader(thing: Thing, things: Mapping[str, Thing], classes: Container[str]) -> str | None:
    """Return the nearest broader thing that is a class, or None."""
    at = thing.parent
    while at and at not in classes:
        at = things[at].parent
    return at or None


def _size(thing: Thing) -> tuple[float, float, float]:
    """Return the extents of a typical thing. Its footprint is a square, as its yaw is unknown."""
    long, wide, high = thing.size
    side = round(math.sqrt(long * wide), 3)
    return side, side, high
