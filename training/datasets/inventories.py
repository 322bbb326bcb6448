"""Written inventories: the things in a kind of place, their shares and their locations.

Each row of the table is one thing at one usual location in a place:

- A place, such as "teenager's bedroom", has a room type and groups of things that come together.
  Without the column, each room type is one place.
- ``group_share`` is the share of such places that have the group; 1 if no row of it has a value.
- ``share`` is the share of places with the group that have the thing; .5 if empty. Things are
  independent.
- ``count`` is a number, such as 2, or an interval, such as 1-3, of equally likely numbers; 1 if
  empty.
- ``relation`` is on-top, inside, under or above the ``anchor``, another thing of the place; or
  floor, wall or ceiling, without an anchor. If it is empty, the location is unknown.

A table `things.csv` in the same folder describes the things: sizes, where they stand, broader and
other names.

`draw_scene` samples this model exactly. A user's shares are those of the lists of a robot, so
training uses whole scenes. The inventory of the repository lists what a careful visitor sees, which
is more than any detector lists, so training uses parts of its scenes (`detected_part`).
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from app.scene import label_key
from training.datasets.array_types import Rng
from training.datasets.files import KNOWLEDGE
from training.datasets.records import MAX_COUNT, AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.tables import Errors, Row, read_table
from training.datasets.vocabulary import is_placeholder

SOURCE: Final = "inventories"  # source name of the written scenes of the repository

COLUMNS: Final = ("room_type", "label")
OPTIONAL: Final = ("place", "group", "group_share", "share", "count", "relation", "anchor")
SHARE: Final = 0.5  # share of the places that have a thing whose row states no share
_AT_ANCHOR: Final = ("on-top", "inside", "under", "above")
_BY_ITSELF: Final = ("floor", "wall", "ceiling")
LISTED: Final = 0.55  # probability that a detector lists a thing of unknown size
_SMALLEST, _LENGTH = 0.3, 0.4  # share of the smallest things that are listed; decay length, metres
_COUNT: Final = re.compile(r"(\d{1,7})(?:-(\d{1,7}))?")

THINGS: Final = "things.csv"
THING_COLUMNS: Final = (
    *("label", "long", "wide", "high", "large", "stands", "surface", "container", "carried"),
    *("parent", "other_names"),
)
_PLACES: Final = ("floor", "wall", "ceiling", "surface", "inside")
_SOMETIMES: Final = ("no", "sometimes", "yes")
_CARRIERS: Final = ("hand", "hands", "people", "no")


@dataclass(frozen=True, slots=True)
class Thing:
    """A kind of thing."""

    label: str
    size: tuple[float, float, float]  # extents of a typical one in metres: long, wide and high
    large: float  # length of a large one, divided by the typical length
    stands: Mapping[str, float]  # share of each of `_PLACES` where it stands
    surface: str  # whether things are commonly put on it: no, sometimes or yes
    container: str  # whether things are commonly put into it: no, sometimes or yes
    carried: str  # by one hand, two hands, two people, or nobody ("no")
    parent: str  # label of the broader thing, or ""
    other_names: tuple[str, ...]  # names that detectors use for it


def read_things(path: Path) -> dict[str, Thing]:
    """Read the things by label, in the order of the file.

    Raises:
        DatasetError: the file or a value is invalid, a label occurs twice, a parent has no row, or
            parents form a loop. It names line and column; InvalidLinesError: several errors.
    """
    things: dict[str, Thing] = {}
    rows: dict[str, Row] = {}
    keys: set[str] = set()
    errors = Errors(path)
    for row in read_table(path, THING_COLUMNS, errors):
        with errors.collected():
            thing = _thing(row)
            if (key := label_key(thing.label)) in keys:
                raise row.error("label", f"{thing.label!r} has two rows")
            keys.add(key)
            things[thing.label], rows[thing.label] = thing, row
    errors.check()
    for label, row in rows.items():
        with errors.collected():
            _check_parents(label, things, row)
    errors.check()
    return things


def _check_parents(label: str, things: Mapping[str, Thing], row: Row) -> None:
    """Raise DatasetError if a parent has no row, or if the parents form a loop."""
    seen, at = {label}, things[label].parent
    while at:
        if at not in things:
            raise row.error("parent", f"{at!r} has no row")
        if at in seen:
            raise row.error("parent", f"the parents of {label!r} lead back to {at!r}")
        seen.add(at)
        at = things[at].parent


def _thing(row: Row) -> Thing:
    return Thing(
        label=row.text("label"),
        size=(row.number("long", 1000), row.number("wide", 1000), row.number("high", 1000)),
        large=row.number("large", 100),
        stands=_stands(row),
        surface=row.one_of("surface", _SOMETIMES),
        container=row.one_of("container", _SOMETIMES),
        carried=row.one_of("carried", _CARRIERS),
        parent=row.optional("parent"),
        other_names=tuple(filter(None, map(str.strip, row.optional("other_names").split(",")))),
    )


def _stands(row: Row) -> dict[str, float]:
    """Return the share of each place where a thing stands. The shares add up to 1."""
    words = row.text("stands").split()
    try:
        shares = {place: float(share) for place, share in zip(words[::2], words[1::2], strict=True)}
    except ValueError:
        shares = {}
    is_valid = set(shares) <= set(_PLACES) and len(words) == 2 * len(shares)
    is_valid = is_valid and all(0 < share <= 1 for share in shares.values())
    if not is_valid or abs(sum(shares.values()) - 1) > 0.011:  # the shares are rounded
        places = ", ".join(_PLACES)
        problem = f"must list shares that add up to 1, such as `floor .9 inside .1`; of {places}"
        raise row.error("stands", problem)
    return shares


@dataclass(frozen=True, slots=True)
class Item:
    """A thing at one of its usual locations in a place."""

    label: str
    share: float  # of the places with the group that have the thing
    least: int  # minimum number of instances
    most: int
    relation: str  # to the anchor, or floor, wall or ceiling; "" means unknown
    anchor: str  # label of another thing, or ""


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


@dataclass(frozen=True, slots=True)
class Inventory:
    """The places of a file, and the things of the table beside it."""

    places: tuple[Place, ...]
    things: Mapping[str, Thing]  # things of `things.csv` by label; empty without this file
    left_out: Counter[str]  # labels of rows that name no kind of object

    def scenes(self, each: int, seed: int) -> list[AnnotatedScene]:
        """Draw a number of whole scenes of each place. The scenes of a place are one group."""
        return [scene for scene, _ in _drawn(self.places, each, seed)]

    def detected_scenes(self, each: int, seed: int) -> list[AnnotatedScene]:
        """Draw the part that a detector lists of a number of scenes of each place."""
        rates = detection_rates(self.things.values())
        drawn = _drawn(self.places, each, seed)
        return [detected_part(scene, rates, rng) for scene, rng in drawn]


@cache
def shipped_things() -> Mapping[str, Thing]:
    """Read the things of the repository, by label."""
    return read_things(KNOWLEDGE / THINGS)


def with_shipped(tables: Iterable[Mapping[str, Thing]]) -> dict[str, Thing]:
    """Return the things of tables and of the repository by label. The first of a label counts."""
    described: dict[str, Thing] = {}
    for things in (*tables, shipped_things()):
        for label, thing in things.items():
            described.setdefault(label, thing)
    return described


@cache
def shipped_inventory() -> Inventory:
    """Read the inventories of the repository."""
    return read_inventory(KNOWLEDGE / "inventories.csv")


def read_inventory(path: Path) -> Inventory:
    """Read the places of a file and the things beside it, without placeholder labels.

    Raises:
        DatasetError: a file cannot be read, or a value is invalid. The error names the file, the
            line and the column. It is an InvalidLinesError if there are several errors.
    """
    beside = path.with_name(THINGS)
    things: Mapping[str, Thing] = read_things(beside) if beside.is_file() else {}
    errors, table, left_out = Errors(path), _Places(), Counter[str]()
    for row in read_table(path, COLUMNS, errors, OPTIONAL):
        with errors.collected():
            if is_placeholder(label := row.text("label")):
                left_out[label] += 1
            else:
                table.add(row)
    for row, place, anchor in table.anchored:
        with errors.collected():
            if label_key(anchor) not in table.labels[place]:
                problem = f"the place {place!r} has no row with the label {anchor!r}"
                raise row.error("anchor", problem)
    errors.check()
    if not table.rooms:
        raise DatasetError(path, "", "has no rows")
    return Inventory(table.places(), things, left_out)


class _Places:
    """The places of the rows so far."""

    def __init__(self) -> None:
        self.rooms: dict[str, str] = {}  # room type of each place
        self.labels: defaultdict[str, set[str]] = defaultdict(set)  # label keys of each place
        self.anchored: list[tuple[Row, str, str]] = []  # row, place and anchor
        self._shares: dict[tuple[str, str], float] = {}  # share of a place that has a group
        # The items of each group of each place.
        self._items: dict[str, dict[str, list[Item]]] = defaultdict(lambda: defaultdict(list))

    def add(self, row: Row) -> None:
        """Add a row. Raise DatasetError if a value is invalid."""
        room = row.text("room_type")
        place, group = row.text("place") if "place" in row else room, row.optional("group")
        self.labels[place].add(label_key(row.text("label")))
        if (first := self.rooms.setdefault(place, room)) != room:
            raise row.error("room_type", f"is {first!r} in other rows of the place")
        if row.optional("group_share"):
            share = row.number("group_share", 1)
            if (other := self._shares.setdefault((place, group), share)) != share:
                raise row.error("group_share", f"is {other:g} in other rows of {group or 'it'}")
        item = _item(row)
        self._items[place][group].append(item)
        if item.anchor:
            self.anchored.append((row, place, item.anchor))

    def places(self) -> tuple[Place, ...]:
        return tuple(
            Place(
                place,
                room,
                tuple(
                    Group(name, self._shares.get((place, name), 1.0), tuple(items))
                    for name, items in self._items[place].items()
                ),
            )
            for place, room in self.rooms.items()
        )


def _item(row: Row) -> Item:
    """Return the thing of a row. Raise DatasetError if a value is invalid."""
    relation = row.one_of("relation", (*_AT_ANCHOR, *_BY_ITSELF, ""))
    anchor = row.optional("anchor")
    if relation in _AT_ANCHOR and not anchor:
        raise row.error("anchor", f"is empty, but the relation is {relation}")
    if relation not in _AT_ANCHOR and anchor:
        raise row.error("anchor", f"must be empty, because the relation is {relation or 'empty'}")
    if anchor and is_placeholder(anchor):
        relation = anchor = ""
    count = _COUNT.fullmatch(row.optional("count") or "1")
    least, most = (int(count[1]), int(count[2] or count[1])) if count else (0, 0)
    if not 1 <= least <= most <= MAX_COUNT:
        raise row.error("count", "must be a number such as 2, or an interval such as 1-3")
    share = row.number("share", 1) if row.optional("share") else SHARE
    return Item(row.text("label"), share, least, most, relation, anchor)


def draw_scene(place: Place, scene_id: str, rng: Rng) -> AnnotatedScene:
    """Draw a whole place: its groups, then their things, then the number of each."""
    drawn: list[tuple[Item, int]] = []
    for group in place.groups:
        if rng.random() < group.share:
            drawn += [
                (item, int(rng.integers(item.least, item.most, endpoint=True)))
                for item in group.items
                if rng.random() < item.share
            ]
    return _scene(place, scene_id, drawn)


def complete_scene(place: Place) -> AnnotatedScene:
    """Return a scene with all things of a place, each in its least number."""
    return _scene(place, place.name, [(item, item.least) for _, item in place.items])


def _scene(place: Place, scene_id: str, things: Sequence[tuple[Item, int]]) -> AnnotatedScene:
    """Return a scene with these numbers of things. A thing without its anchor has no relation."""
    objects = [
        AnnotatedObject(str(index), item.label, count=count)
        for index, (item, count) in enumerate(things)
    ]
    first: dict[str, int] = {}
    for index, (item, _) in enumerate(things):
        first.setdefault(label_key(item.label), index)
    floor = first.get("floor", len(objects))
    if floor == len(objects):
        objects.append(AnnotatedObject(str(floor), "floor"))
    relations, supported = [], []
    for index, (item, _) in enumerate(things):
        if item.relation == "floor":
            relations.append((index, "on-top", floor))
        elif item.relation in _BY_ITSELF:
            supported.append(index)
        elif (anchor := first.get(label_key(item.anchor), index)) != index:
            relations.append((index, item.relation, anchor))
    supported += [i for i, name, _ in relations if name in ("on-top", "inside")]
    return AnnotatedScene(
        scene_id=scene_id,
        source=SOURCE,
        group=place.name,
        room_type=place.room_type,
        objects=tuple(objects),
        relations=tuple(relations),
        supported=tuple(sorted(supported)),
    )


def detection_rates(things: Iterable[Thing]) -> dict[str, float]:
    """Return the probability that a detector lists a thing: 1 - .7 exp(-length / .4 m)."""
    rates: dict[str, float] = {}
    for thing in things:
        for name in (thing.label, *thing.other_names):
            rate = 1 - (1 - _SMALLEST) * math.exp(-max(thing.size) / _LENGTH)
            rates.setdefault(label_key(name), rate)
    return rates


def detected_part(scene: AnnotatedScene, rates: Mapping[str, float], rng: Rng) -> AnnotatedScene:
    """Return the part that a detector lists: all or no objects of a label, always the floor."""
    labels = list(dict.fromkeys(label_key(thing.label) for thing in scene.objects))
    drawn = rng.random(len(labels)) < np.array([rates.get(label, LISTED) for label in labels])
    is_listed = dict(zip(labels, drawn.tolist(), strict=True)) | {"floor": True}
    kept = [k for k, thing in enumerate(scene.objects) if is_listed[label_key(thing.label)]]
    part = scene.only(kept)
    # A thing whose anchor is left out has no listed support: it does not hang on a wall.
    stands = {i for i, _, _ in scene.relations or ()}
    hangs = {new for new, old in enumerate(kept) if old in scene.supported and old not in stands}
    supported = {i for i, name, _ in part.relations or () if name in ("on-top", "inside")} | hangs
    return replace(part, supported=tuple(sorted(supported)))


def _drawn(places: Sequence[Place], each: int, seed: int) -> Iterator[tuple[AnnotatedScene, Rng]]:
    """Draw `each` scenes of a place. The second value continues the random stream of the scene."""
    rngs = np.random.default_rng(seed).spawn(len(places))
    for place, rng in zip(places, rngs, strict=True):
        for number in range(each):
            yield draw_scene(place, f"{place.name} {number}", rng), rng
