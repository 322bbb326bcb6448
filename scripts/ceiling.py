"""Measure how well one scan of a room predicts another scan: an upper bound for models of rooms.

Some rooms have several scans. For each scan of such a room, a random other scan of the room serves
as the prediction:

    relations   the relations of the other scan predict the relations of this scan. Metric:
                R-precision. The remaining predictions are in random order
    objects     one class is removed from this scan. The classes of the other scan predict the
                removed class. Metric: mean reciprocal rank (MRR), as expectation over ties

Run as `python -m scripts.ceiling [FOLDER] [SOURCE]`. `python -m training fetch` says what belongs
into the folder.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from app.scene import CANONICAL
from training.datasets import EncodedScene, encode, indoor_vocabulary, read_scenes


def agreement(scenes: list[EncodedScene], structure: np.ndarray, seed: int = 0) -> dict[str, float]:
    """Compute the metrics over all scans of rooms with several scans.

    Args:
        structure: (classes,) bool, True for structure classes, which are left out.
    """
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
    """Compare the relations of a scan with the relations of another scan.

    Returns:
        The expected number of correct predictions, the number of annotated relations, and the
        expected number of correct predictions in random order.
    """
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
    """Return the reciprocal rank of each class of a scan after its removal.

    The classes of the other scan rank first, as a tie. All remaining classes tie after them.
    """
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
    """Print the metrics of one data source, by default 3dssg."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data")
    source = sys.argv[2] if len(sys.argv) > 2 else "3dssg"
    vocabulary = indoor_vocabulary()
    scenes = encode(list(read_scenes(folder / f"{source}.jsonl.gz")), vocabulary)
    for name, value in agreement(scenes, vocabulary.structure).items():
        print(f"{name}: {value:.3f}")


if __name__ == "__main__":
    main()
