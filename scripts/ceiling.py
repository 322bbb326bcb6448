"""Agreement of two scans of the same room: an upper bound for models of rooms.

For each scan of a room with several scans, a random other scan of the room replaces the model:

    relations   its triples predict relations. Metric: R-precision between classes of both scans,
                with ties in random order
    objects     its classes predict a removed class. Metric: reciprocal rank, expected over ties

Run as `python -m scripts.ceiling [FOLDER] [SOURCE]`.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from app.scene import CANONICAL
from training.datasets import EncodedScene, encode, indoor_vocabulary, read_scenes


def agreement(scenes: list[EncodedScene], structure: np.ndarray, seed: int = 0) -> dict[str, float]:
    """Compute the metrics over all scans of rooms with several scans."""
    rooms: dict[str, list[EncodedScene]] = defaultdict(list)
    for scene in scenes:
        if scene.evidence.holds.any():
            rooms[scene.group].append(scene)
    rng = np.random.default_rng(seed)
    hits = total = chance = 0.0
    ranks: list[float] = []
    asked = 0
    for scans in rooms.values():
        if len(scans) < 2:
            continue
        for k, scan in enumerate(scans):
            others = [other for m, other in enumerate(scans) if m != k]
            other = others[rng.integers(len(others))]
            asked += 1
            found, annotated, expected = _relations(scan, other, structure)
            hits, total, chance = hits + found, total + annotated, chance + expected
            ranks += _objects(scan, other, structure)
    return {
        "scans": float(asked),
        "R-precision, all triples": hits / total,
        "R-precision of chance": chance / total,
        "MRR": float(np.mean(ranks)),
    }


def _relations(
    scan: EncodedScene, other: EncodedScene, structure: np.ndarray
) -> tuple[float, float, float]:
    """Return (expected hits, annotated triples, expected hits in random order) of one scan."""
    ours, theirs = scan.evidence, other.evidence
    usable = ~structure[ours.classes]
    pair = usable[:, None] & usable[None, :] & ~np.eye(len(usable), dtype=np.bool_)
    truth = ours.holds & pair
    place = np.searchsorted(theirs.classes, ours.classes).clip(max=len(theirs.classes) - 1)
    both = theirs.classes[place] == ours.classes
    copied = theirs.holds[:, place][:, :, place] & both[:, None] & both[None, :] & pair
    k, size = int(truth.sum()), int(pair.sum()) * len(CANONICAL)
    first = int(copied.sum())
    right = int((copied & truth).sum())
    if first >= k:
        return (right * k / first if first else 0.0), k, k * k / max(size, 1)
    rest = (k - right) * (k - first) / max(size - first, 1)
    return right + rest, k, k * k / max(size, 1)


def _objects(scan: EncodedScene, other: EncodedScene, structure: np.ndarray) -> list[float]:
    """Return the reciprocal rank of each removed class; classes of the other scan come first."""
    mine = {int(c) for c in scan.evidence.classes if not structure[c]}
    theirs = {int(c) for c in other.evidence.classes if not structure[c]}
    absent = int((~structure).sum()) - len(mine) + 1
    result = []
    for target in mine if len(mine) >= 2 else ():
        offered = len(theirs - (mine - {target}))
        if target in theirs:
            result.append(float(np.mean(1.0 / np.arange(1, offered + 1))))
        else:
            result.append(float(np.mean(1.0 / np.arange(offered + 1, absent + 1))))
    return result


def main() -> None:
    """Print the metrics of one source, by default 3dssg."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data")
    source = sys.argv[2] if len(sys.argv) > 2 else "3dssg"
    vocabulary = indoor_vocabulary()
    scenes = encode(list(read_scenes(folder / f"{source}.jsonl.gz")), vocabulary)
    for name, value in agreement(scenes, vocabulary.structure).items():
        print(f"{name}: {value:.3f}")


if __name__ == "__main__":
    main()
