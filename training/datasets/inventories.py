"""Written inventories: the things in a kind of place, their shares and their locations.

Each row of the table is one thing at one usual location in a place:

- A place, such as "teenager's bedroom", has a room type and groups of things that come together.
- ``group_share`` is the share of such places that have the group.
- ``share`` is the share of places with the group that have the thing. Things are independent.
- ``count`` is a number, such as 2, or an interval, such as 1-3, of equally likely numbers.
- ``relation`` is on-top, inside, under or above the ``anchor``, another thing of the place; or
  floor, wall or ceiling, without an anchor.

`draw_scene` samples this model exactly. A careful visitor's list is longer than any detector's, so
training uses parts of the drawn scenes (`listed_part`).
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from app.scene import label_key
from training.datasets.array_types import Rng
from training.datasets.records import MAX_COUNT, AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.tables import Row, read_table
from training.datasets.things import Thing

SOURCE: Final = "inventories"
"""Source name of all written scenes."""

COLUMNS: Final = (
    *("place", "room_type", "group", "group_share", "label", "share", "count"),
    *("relation", "anchor"),
)
_AT_ANCHOR: Final = ("on-top", "inside", "under", "above")
_BY_ITSELF: Final = ("floor", "wall", "ceiling")
LISTED: Final = 0.55
"""Probability that a detector lists a thing of unknown size."""
_SMALLEST, _LENGTH = 0.3, 0.4  # share of the smallest things that are listed; decay length, metres
_COUNT: Final = re.compile(r"(\d{1,7})(?:-(\d{1,7}))?")


@dataclass(frozen=True, slots=True)
class Item:
    """A thing at one of its usual locations in a place.

    Attributes:
        share: share of the places with the group that have the thing.
        least, most: limits of the number of instances.
        relation: relation to the anchor, or floor, wall or ceiling.
        anchor: label of another thing, or "".
    """

    label: str
    share: float
    least: int
    most: int
    relation: str
    anchor: str


@dataclass(frozen=True, slots=True)
class Group:
    """Things that a share of the places has together."""

    name: str
    share: float
    items: tuple[Item, ...]


@dataclass(frozen=True, slots=True)
class Place:
    """A kind of place, such as "chemistry lab"."""

    name: str
    room_type: str
    groups: tuple[Group, ...]

    @property
    def items(self) -> Iterator[tuple[Group, Item]]:
        """Each thing with its group."""
        return ((group, item) for group in self.groups for item in group.items)


def read_places(path: Path) -> tuple[Place, ...]:
    """Read the places of an inventory, in the order of the file.

    Raises:
        DatasetError: the file cannot be read, or a value is invalid. The error names the file, the
            line and the column.
    """
    rooms: dict[str, str] = {}
    shares: dict[tuple[str, str], float] = {}
    items: dict[str, dict[str, list[Item]]] = defaultdict(lambda: defaultdict(list))
    labels: dict[str, set[str]] = defaultdict(set)
    anchored: list[tuple[Row, str, str]] = []
    for row in read_table(path, COLUMNS):
        place, group = row.text("place"), row.text("group")
        if (room := rooms.setdefault(place, row.text("room_type"))) != row.text("room_type"):
            raise row.error("room_type", f"is {room!r} in other rows of the place")
        share = row.number("group_share", 1)
        if shares.setdefault((place, group), share) != share:
            raise row.error("group_share", f"is {shares[place, group]:g} in other rows of {group}")
        item = _item(row)
        items[place][group].append(item)
        labels[place].add(label_key(item.label))
        if item.anchor:
            anchored.append((row, place, item.anchor))
    for row, place, anchor in anchored:
        if label_key(anchor) not in labels[place]:
            raise row.error("anchor", f"the place {place!r} has no row with the label {anchor!r}")
    if not rooms:
        raise DatasetError(path, "", "has no rows")
    return tuple(
        Place(
            place,
            room,
            tuple(Group(name, shares[place, name], tuple(of)) for name, of in items[place].items()),
        )
        for place, room in rooms.items()
    )


def _item(row: Row) -> Item:
    relation = row.one_of("relation", (*_AT_ANCHOR, *_BY_ITSELF))
    anchor = row.optional("anchor")
    if relation in _AT_ANCHOR and not anchor:
        raise row.error("anchor", f"is empty, but the relation is {relation}")
    if relation in _BY_ITSELF and anchor:
        raise row.error("anchor", f"must be empty, because the relation is {relation}")
    found = _COUNT.fullmatch(row.text("count"))
    least, most = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
    if not 1 <= least <= most <= MAX_COUNT:
        raise row.error("count", "must be a number such as 2, or an interval such as 1-3")
    return Item(row.text("label"), row.number("share", 1), least, most, relation, anchor)


def draw_scene(place: Place, scene_id: str, rng: Rng) -> AnnotatedScene:
    """Draw a whole place: its groups, then their things, then the number of each.

    A thing whose anchor is not drawn has no relation. Things on the floor stand on an object
    "floor". Things at the wall or ceiling are listed as supported.
    """
    drawn: list[tuple[Item, int]] = []
    for group in place.groups:
        if rng.random() < group.share:
            drawn += [
                (item, int(rng.integers(item.least, item.most, endpoint=True)))
                for item in group.items
                if rng.random() < item.share
            ]
    objects = [
        AnnotatedObject(str(index), item.label, count=count)
        for index, (item, count) in enumerate(drawn)
    ]
    first: dict[str, int] = {}
    for index, (item, _) in enumerate(drawn):
        first.setdefault(label_key(item.label), index)
    floor = first.get("floor", len(objects))
    if floor == len(objects):
        objects.append(AnnotatedObject(str(floor), "floor"))
    relations, supported = [], []
    for index, (item, _) in enumerate(drawn):
        if item.relation == "floor":
            relations.append((index, "on-top", floor))
        elif item.relation in _BY_ITSELF:
            supported.append(index)
        elif (anchor := first.get(label_key(item.anchor), index)) != index:
            relations.append((index, item.relation, anchor))
    supported += [i for i, name, _ in relations if name in ("on-top", "inside")]
    return AnnotatedScene(
        *(scene_id, SOURCE, place.name, place.room_type, tuple(objects), tuple(relations)),
        supported=tuple(sorted(supported)),
    )


def listed_shares(things: Iterable[Thing]) -> dict[str, float]:
    """Return the probability that a detector lists a thing of a written place, by key of its name.

    It is 1 - .7 exp(-length / .4 m): nearly all of the large things, and a third of the smallest.
    """
    shares: dict[str, float] = {}
    for thing in things:
        for name in (thing.label, *thing.other_names):
            share = 1 - (1 - _SMALLEST) * math.exp(-max(thing.size) / _LENGTH)
            shares.setdefault(label_key(name), share)
    return shares


def listed_part(scene: AnnotatedScene, shares: Mapping[str, float], rng: Rng) -> AnnotatedScene:
    """Return a part of a scene, as a detector lists it.

    All objects with one label are in the part, or none. The floor stays.

    Args:
        shares: see `listed_shares`.
    """
    labels = list(dict.fromkeys(label_key(thing.label) for thing in scene.objects))
    drawn = rng.random(len(labels)) < np.array([shares.get(label, LISTED) for label in labels])
    is_listed = dict(zip(labels, drawn.tolist(), strict=True)) | {"floor": True}
    kept = [k for k, thing in enumerate(scene.objects) if is_listed[label_key(thing.label)]]
    index_of = {old: new for new, old in enumerate(kept)}
    relations = tuple(
        (index_of[i], name, index_of[j])
        for i, name, j in scene.relations or ()
        if i in index_of and j in index_of
    )
    # A thing whose anchor is left out has no listed support: it does not hang on a wall.
    stands = {i for i, _, _ in scene.relations or ()}
    supported = {index_of[i] for i in scene.supported if i in index_of and i not in stands}
    supported |= {i for i, name, _ in relations if name in ("on-top", "inside")}
    objects = tuple(scene.objects[k] for k in kept)
    return replace(scene, objects=objects, relations=relations, supported=tuple(sorted(supported)))


def written_scenes(
    places: Sequence[Place], shares: Mapping[str, float], each: int, seed: int
) -> list[AnnotatedScene]:
    """Draw parts of a number of scenes of each place. The scenes of a place are one group.

    Args:
        shares: see `listed_shares`.
    """
    rngs = np.random.default_rng(seed).spawn(len(places))
    return [
        listed_part(draw_scene(place, f"{place.name} {number}", rng), shares, rng)
        for place, rng in zip(places, rngs, strict=True)
        for number in range(each)
    ]
