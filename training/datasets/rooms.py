"""A generator of random furnished rooms, for tests, for examples and for training without data.

The tables of `vocabularies/rooms.toml` define the rooms. Furniture stands at walls, and small
objects on it. A room has one to three views from different sides, which are one group. A view omits
10 % of the small objects.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from app.scene import Vocabulary, to_viewer_frame
from app.scene.footprints import overlap_and_gap
from training.datasets.array_types import Floats, Rng
from training.datasets.encoding import side_viewpoints
from training.datasets.records import AnnotatedObject, AnnotatedScene
from training.datasets.vocabulary import source_vocabulary

SOURCE = "rooms"

_HEIGHT = 2.6  # height of a room in metres
_ATTEMPTS = 20  # maximum number of random positions that are tried for one object
_GONE = 0.1  # probability that a view omits a small object
_CLEARANCE = 0.02  # minimum distance in metres between pieces of furniture


# Extents of an object in metres, in the order: along the wall, away from the wall, upwards.
Size = tuple[float, float, float]
Where = Literal["wall", "centre", "hung", "ceiling"]
Side = Literal["left", "right", "front", "around"]


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of furniture or a small object, which a room contains at most ``most`` times."""

    label: str
    size: Size  # mean extents
    chance: float = 1.0  # probability of an attempt
    where: Where = "wall"  # not used for small objects, which stand on the piece that carries them
    most: int = 1
    carries: tuple[Piece, ...] = ()  # small objects that can stand on the piece
    # Adjacent pieces, such as a nightstand left of a bed, with their sides seen from the wall.
    # ``around`` means all four sides. The ``chance`` of the adjacent piece applies to each side.
    beside: tuple[tuple[Piece, Side], ...] = ()


Rooms = Mapping[str, tuple[Piece, ...]]
"""Maps each room type to the pieces of furniture that it can contain."""


def _read_tables(path: Path) -> dict[str, Rooms]:
    """Return the rooms of each domain. An entry is a table, or the name of an earlier table."""
    values = tomllib.loads(path.read_text(encoding="utf-8"))
    named: dict[str, Piece] = {}

    def piece(entry: Any) -> Piece:
        """Return the piece of a table, or the earlier piece of a name."""
        if isinstance(entry, str):
            return named[entry]
        beside = tuple((piece(e["piece"]), e["side"]) for e in entry.get("beside", ()))
        carries = tuple(map(piece, entry.get("carries", ())))
        return Piece(**entry | {"size": tuple(entry["size"]), "carries": carries, "beside": beside})

    for name, entry in (values["small"] | values["piece"]).items():
        named[name] = piece(entry)
    return {
        domain: {room: tuple(map(piece, entries)) for room, entries in rooms.items()}
        for domain, rooms in values["rooms"].items()
    }


DOMAINS: Final = _read_tables(Path(__file__).resolve().parent / "vocabularies" / "rooms.toml")
"""Rooms of each domain: ``homes``, or ``workplaces`` (laboratories, workshops, storerooms)."""

ROOMS: Final = DOMAINS["homes"]


@dataclass(frozen=True, slots=True)
class _Box:
    label: str
    x: float  # centre in metres
    y: float
    z: float
    size: Size
    yaw: float  # radians
    support: int | None = None  # index of the box that carries this small object

    @property
    def top(self) -> float:
        return self.z + self.size[2] / 2


def generate_rooms(count: int, seed: int, rooms: Rooms = ROOMS) -> list[AnnotatedScene]:
    """Generate scenes in viewer axes. The same seed gives the same scenes."""
    if count < 0:
        raise ValueError(f"count must not be negative, not {count}")
    rng, number = np.random.default_rng(seed), 0
    scenes: list[AnnotatedScene] = []
    while len(scenes) < count:
        room_type = str(rng.choice(list(rooms)))
        layout = _Layout(rng, room_type, rooms[room_type])
        views = range(int(rng.integers(1, 4)))
        scenes += [layout.view(f"rooms-{seed}-{number}", view) for view in views]
        number += 1
    return scenes[:count]


def rooms_vocabulary() -> Vocabulary:
    """Return the vocabulary of all labels and room types in the tables of `ROOMS`."""
    labels = sorted({label for pieces in ROOMS.values() for label in _labels(pieces)})
    # `source_vocabulary` reads scenes, so one scene per room type contains every label once.
    objects = tuple(AnnotatedObject(str(i), label) for i, label in enumerate(labels))
    scenes = [AnnotatedScene(room, SOURCE, room, room, objects) for room in ROOMS]
    return source_vocabulary(scenes, minimum=1)


def _labels(pieces: Iterable[Piece]) -> Iterator[str]:
    for piece in pieces:
        yield piece.label
        yield from _labels((*piece.carries, *(beside for beside, _ in piece.beside)))


class _Layout:
    """One furnished room. The origin is a corner of the room, and the walls run along x and y."""

    def __init__(self, rng: Rng, room_type: str, pieces: tuple[Piece, ...]) -> None:
        """Draw the extents of the room in metres, and furnish it."""
        self.rng = rng
        self.room_type = room_type
        self.width, self.depth = rng.uniform(3.2, 5.5), rng.uniform(3.0, 5.0)
        self.boxes: list[_Box] = []
        for piece in pieces:
            for _ in range(piece.most):
                if rng.random() < piece.chance:
                    self._furnish(piece)

    def view(self, group: str, number: int) -> AnnotatedScene:
        """Return a view of the room from the middle of a random wall."""
        viewpoints = side_viewpoints(0.0, 0.0, self.width, self.depth)
        viewpoint = viewpoints[int(self.rng.integers(4))]
        seen = [
            (index, box)
            for index, box in enumerate(self.boxes)
            if box.support is None or self.rng.random() >= _GONE
        ]
        positions, yaws = to_viewer_frame(
            [(box.x, box.y, box.z) for _, box in seen], viewpoint, [box.yaw for _, box in seen]
        )
        objects = tuple(
            AnnotatedObject(
                id=str(index),
                label=box.label,
                position=tuple(position),
                size=box.size,
                yaw=yaw,
                supported_by=None if box.support is None else str(box.support),
            )
            for (index, box), position, yaw in zip(
                seen, positions.tolist(), yaws.tolist(), strict=True
            )
        )
        scene_id = f"{group}-{number}"
        return AnnotatedScene(scene_id, SOURCE, group, self.room_type, objects, viewer_frame=True)

    def _random_size(self, mean: Size) -> Size:
        x, y, z = (np.array(mean) * self.rng.uniform(0.88, 1.12, 3)).tolist()
        return x, y, z

    def _furnish(self, piece: Piece) -> None:
        """Add a piece at a random free place, if `_ATTEMPTS` attempts find one."""
        size = self._random_size(piece.size)
        for _ in range(_ATTEMPTS):
            if (box := self._propose(piece, size)) is not None and self._free(box):
                self._add(piece, box)
                return

    def _propose(self, piece: Piece, size: Size) -> _Box | None:
        """Return the box of a piece at a random place, or None if the room is too small."""
        if piece.where in ("centre", "ceiling"):
            margin = math.hypot(size[0], size[1]) / 2
            if 2 * margin > min(self.width, self.depth):
                return None
            x = self.rng.uniform(0.35, 0.65) * self.width
            y = self.rng.uniform(0.35, 0.65) * self.depth
            yaw = self.rng.choice([0.0, math.pi / 2]) + self.rng.normal(0.0, 0.05)
            z = size[2] / 2 if piece.where == "centre" else _HEIGHT - size[2] / 2
            return _Box(piece.label, x, y, z, size, float(yaw))
        # The back of a piece, its -y side, touches a wall: y = 0, x = width, y = depth or x = 0.
        side = int(self.rng.integers(4))
        length = self.width if side % 2 == 0 else self.depth
        if size[0] > length:
            return None
        along = self.rng.uniform(size[0] / 2, length - size[0] / 2)
        x, y = (
            (along, size[1] / 2),
            (self.width - size[1] / 2, along),
            (along, self.depth - size[1] / 2),
            (size[1] / 2, along),
        )[side]
        z = size[2] / 2
        if piece.where == "hung":
            z = min(self.rng.uniform(1.5, 1.8), _HEIGHT - 0.05 - size[2] / 2)  # eye height
        return _Box(piece.label, x, y, z, size, side * math.pi / 2)

    def _add(self, piece: Piece, box: _Box) -> None:
        """Add a box, the small objects on it, and the pieces beside it."""
        support = len(self.boxes)
        self.boxes.append(box)
        for small in piece.carries:
            for _ in range(small.most):
                if self.rng.random() < small.chance:
                    self._put_on(small, support)
        for beside, side in piece.beside:
            self._put_beside(beside, side, box)

    def _put_on(self, small: Piece, support: int) -> None:
        """Add a small object at a random free spot on top of a box."""
        base = self.boxes[support]
        size = self._random_size(small.size)
        if size[0] > base.size[0] or size[1] > base.size[1]:
            return
        for _ in range(_ATTEMPTS):
            along = self.rng.uniform(-1, 1) * (base.size[0] - size[0]) / 2
            across = self.rng.uniform(-1, 1) * (base.size[1] - size[1]) / 2
            x, y = _point_on(base, along, across)
            box = _Box(small.label, x, y, base.top + size[2] / 2, size, base.yaw, support=support)
            if self._free(box):
                self.boxes.append(box)
                return

    def _put_beside(self, piece: Piece, where: Side, anchor: _Box) -> None:
        """Add a piece at the named sides of a box, where the room has space."""
        for side in ("left", "right", "front", "back") if where == "around" else (where,):
            if self.rng.random() >= piece.chance:
                continue
            size = self._random_size(piece.size)
            gap = self.rng.uniform(0.03, 0.15)
            if side in ("left", "right"):
                along = (anchor.size[0] + size[0]) / 2 + gap
                # Unless the side is "around", the backs of both pieces touch the same wall.
                across = 0.0 if where == "around" else (size[1] - anchor.size[1]) / 2
                x, y = _point_on(anchor, -along if side == "left" else along, across)
            else:
                across = (anchor.size[1] + size[1]) / 2 + gap
                x, y = _point_on(anchor, 0.0, across if side == "front" else -across)
            box = _Box(piece.label, x, y, size[2] / 2, size, anchor.yaw)
            if self._inside(box) and self._free(box):
                self._add(piece, box)

    def _inside(self, box: _Box) -> bool:
        """Return True if a box lies between the walls."""
        cos, sin = abs(math.cos(box.yaw)), abs(math.sin(box.yaw))
        half_x, half_y = box.size[0] / 2, box.size[1] / 2
        # Half the side lengths of the axis-aligned rectangle around the rotated box.
        x, y = cos * half_x + sin * half_y, sin * half_x + cos * half_y
        return x <= box.x <= self.width - x and y <= box.y <= self.depth - y

    def _free(self, box: _Box) -> bool:
        """Return True if a box overlaps no other box."""
        neighbours = [
            neighbour
            for neighbour in self.boxes
            if abs(neighbour.z - box.z) < (neighbour.size[2] + box.size[2]) / 2 - 1e-6
        ]
        if not neighbours:
            return True
        footprints = (_footprints(boxes) for boxes in ([box] * len(neighbours), neighbours))
        _, gap = overlap_and_gap(*itertools.chain.from_iterable(footprints))
        return bool((gap > (0.0 if box.support is not None else _CLEARANCE)).all())


def _footprints(boxes: Sequence[_Box]) -> tuple[Floats, Floats, Floats]:
    """Return the centres (n, 2), sizes (n, 2) and yaws (n,) of boxes, seen from above."""
    rows = np.array([[box.x, box.y, *box.size[:2], box.yaw] for box in boxes])
    return rows[:, :2], rows[:, 2:4], rows[:, 4]


def _point_on(box: _Box, along: float, across: float) -> tuple[float, float]:
    """Return the point `along` metres along the front of a box, and `across` off its back."""
    cos, sin = math.cos(box.yaw), math.sin(box.yaw)
    return box.x + cos * along - sin * across, box.y + sin * along + cos * across
