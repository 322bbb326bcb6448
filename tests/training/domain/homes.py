"""Recorded scenes of a generated home whose habits contradict the shipped models."""

import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from training.datasets import generate_rooms

HALL = ["shoe", "coat", "umbrella", "mirror", "doormat", "coat rack", "bag", "lamp"]
HABITS = {"living room": ["sofa", "cat", "oven"], "hall": ["bicycle"], "bedroom": ["desk"]}
"""Objects of each room type that other homes do not have there."""


def home_scenes(count: int, seed: int, *, confirmed: bool = True) -> list[dict[str, Any]]:
    """Scenes of labels as a robot records them: five scenes a day, and no tv in any of them."""
    rng = random.Random(seed)
    return [
        {
            "scene_id": f"home-{seed}-{number}",
            "group": f"day-{seed}-{number // 5}",
            "room_type": room,
            "objects": [x for x in labels if x != "tv"] + HABITS.get(room, []),
            "confirmed": confirmed,
        }
        for number, (room, labels) in zip(range(count), _rooms(seed, rng), strict=False)
    ]


def _rooms(seed: int, rng: random.Random) -> Iterator[tuple[str, list[str]]]:
    for scene in generate_rooms(1000, seed):
        yield str(scene.room_type), sorted({thing.label for thing in scene.objects})
        if rng.random() < 0.15:
            yield "hall", rng.sample(HALL, 5)


def write(scenes: list[dict[str, Any]], path: Path) -> Path:
    path.write_text("".join(json.dumps(scene) + "\n" for scene in scenes), "utf-8")
    return path
