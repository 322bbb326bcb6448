"""Count wrong alarms about places on a patrol, and moved things that the patrol finds.

    python -m scripts.sense.patrol FOLDER URL [--seeds 0 1] [--without-moves]

FOLDER has ``flat.py`` (a flat and a noisy detector) and ``patrol.py`` (the tracks of a robot). The
robot drives through the flat at 1 Hz. Each second, it asks `/outliers` at medium sensitivity about
the tracks of its room. Printed are:

- wrong onsets per minute. An onset is an entry of `misplaced` with `is_misplaced` whose subject,
  relation and object did not raise an alarm in the frame before. An entry without these fields is
  known by its moved object and its reason. The onset is wrong if the moved object is not one of the
  intruders of the flat.
- found moves. Before a patrol, one thing of the flat is moved to a wrong place of `MOVES`. It is
  found if at least one frame has an alarm about it: an entry of `misplaced` whose `moved` is a
  track of the thing, or an outlier that is a track of the thing. The last column has the
  frames with an alarm about it without the move.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import httpx

Spot = tuple[str, str, str, float, float, float]
"""Label, room, new room, and new x, y and bottom in metres."""

# The first thing of each move is looked for. The others are on it, or free its new place.
MOVES: Final[dict[str, list[Spot]]] = {
    "lamp floats": [("lamp", "bedroom", "bedroom", 3.0, 6.9, 1.3)],
    "nightstand on the bed": [
        ("nightstand", "bedroom", "bedroom", 1.2, 6.9, 0.55),
        ("lamp", "bedroom", "bedroom", 1.2, 6.9, 1.1),
        ("alarm clock", "bedroom", "bedroom", 1.15, 6.8, 1.1),
    ],
    "toilet on the bathtub": [("toilet", "bathroom", "bathroom", 7.6, 5.0, 0.6)],
    "chair on the table": [("chair", "kitchen", "kitchen", 1.64, 2.6, 0.75)],
    "pan on the floor": [("pan", "kitchen", "kitchen", 2.6, 1.3, 0.0)],
    "sofa on the coffee table": [
        ("sofa", "living room", "living room", 6.5, 1.8, 0.45),
        ("pillow", "living room", "living room", 6.0, 1.7, 0.9),
        ("book", "living room", "living room", 4.3, 2.6, 0.6),
        ("toothbrush", "living room", "living room", 6.9, 4.2, 0.5),
    ],
    "trash can on the counter": [("trash can", "kitchen", "kitchen", 3.0, 0.35, 0.9)],
    "printer in the bathtub": [("printer", "home office", "bathroom", 8.1, 5.0, 0.1)],
    "armchair on the sofa": [("armchair", "living room", "living room", 7.0, 0.6, 0.8)],
    "monitor on the floor": [("monitor", "home office", "home office", 5.6, 5.6, 0.0)],
    "armchair floats": [("armchair", "living room", "living room", 8.3, 1.4, 1.0)],
    "microwave on the bed": [("microwave", "kitchen", "bedroom", 0.5, 6.8, 0.55)],
}


@dataclass(frozen=True)
class Frame:
    """Alarms of one second: the true id and label of the moved object by entry, and outliers."""

    misplaced: dict[tuple[Any, ...], tuple[str | None, str, str]]
    outliers: set[str | None]

    @property
    def things(self) -> set[str | None]:
        return {true for true, _, _ in self.misplaced.values()} | self.outliers


class Flat:
    """The flat, the detector and the tracks in a folder."""

    def __init__(self, folder: Path) -> None:
        sys.path.insert(0, str(folder))
        arguments, sys.argv = sys.argv, sys.argv[:1]  # the patrol reads them on import
        self._flat, self._patrol = import_module("flat"), import_module("patrol")
        sys.argv = arguments
        self.intruders = {thing[0] for thing in self._flat.FLAT if thing[-1]}

    @contextmanager
    def moved(self, spots: list[Spot]) -> Iterator[str]:
        """Move things within the context. Yield the id of the first one."""
        things = self._flat.FLAT
        before, ids = list(things), []
        for label, room, new_room, x, y, bottom in spots:
            row = next(k for k, thing in enumerate(things) if thing[1:3] == (label, room))
            ids.append(things[row][0])
            middle = bottom + self._flat.S[label][2] / 2
            things[row] = (ids[-1], label, new_room, x, y, middle, False)
        yield ids[0]
        things[:] = before

    def drive(self, http: httpx.Client, seed: int) -> Iterator[Frame]:
        """Yield the alarms of each second with at least one track."""
        rng, tracks = random.Random(seed), self._patrol.Tracks()
        for _, _, x, y, yaw in self._flat.route():
            tracks.update(self._flat.detect(x, y, yaw, rng), (x, y, yaw))
            seen = list(tracks.scene(self._flat.room_of(x, y)))
            if not seen:
                continue
            body = {
                "objects": [
                    {"id": track["id"], "label": label, "confidence": confidence}
                    | {"position": track["p"], "size": track["size"]}
                    for track, label, confidence in seen
                ],
                "frame_id": "map",
                "viewpoint": {"x": x, "y": y, "yaw": yaw},
                "unknown_labels": "nearest-or-ignore",
            }
            answer = http.post("/outliers", json=body).raise_for_status().json()
            true = {t["id"]: max(t["true"], key=t["true"].get) for t, _, _ in seen}
            label_of = {track["id"]: label for track, label, _ in seen}
            yield Frame(
                {
                    _key(entry): _alarm(entry, true, label_of)
                    for entry in answer["misplaced"]
                    if entry["is_misplaced"]
                },
                {true[o["object"]] for o in answer["outliers"] if o["is_outlier"]},
            )


def _key(entry: dict[str, Any]) -> tuple[Any, ...]:
    """Return the triple of an entry by track ids, or else its moved object and its reason."""
    triple = tuple(entry.get(key) for key in ("subject", "relation", "object"))
    return (*triple, None) if None not in triple else (entry.get("moved"), *triple, _word(entry))


def _word(entry: dict[str, Any]) -> str:
    return str(entry.get("relation") or entry.get("reason") or "")


def _alarm(
    entry: dict[str, Any], true: dict[str, str | None], label_of: dict[str, str]
) -> tuple[str | None, str, str]:
    moved = entry.get("moved") or ""
    return true.get(moved), label_of.get(moved, "?"), _word(entry)


def count_onsets(
    frames: list[Frame], intruders: set[str]
) -> tuple[int, Counter[tuple[str, str, bool]]]:
    """Count the right onsets of one patrol, and the wrong ones by (label, relation, is a ghost)."""
    right, wrong = 0, Counter[tuple[str, str, bool]]()
    before: set[tuple[Any, ...]] = set()
    for frame in frames:
        for key in frame.misplaced.keys() - before:
            true, label, word = frame.misplaced[key]
            right += true in intruders
            wrong[label, word, true is None] += true not in intruders
        before = set(frame.misplaced)
    return right, +wrong


def _alarms(frames: list[Frame], thing: str) -> int:
    """Return the number of frames with an alarm about a thing."""
    return sum(thing in frame.things for frame in frames)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("url")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--without-moves", action="store_true")
    options = parser.parse_args()
    flat = Flat(options.folder)
    with httpx.Client(base_url=options.url, timeout=30) as http:
        patrols = [list(flat.drive(http, seed)) for seed in options.seeds]
        _report_onsets(patrols, flat.intruders)
        if options.without_moves:
            return
        found = 0
        for name, spots in MOVES.items():
            with flat.moved(spots) as thing:
                moved = [list(flat.drive(http, seed)) for seed in options.seeds]
            after, before = ([_alarms(frames, thing) for frames in p] for p in (moved, patrols))
            found += sum(map(bool, after))
            print(f"{name:26} frames with an alarm {after}, unmoved {before}")
        print(f"found {found} of {len(MOVES) * len(patrols)}")


def _report_onsets(patrols: list[list[Frame]], intruders: set[str]) -> None:
    minutes = sum(map(len, patrols)) / 60
    right, wrong = 0, Counter[tuple[str, str, bool]]()
    for patrol in patrols:
        some_right, some_wrong = count_onsets(patrol, intruders)
        right, wrong = right + some_right, wrong + some_wrong
    print(
        f"{minutes:.1f} minutes, right onsets {right}, wrong onsets {wrong.total()}: "
        f"{wrong.total() / minutes:.2f} per minute"
    )
    frames = [frame for patrol in patrols for frame in patrol]
    share = sum(any(a[0] not in intruders for a in f.misplaced.values()) for f in frames)
    print(f"frames with a wrong alarm {share / len(frames):.1%}")
    for (label, word, ghost), count in wrong.most_common(10):
        print(f"  {count:3} {label} {word}{' (ghost)' if ghost else ''}")


if __name__ == "__main__":
    main()
