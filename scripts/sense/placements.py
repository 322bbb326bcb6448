"""Test the places that a running service proposes for missing things against the boxes of rooms.

    python -m scripts.sense.placements URL [--rooms 200] [--seed 0] [--data FOLDER]

The rooms are of ProcTHOR and VirtualHome. They are kept out of the training part of both splits
with seed 0: `final`, of the shipped weights, and `group`, of the measured weights. Of each room,
one or two small things (at most 0.5 m long) are removed that are the only ones of their label and
carry nothing. `/missing` gets the labels, positions, sizes and yaws of all other things, and
answers with `top_k` 10. The frame is a map, seen from the middle of the side with the lowest x.

A box of the typical size of the proposed class (`size` of the vocabulary) is put at the position of
the anchor plus the mean offset. Its longer side is parallel to the longer side of the anchor. All
boxes are parallel to the axes. The depth of a box in another is the shortest way along an axis that
frees it. The faults of a placement are, with lengths in metres:

- ``inside a solid``: its depth in a box is more than 0.05, or it is as deep below the floor, which
  is the lowest bottom of the room. Exceptions: the anchor for the relations inside, contains and
  under; boxes that contain the centre of the anchor, such as the shelf of a book; and, for on-top,
  an anchor with seat and back (`BACKED`) whose lower 40 % the thing does not reach.
- ``in the air``: on-top: its bottom is more than 0.05 above the top of the anchor, or its centre is
  beside the footprint of the anchor. Left, right, front, behind and under: neither the floor nor a
  top below its centre is within 0.05 below its bottom. Three sorts are left out: classes that hang
  on walls and ceilings in at least half of all cases, classes without a row in ``things.csv``, and
  things inside a box that contains the centre of the anchor.
- ``on an occupied spot``: its footprint overlaps that of another thing by more than 0.02 along both
  axes, and both bottoms differ by at most 0.05. A flat thing below it, such as a rug, is allowed.
  Classes that hang, and the relations above and below, are left out.
- ``anchor smaller``: for on-top, inside, contains and under, the footprint of the anchor is smaller
  than the typical footprint of the thing. Placements without an offset count, too.

Placements of classes without a typical size, or at no given thing, are only counted. The last row
has the same tests for the true places of the removed things of ProcTHOR: the faults that the
definitions find there. Many of these things are in the air, because ProcTHOR puts them 0.05 to
0.06 m above their support.
"""

from __future__ import annotations

import argparse
import math
import random
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import httpx
import numpy as np
from numpy.typing import NDArray

from training.datasets import AnnotatedObject, AnnotatedScene
from training.datasets.files import DATA
from training.datasets.inventories import shipped_things
from training.datasets.jsonl import read_jsonl
from training.datasets.splits import split

Point = NDArray[np.float64]
Triple = tuple[str, str, str]
"""Label of a thing, its relation, and the label of its anchor."""

TOUCH: Final = 0.05  # metres
BACKED: Final = ("bed", "sofa", "couch", "chair", "armchair", "toilet", "bathtub", "sink", "bench")
SEAT: Final = 0.4  # minimum height of a seat, as a share of the height of the thing
SMALL: Final = 0.5  # metres
FAULTS: Final = ("inside a solid", "in the air", "on an occupied spot", "anchor smaller")
BESIDE: Final = ("left", "right", "front", "behind", "under")


@dataclass(frozen=True, eq=False)
class Box:
    """A box parallel to the axes, with its lowest and highest corner (x, y, z) in metres."""

    label: str
    low: Point
    high: Point

    @classmethod
    def of(cls, thing: AnnotatedObject) -> Box:
        centre, (x, y, z) = np.array(thing.position), thing.size or (0.0, 0.0, 0.0)
        cos, sin = abs(math.cos(thing.yaw)), abs(math.sin(thing.yaw))
        half = np.array([cos * x + sin * y, sin * x + cos * y, z]) / 2
        return cls(thing.label, centre - half, centre + half)

    @property
    def centre(self) -> Point:
        return (self.low + self.high) / 2

    @property
    def area(self) -> float:
        x, y, _ = self.high - self.low
        return float(x * y)

    @property
    def backed(self) -> bool:
        return self.label.split()[-1] in BACKED

    def depth(self, other: Box) -> float:
        """Return the depth of this box in another; at most 0 if they do not overlap."""
        return float(np.minimum(self.high - other.low, other.high - self.low).min())

    def covers(self, point: Point) -> bool:
        """Return whether a point is within the footprint of this box."""
        return bool(((self.low <= point) & (point <= self.high))[:2].all())


@dataclass(frozen=True)
class Placement:
    """A thing at a place: its relation to an anchor, and the other boxes of the room."""

    thing: Box
    relation: str
    anchor: Box
    others: list[Box]
    floor: float
    hangs: bool

    def faults(self) -> set[str]:
        found = {FAULTS[0]: bool(self.solid), FAULTS[1]: self._in_air()}
        found |= {FAULTS[2]: self._is_occupied(), FAULTS[3]: self._has_small_anchor()}
        return {name for name, is_found in found.items() if is_found}

    @property
    def _around(self) -> list[Box]:
        """Other boxes that contain the centre of the anchor."""
        centre = self.anchor.centre
        return [b for b in self.others if ((b.low <= centre) & (centre <= b.high)).all()]

    @property
    def solid(self) -> str:
        """The solid that the thing is in: the floor, the anchor, another thing, or ""."""
        if self.thing.low[2] < self.floor - TOUCH:
            return "floor"
        anchor, around = self.anchor, self._around
        seat = anchor.low[2] + SEAT * (anchor.high[2] - anchor.low[2])
        on_seat = self.relation == "on-top" and anchor.backed and self.thing.low[2] >= seat
        is_open = on_seat or self.relation in ("inside", "contains", "under")
        if not is_open and self.thing.depth(anchor) > TOUCH:
            return "anchor"
        is_in_other = any(self.thing.depth(b) > TOUCH for b in self.others if b not in around)
        return "another thing" if is_in_other else ""

    def _in_air(self) -> bool:
        bottom, centre = self.thing.low[2], self.thing.centre
        if self.relation == "on-top":
            return bottom > self.anchor.high[2] + TOUCH or not self.anchor.covers(centre)
        if self.relation not in BESIDE or self.hangs:
            return False
        if any(self.thing.depth(box) > 0 for box in self._around):
            return False
        tops = [box.high[2] for box in [*self.others, self.anchor] if box.covers(centre)]
        below = [top for top in tops if top <= bottom + TOUCH]
        return bool(bottom - max([*below, self.floor]) > TOUCH)

    def _is_occupied(self) -> bool:
        if self.relation in ("above", "below") or self.hangs:
            return False
        return any(self._is_in_the_way(box) for box in self.others)

    def _is_in_the_way(self, box: Box) -> bool:
        """Return whether a box stands on the same support, at the spot of the thing."""
        thing = self.thing
        overlap = np.minimum(thing.high, box.high) - np.maximum(thing.low, box.low)
        is_below = box.high[2] <= thing.low[2] + TOUCH and box.area >= thing.area
        is_level = abs(box.low[2] - thing.low[2]) <= TOUCH
        return bool(is_level and overlap[:2].min() > 0.02 and not is_below)

    def _has_small_anchor(self) -> bool:
        return is_anchor_smaller(self.relation, self.anchor, self.thing.area)


def is_anchor_smaller(relation: str, anchor: Box, area: float) -> bool:
    """Return whether an anchor is smaller than the footprint (m²) of a thing on, in or under it."""
    supports = ("on-top", "inside", "contains", "under")
    return relation in supports and anchor.area < area


@dataclass
class Tally:
    """Placements, and those with each fault."""

    placements: int = 0
    judged: int = 0  # with an offset and a typical size
    sized: int = 0  # with a typical size
    faults: Counter[str] = field(default_factory=Counter)
    faulty: int = 0
    solids: Counter[str] = field(default_factory=Counter)
    examples: dict[str, Counter[Triple]] = field(
        default_factory=lambda: {name: Counter() for name in FAULTS}
    )

    def add(self, placement: Placement) -> None:
        """Count the faults of a placement with an offset."""
        self.placements += 1
        self.sized += 1
        self.judged += 1
        self.solids.update([placement.solid] if placement.solid else [])
        self._count(placement.faults(), placement.relation, placement.thing, placement.anchor)

    def add_without_offset(self, thing: Box, relation: str, anchor: Box) -> None:
        """Count the only fault that a placement without an offset may have."""
        self.placements += 1
        self.sized += 1
        is_small = is_anchor_smaller(relation, anchor, thing.area)
        self._count({FAULTS[3]} if is_small else set(), relation, thing, anchor)

    def _count(self, faults: set[str], relation: str, thing: Box, anchor: Box) -> None:
        self.faults.update(faults)
        self.faulty += bool(faults)
        for name in faults:
            self.examples[name][thing.label, relation, anchor.label] += 1

    def line(self) -> str:
        total = {name: self.sized if name == FAULTS[3] else self.judged for name in FAULTS}
        shares = [f"{name} {self.faults[name] / max(1, total[name]):.1%}" for name in FAULTS]
        return (
            f"{self.placements} placements, {self.judged} with offset and size, "
            f"{self.placements - self.sized} without size or anchor: {', '.join(shares)}, "
            f"any {self.faulty / max(1, self.sized):.1%}; solids {dict(self.solids)}"
        )


def kept_out(data: Path) -> Iterator[AnnotatedScene]:
    """Yield the rooms that no published or measured weights were trained on."""
    for file in (data / "procthor.jsonl.gz", data / "extra" / "virtualhome.jsonl.gz"):
        scenes = read_jsonl(file)
        trained = {
            scene.scene_id
            for protocol in ("final", "group")
            for scene in split(scenes, seed=0, protocol=protocol)["train"]
        }
        yield from (scene for scene in scenes if scene.scene_id not in trained)


def rooms_of(scenes: Iterable[AnnotatedScene], count: int, seed: int) -> list[AnnotatedScene]:
    """Draw rooms with a small thing to remove: all of VirtualHome, and the others of ProcTHOR."""
    rng = random.Random(seed)
    usable = [s for s in scenes if len(s.objects) <= 250 and removable(s)]
    few = [scene for scene in usable if scene.source == "virtualhome"][:count]
    many = [scene for scene in usable if scene.source != "virtualhome"]
    return few + rng.sample(many, min(count - len(few), len(many)))


def removable(scene: AnnotatedScene) -> list[AnnotatedObject]:
    """Return the small things that are the only ones of their label and carry nothing."""
    count = Counter(thing.label for thing in scene.objects)
    carriers = {thing.supported_by for thing in scene.objects}
    return [
        thing
        for thing in scene.objects
        if count[thing.label] == 1 and max(thing.size or (9,)) <= SMALL and thing.id not in carriers
    ]


def request(things: list[AnnotatedObject]) -> dict[str, Any]:
    """Return the body of `/missing` for posed things."""
    positions = np.array([thing.position for thing in things])
    (x0, y0, _), (_, y1, _) = positions.min(0), positions.max(0)
    return {
        "objects": [
            {
                "id": thing.id,
                "label": thing.label,
                "position": thing.position,
                "size": thing.size,
                "orientation": (0, 0, math.sin(thing.yaw / 2), math.cos(thing.yaw / 2)),
            }
            for thing in things
        ],
        "frame_id": "map",
        "viewpoint": {"x": x0, "y": (y0 + y1) / 2, "yaw": 0.0},
        "unknown_labels": "nearest-or-ignore",
        "top_k": 10,
    }


class Vocabulary:
    """Typical sizes in metres of the classes of a service, and the classes that usually hang."""

    def __init__(self, http: httpx.Client) -> None:
        model = http.post("/missing", json={"objects": ["bed"]}).raise_for_status().json()["model"]
        entries = http.get(f"/models/{model['name']}/vocabulary").raise_for_status().json()
        self.sizes = {
            entry["label"]: np.array([entry["size"][axis] for axis in "xyz"])
            for entry in entries["objects"]
            if entry["size"] is not None
        }
        rows = shipped_things()
        self._stands = {
            name: thing.stands for thing in rows.values() for name in thing.other_names
        } | {label: thing.stands for label, thing in rows.items()}

    def hangs(self, label: str) -> bool:
        """Return whether a class usually hangs, or has no row."""
        stands = self._stands.get(label)
        return stands is None or stands.get("wall", 0) + stands.get("ceiling", 0) >= 0.5

    def box(self, label: str, at: Point, anchor: Box) -> Box:
        """Return a box of typical size, turned as its anchor, around a point."""
        size = self.sizes[label]
        x, y, _ = anchor.high - anchor.low
        if (size[0] > size[1]) != (x > y):
            size = size[[1, 0, 2]]
        return Box(label, at - size / 2, at + size / 2)


def judge(
    http: httpx.Client, vocabulary: Vocabulary, things: list[AnnotatedObject], tally: Tally
) -> None:
    """Ask for missing things of a room, and count the faults of their placements."""
    answer = http.post("/missing", json=request(things)).raise_for_status().json()
    box_of = {thing.id: Box.of(thing) for thing in things}
    floor = min(float(box.low[2]) for box in box_of.values())
    for entry in answer["missing"]:
        for place in entry["placements"]:
            label, relation, anchor = entry["label"], place["relation"], box_of.get(place["object"])
            offset = place.get("offset")
            if label not in vocabulary.sizes or anchor is None:  # such as the floor
                tally.placements += 1
                continue
            shift = [offset["mean"][axis] for axis in "xyz"] if offset else (0, 0, 0)
            thing = vocabulary.box(label, anchor.centre + np.array(shift), anchor)
            if offset is None:
                tally.add_without_offset(thing, relation, anchor)
                continue
            others = [box for box in box_of.values() if box is not anchor]
            tally.add(Placement(thing, relation, anchor, others, floor, vocabulary.hangs(label)))


def true_places(
    vocabulary: Vocabulary, removed: list[AnnotatedObject], things: list[AnnotatedObject]
) -> Iterator[Placement]:
    """Yield the true places of removed things, with their own size."""
    box_of = {thing.id: Box.of(thing) for thing in things}
    floor = min(float(box.low[2]) for box in box_of.values())
    for one in removed:
        thing = Box.of(one)
        anchor = box_of.get(one.supported_by or "")
        is_inside = anchor is not None and thing.low[2] < anchor.high[2] - TOUCH
        relation = "inside" if is_inside and anchor and not anchor.backed else "on-top"
        if anchor is None:
            relation = "left"
            near = thing.centre
            anchor = min(box_of.values(), key=lambda box: float(np.hypot(*(box.centre - near)[:2])))
        others = [box for box in box_of.values() if box is not anchor]
        yield Placement(thing, relation, anchor, others, floor, vocabulary.hangs(one.label))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("url")
    parser.add_argument("--rooms", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=DATA)
    options = parser.parse_args()
    tally, true = Tally(), Tally()
    rooms = rooms_of(kept_out(options.data), options.rooms, options.seed)
    with httpx.Client(base_url=options.url, timeout=60) as http:
        vocabulary, rng = Vocabulary(http), random.Random(options.seed)
        for room in rooms:
            small = removable(room)
            removed = rng.sample(small, min(len(small), rng.randint(1, 2)))
            things = [thing for thing in room.objects if thing not in removed]
            judge(http, vocabulary, things, tally)
            if room.source == "procthor":
                for placement in true_places(vocabulary, removed, things):
                    true.add(placement)
    print(f"{len(rooms)} rooms {dict(Counter(room.source for room in rooms))}")
    print("proposed:", tally.line())
    print("true:    ", true.line())
    for name in FAULTS:
        examples = tally.examples[name]
        relations = Counter[str]()
        for (_, relation, _), count in examples.items():
            relations[relation] += count
        print(f"\n{name}: {dict(relations)}")
        print("  " + "; ".join(f"{n} {' '.join(words)}" for words, n in examples.most_common(15)))


if __name__ == "__main__":
    main()
