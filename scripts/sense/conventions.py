"""Measure how many mistakes of frames, units and boxes a running service names.

    python -m scripts.sense.conventions http://127.0.0.1:8000 DATA

DATA is a folder with `procthor.jsonl.gz` and `extra/virtualhome.jsonl.gz`. The mistakes are made in
80 rooms of the test part of ProcTHOR, of which a viewer at a random place sees the nearest pieces.
A mistake is named if the warning declares the field and the value that undo it. If no field undoes
it, the message must state it. Right rooms and random parts of them show the false warnings.

Services up to 3.5.0 have a warning for each mistake that they know, without a value to declare. For
these, the right code counts as named.
"""

from __future__ import annotations

import argparse
import math
import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import httpx

from training.datasets.jsonl import read_jsonl
from training.datasets.splits import split

SEED: Final = 55
ROOMS: Final = 80
PIECES: Final = (4, 6, 8, 12)
RIGHT: Final = 600
PARTS: Final = 400
BATCH: Final = 32
CODES: Final = frozenset(
    ("convention", "y-axis-up", "implausible-scale", "rolled-objects", "implausible-position")
)

Vector = tuple[float, float, float]


class Box(NamedTuple):
    """A box in the frame of a viewer: z up, metres, the centre, and a rotation about z."""

    label: str
    position: Vector
    size: Vector
    yaw: float


Detection = dict[str, Any]


class Mistake(NamedTuple):
    """Another form of boxes, the fields that undo it, and the code of 3.5.0."""

    change: Callable[[Box], Detection]
    declare: dict[str, str]
    words: str = ""
    code: str = ""


def detection(box: Box, **changes: Any) -> Detection:
    """Return a box as a service expects it, or with changes."""
    sin, cos = math.sin(box.yaw / 2), math.cos(box.yaw / 2)
    fields = {"position": box.position, "size": box.size, "orientation": (0.0, 0.0, sin, cos)}
    return {"label": box.label, **fields, **changes}


def _y_up(box: Box) -> Detection:
    (x, y, z), (a, b, c) = box.position, box.size
    turn = (0.0, math.sin(box.yaw / 2), 0.0, math.cos(box.yaw / 2))
    return detection(box, position=(x, z, -y), size=(a, c, b), orientation=turn)


def _camera(box: Box) -> Detection:
    (x, y, z), (a, b, c) = box.position, box.size
    turn = (0.0, math.sin(-box.yaw / 2), 0.0, math.cos(box.yaw / 2))
    return detection(box, position=(-y, -z, x), size=(b, c, a), orientation=turn)


def _sized(factor: float) -> Callable[[Box], Detection]:
    return lambda box: detection(box, size=[side * factor for side in box.size])


def _scaled(factor: float) -> Callable[[Box], Detection]:
    return lambda box: detection(
        box,
        position=[value * factor for value in box.position],
        size=[side * factor for side in box.size],
    )


def _placed(factor: float) -> Callable[[Box], Detection]:
    return lambda box: detection(box, position=[value * factor for value in box.position])


def _moved(shares: Vector) -> Callable[[Box], Detection]:
    """Move positions from the centre by shares of the sides, along the axes of the box."""

    def change(box: Box) -> Detection:
        dx, dy, dz = (share * side for share, side in zip(shares, box.size, strict=True))
        cos, sin, (x, y, z) = math.cos(box.yaw), math.sin(box.yaw), box.position
        place = (x + cos * dx - sin * dy, y + sin * dx + cos * dy, z + dz)
        return detection(box, position=place)

    return change


def _w_first(box: Box) -> Detection:
    return detection(box, orientation=(math.cos(box.yaw / 2), 0.0, 0.0, math.sin(box.yaw / 2)))


MISTAKES: Final = {
    "y up": Mistake(_y_up, {"up": "y"}, code="y-axis-up"),
    "camera axes": Mistake(_camera, {"frame_id": "base_link_optical"}, code="y-axis-up"),
    "half extents": Mistake(_sized(0.5), {"extents": "half"}),
    "double extents": Mistake(_sized(2.0), {}, words="half as long"),
    "bottom origin": Mistake(_moved((0.0, 0.0, -0.5)), {"box_origin": "bottom"}),
    "corner origin": Mistake(_moved((-0.5, -0.5, -0.5)), {"box_origin": "corner"}),
    "dm": Mistake(_scaled(10.0), {"units": "dm"}, code="implausible-scale"),
    "cm": Mistake(_scaled(100.0), {"units": "cm"}, code="implausible-scale"),
    "dm, positions alone": Mistake(_placed(10.0), {}, "alone are in dm", "implausible-position"),
    "cm, positions alone": Mistake(_placed(100.0), {}, "alone are in cm", "implausible-position"),
    "w first": Mistake(_w_first, {"quaternion_order": "wxyz"}, code="rolled-objects"),
}


def rooms(path: Path, *, test: bool) -> list[list[Box]]:
    """Return the boxes of the rooms of a file, of its test part or of all parts."""
    scenes = read_jsonl(path)
    found = []
    for scene in split(scenes, seed=0)["test"] if test else scenes:
        boxes = [
            Box(thing.label, thing.position, thing.size, thing.yaw)
            for thing in scene.objects
            if thing.position is not None and thing.size is not None
        ]
        if len(boxes) >= min(PIECES):
            found.append(boxes)
    return found


def seen(room: Sequence[Box], pieces: int, rng: random.Random) -> list[Box]:
    """Return the pieces nearest to a random viewer, in the frame of the viewer."""
    xs, ys = ([box.position[k] for box in room] for k in (0, 1))
    x, y = rng.uniform(min(xs), max(xs)), rng.uniform(min(ys), max(ys))
    nearest = sorted(room, key=lambda box: math.dist(box.position[:2], (x, y)))[:pieces]
    middle = [sum(box.position[k] for box in nearest) / len(nearest) for k in (0, 1)]
    yaw = math.atan2(middle[1] - y, middle[0] - x)
    cos, sin, boxes = math.cos(yaw), math.sin(yaw), []
    for label, (a, b, c), size, turn in nearest:
        dx, dy = a - x, b - y
        boxes.append(Box(label, (cos * dx + sin * dy, cos * dy - sin * dx, c), size, turn - yaw))
    return boxes


def warnings_of(
    client: httpx.Client, scenes: Sequence[Sequence[Detection]]
) -> Iterator[list[dict[str, Any]]]:
    """Yield the warnings about the conventions of each scene."""
    for start in range(0, len(scenes), BATCH):
        bodies = [
            {"objects": scene, "frame_id": "base_link", "unknown_labels": "nearest-or-ignore"}
            for scene in scenes[start : start + BATCH]
        ]
        answer = client.post("/relations/batch", json={"scenes": bodies})
        for entry in answer.raise_for_status().json()["results"]:
            if entry["status"] != 200:
                raise RuntimeError(f"a scene was refused: {entry['problem']}")
            found: list[dict[str, Any]] = entry["result"].get("warnings", [])
            yield [one for one in found if one["code"] in CODES]


def is_named(mistake: Mistake, warnings: Sequence[dict[str, Any]]) -> bool:
    """Return whether the only warning names a mistake, or a warning of 3.5.0."""
    codes = [warning["code"] for warning in warnings]
    if "convention" not in codes:
        return mistake.code in codes
    if len(warnings) > 1:
        return False
    (warning,) = warnings
    is_declared = warning.get("declare", {}) == mistake.declare
    return bool(is_declared and mistake.words in warning["message"])


def measure(client: httpx.Client, data: Path) -> None:
    """Print the share of named mistakes and the false warnings."""
    rng = random.Random(SEED)
    test = rooms(data / "procthor.jsonl.gz", test=True)
    rng.shuffle(test)
    print("| Mistake | " + " | ".join(f"{n} pieces" for n in PIECES) + " | other warnings |")
    print("|---|" + "---|" * (len(PIECES) + 1))
    for name, mistake in MISTAKES.items():
        shares, others, rng = [], 0, random.Random(f"{SEED} {name}")
        for pieces in PIECES:
            large = [room for room in test if len(room) >= pieces][:ROOMS]
            views = [[*map(mistake.change, seen(room, pieces, rng))] for room in large]
            found = [*warnings_of(client, views)]
            named = [is_named(mistake, one) for one in found]
            others += sum(bool(one) and not ok for one, ok in zip(found, named, strict=True))
            shares.append(f"{sum(named) / len(named):.0%}")
        print(f"| {name} | " + " | ".join(shares) + f" | {others} of {ROOMS * len(PIECES)} |")
    rng = random.Random(SEED)
    right = [*rooms(data / "extra/virtualhome.jsonl.gz", test=False), *test][:RIGHT]
    whole = [seen(room, len(room), rng) for room in right]
    chosen = rng.choices(right, k=PARTS)
    parts = [seen(rng.sample(room, rng.randint(3, len(room))), 256, rng) for room in chosen]
    for name, scenes in (("right rooms", whole), ("parts", parts)):
        found = [*warnings_of(client, [[*map(detection, view)] for view in scenes])]
        false = [one for one in found if one]
        share = len(false) / len(scenes)
        print(f"false warnings in {len(scenes)} {name}: {len(false)} ({share:.1%})")
        for warning, *_ in false:
            print(f"- {warning['code']}: {warning['message']}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("url", help="address of the service")
    parser.add_argument("data", type=Path, help="folder with the data sets")
    arguments = parser.parse_args()
    with httpx.Client(base_url=arguments.url, timeout=120) as service:
        measure(service, arguments.data)
