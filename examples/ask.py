"""Ask the six questions about labels and positions, and branch on errors."""

from __future__ import annotations

import os
import sys

from scene_client import Client, ClientError, InvalidRequestError, ProblemError

URL = os.environ.get("SCENE_URL", "http://127.0.0.1:8000")

# A label, or a detection: centre and size in metres; x forward, y left, z up.
DESK = {"id": "desk_1", "label": "desk", "position": [2.0, 0.0, 0.37], "size": [0.7, 1.4, 0.74]}
LAMP = {"id": "lamp_1", "label": "lamp", "position": [2.0, 0.5, 0.94], "size": [0.2, 0.2, 0.4]}
# The service reads a misspelt label as the nearest class, and leaves an unknown label out.
ROOM = {
    "objects": [DESK, LAMP, "moniter", "keyboard", "qwzx", "toilet"],
    "unknown_labels": "nearest-or-ignore",
}
HOME = [{"id": "office", "objects": [DESK]}, {"id": "bathroom", "objects": ["toilet", "sink"]}]


def ask(scene: Client) -> None:
    """Print one line for each question."""
    seen = scene.relations(**ROOM)
    print("read as:", {entry.label: entry.class_ for entry in seen.mapped})
    print("left out:", seen.ignored)
    print("relations:", [(r.subject, r.relation, r.object) for r in seen.observed_relations])
    missing = scene.missing(**ROOM, at=("on-top", "desk_1"), top_k=3).missing
    print("missing on the desk:", [f"{thing.label} {thing.probability:.2f}" for thing in missing])
    print("outliers:", [one.object for one in scene.outliers(**ROOM).outliers if one.is_outlier])
    (room,) = scene.rooms(**ROOM, top_k=1).room_types
    print("room:", room.room_type)
    (drawn,) = scene.generate(**ROOM, seed=7).scenes
    print("a whole room:", drawn.objects)
    (place,) = scene.where("toothbrush", HOME, searched=[{"room": "office"}], top_k=1).places
    print("the toothbrush:", place.room, f"{place.probability:.2f}")


def main() -> int:
    """Ask, and report an error in one line."""
    try:
        with Client(URL, timeout=5.0) as scene:
            ask(scene)
            scene.outliers(["bed", "nightstnad"])  # without unknown_labels, this is an error
    except InvalidRequestError as error:  # malformed, and not sent: a mistake in this program
        print(f"invalid: {error}", file=sys.stderr)
    except ProblemError as problem:  # refused by the service
        if problem.type != "/problems/unknown-labels":
            raise
        for fault in problem.errors:
            print(f"unknown label at {fault.pointer}: did you mean {fault.suggestions}?")
        return 0
    except ClientError as error:  # no service, or the deadline passed: try again later
        print(f"no answer: {error}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
