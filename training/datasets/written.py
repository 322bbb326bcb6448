"""The vocabulary of written knowledge, from `things.csv` and `inventories.csv` alone."""

import math
from collections import defaultdict
from functools import cache
from typing import Final

from app.scene import ObjectClass, Vocabulary, label_key
from training.datasets.files import KNOWLEDGE
from training.datasets.inventories import read_places
from training.datasets.things import Thing, read_things
from training.datasets.vocabulary import curated_names, indoor_vocabulary, with_room_aliases

# A thing becomes a class if so many kinds of places are expected to have it.
LEAST_PLACES: Final = 0.5


@cache
def written_vocabulary() -> Vocabulary:
    """Build the vocabulary: the commonest things of the written places come first.

    The classes of the indoor vocabulary are always included. Another thing is a class from
    `LEAST_PLACES` on, and otherwise a name of its nearest broader class. The parent of a class is
    its nearest broader class. A name with a class of its own is never an alias. Of several classes
    with the same other name, `things.csv` comes before the curated names.
    """
    names, indoor = curated_names(), indoor_vocabulary()
    things = read_things(KNOWLEDGE / "things.csv")
    places = read_places(KNOWLEDGE / "inventories.csv")
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


class _Aliases:
    """Names of classes; the first class that claims a name has it."""

    def __init__(self, classes: dict[str, Thing]) -> None:
        self.of: dict[str, list[str]] = {label: [] for label in classes}
        self._taken = set(map(label_key, classes))

    def add(self, label: str | None, names: tuple[str, ...]) -> None:
        """Give names without a class to a class. A label of None changes nothing."""
        for name in names:
            if label is not None and (key := label_key(name)) not in self._taken:
                self._taken.add(key)
                self.of[label].append(name)


def _broader(thing: Thing, things: dict[str, Thing], classes: dict[str, Thing]) -> str | None:
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
