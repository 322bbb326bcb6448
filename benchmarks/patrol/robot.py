"""A robot in a flat: its route, and what its noisy detector reports."""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks.patrol.flats import Flat, Thing, Vector, random_flat

FOV: Final = math.radians(90)
REACH: Final = 5.0
CONFUSED: Final[dict[str, str]] = {
    "cup": "bowl", "bowl": "cup", "plate": "bowl", "sofa": "armchair", "armchair": "sofa",
    "monitor": "tv", "tv": "monitor", "pan": "pot", "pot": "pan", "stove": "oven",
    "oven": "microwave", "microwave": "oven", "dresser": "cabinet", "cabinet": "dresser",
    "nightstand": "cabinet", "wardrobe": "cabinet", "sideboard": "dresser",
    "mouse": "remote control", "remote control": "cell phone", "keyboard": "laptop",
    "kettle": "vase", "coffee table": "table", "table": "desk", "desk": "table",
    "blanket": "towel", "towel": "curtain", "book": "box", "box": "book", "lamp": "vase",
    "toothbrush": "pen", "toothpaste": "toothbrush", "shampoo": "bottle", "chair": "stool",
    "sink": "toilet", "bathtub": "sink", "picture": "tv", "mirror": "window", "counter": "table",
    "pillow": "bag", "washing machine": "dishwasher", "clothes dryer": "washing machine",
    "dishwasher": "washing machine", "crib": "bed", "bed": "sofa", "toy": "toy car",
    "coat": "curtain", "bench": "table", "shoe rack": "bookshelf", "bookshelf": "cabinet",
    "detergent": "bottle", "basket": "laundry basket", "laundry basket": "basket",
    "wine glass": "cup", "vase": "bottle", "bucket": "trash can", "trash can": "bucket",
}  # fmt: skip
PHANTOMS: Final = (
    "person", "cat", "dog", "bottle", "cup", "chair", "tv", "book", "cell phone", "fridge",
    "toilet", "teddy bear", "bag", "umbrella", "suitcase", "bicycle", "vase", "clock", "laptop",
    "sink", "knife", "banana", "bench", "bed", "remote control",
)  # fmt: skip


@dataclass(frozen=True)
class Noise:
    """Errors of the detector: probabilities of missed, phantom and swapped detections.

    A swapped detection has another label. With `has_alternatives`, its true label is an
    alternative, and a right detection has the other label as alternative.
    """

    missed: float = 0.2
    ghosts: float = 0.05
    swaps: float = 0.1
    has_alternatives: bool = False


class Detection(NamedTuple):
    """One detection, and the id of its true thing, or None for a phantom."""

    true: str | None
    label: str
    confidence: float
    place: Vector
    size: Vector
    other: str | None = None


@dataclass(frozen=True)
class World:
    """A flat, and the frames of the detector: lap, room, pose and detections, one a second."""

    flat: Flat
    types: dict[str, str]
    frames: list[tuple[int, str, Vector, list[Detection]]]

    def visible(self, room: str, pose: Vector) -> Iterator[Thing]:
        """Yield the things of a room that a pose could see."""
        return (one for one in self.flat.things if one.room == room and _is_in_view(one, pose))


def own_world(seed: int, noise: Noise, laps: int) -> World:
    """Return the patrol through a random flat."""
    flat, rng = random_flat(seed), random.Random(seed)
    frames = []
    for lap in range(laps):
        for room, (x0, y0, x1, y1) in flat.rooms.items():
            for second in range(60):
                turn = math.tau * second / 60
                x, y = (x0 + x1) / 2 + 0.5 * math.cos(turn), (y0 + y1) / 2 + 0.5 * math.sin(turn)
                pose = (x, y, 3 * turn)
                frames.append((lap, room, pose, _detect(flat, room, pose, rng, noise)))
    return World(flat, {room: room for room in flat.rooms}, frames)


def folder_world(folder: Path, seed: int, noise: Noise, laps: int) -> World:
    """Return the patrol of a folder with ``flat.py``: FLAT, ROOMS, S, route and detect."""
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    other: Any = import_module("flat")
    rng = random.Random(seed)
    things = [Thing(i, label, room, (x, y, z), other.S[label], odd)
              for i, label, room, x, y, z, odd in other.FLAT]  # fmt: skip
    true_label = {one.id: one.label for one in things}
    frames = []
    for lap, room, x, y, yaw in other.route(60, laps):
        found = other.detect(
            x, y, yaw, rng, missed=noise.missed, ghosts=noise.ghosts, swaps=noise.swaps
        )
        seen = []
        for true, label, confidence, px, py, pz, size in found:
            own = true_label.get(true)
            also = own if own != label else other.CONFUSE.get(label)
            also = also if noise.has_alternatives else None
            seen.append(Detection(true, label, confidence, (px, py, pz), size, also))
        frames.append((lap, room, (x, y, yaw), seen))
    return World(Flat(dict(other.ROOMS), things), {room: room for room in other.ROOMS}, frames)


def _is_in_view(thing: Thing, pose: Vector) -> bool:
    x, y, yaw = pose
    dx, dy = thing.place[0] - x, thing.place[1] - y
    angle = math.remainder(math.atan2(dy, dx) - yaw, math.tau)
    return math.hypot(dx, dy) <= REACH and abs(angle) <= FOV / 2


def _detect(
    flat: Flat, room: str, pose: Vector, rng: random.Random, noise: Noise
) -> list[Detection]:
    found = []
    for thing in flat.things:
        if thing.room != room or not _is_in_view(thing, pose) or rng.random() < noise.missed:
            continue
        label, other = thing.label, CONFUSED.get(thing.label)
        confidence = rng.betavariate(9, 2)
        if other is not None and rng.random() < noise.swaps:
            label, other, confidence = other, label, rng.betavariate(5, 4)
        x, y, z = (value + rng.gauss(0, 0.05) for value in thing.place)
        w, d, h = (value * rng.uniform(0.85, 1.15) for value in thing.size)
        one = Detection(thing.id, label, confidence, (x, y, z), (w, d, h), other)
        found.append(one if noise.has_alternatives else replace_other(one))
    for _ in range(len(found) + 1):
        if rng.random() < noise.ghosts:
            angle, far = pose[2] + rng.uniform(-0.7, 0.7), rng.uniform(0.8, 2.5)
            place = (
                pose[0] + far * math.cos(angle), pose[1] + far * math.sin(angle),
                rng.uniform(0.1, 1.2),
            )  # fmt: skip
            label, confidence = rng.choice(PHANTOMS), rng.betavariate(4, 4)
            found.append(Detection(None, label, confidence, place, (0.3, 0.3, 0.3)))
    return found


def replace_other(one: Detection) -> Detection:
    """Return a detection without alternatives."""
    return one._replace(other=None)


def jump(world: World, at: int, by: tuple[float, float]) -> World:
    """Return the patrol with a map that jumps at a second."""
    frames = [
        frame if n < at else (frame[0], frame[1], _moved(frame[2], by), [
            one._replace(place=_moved(one.place, by)) for one in frame[3]])
        for n, frame in enumerate(world.frames)
    ]  # fmt: skip
    return replace(world, frames=frames)


def _moved(place: Vector, by: tuple[float, float]) -> Vector:
    return place[0] + by[0], place[1] + by[1], place[2]
