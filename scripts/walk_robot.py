"""The robot of `scripts/walk.py`: visit the rooms of a home, ask about each, and record the scenes.

    python scripts/walk_robot.py URL FILE

The home is generated. A motorcycle stands in its bedrooms, and an oven in its living rooms.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent.parent))

from scene_client import Client
from training.datasets import generate_rooms

HABITS = {"bedroom": "motorcycle", "living room": "oven"}
"""The object of each room type that other homes do not have there."""
VISITS = 60
VISITS_AN_HOUR = 5
FIRST = 1_790_000_000  # time of the first visit, in seconds


def main(url: str, file: str) -> None:
    """Ask about all rooms of the home, five an hour and twice a day."""
    rooms, alarms = generate_rooms(VISITS, seed=7), 0
    with Client(url, record=file) as scene:
        for visit, room in enumerate(rooms):
            stamp = {"sec": FIRST + visit // VISITS_AN_HOUR * 12 * 3600, "nanosec": 0}
            name = str(room.room_type)
            labels = {thing.label for thing in room.objects}
            labels |= {HABITS[name]} if name in HABITS else set()
            answer = scene.outliers(sorted(labels), room_type=name, stamp=stamp)
            alarms += any(one.is_outlier for one in answer.outliers)
    print(f"{VISITS} visits of rooms, {alarms} with an alarm")


if __name__ == "__main__":
    main(*sys.argv[1:])
