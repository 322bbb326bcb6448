"""True intruders: an adapted model may be quieter about its habits, and never blind.

The hosts are parts of the scenes that the parent stores, and of drawn scenes of the written places.
Each gets an intruder, and the cases are those that the parent reports. A new model that misses more
than a tenth of them is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.model import SceneModel
from app.scene import Scene
from training.datasets.array_types import Rng
from training.datasets.inventories import shipped_inventory
from training.domain.home import alarms_of
from training.evaluation.parts import of_classes

LARGEST_LOSS: Final = 0.1  # share of the true intruders that an adapted model may miss

_CASES: Final = 200
_ASKED: Final = 5 * _CASES  # maximum number of hosts
_LEAST, _MOST = 4, 12  # classes of a host

Case = tuple[Scene, int]  # a scene with an intruder, and the class of the intruder


def true_intruders(
    parent: SceneModel, weights: Float[NDArray[np.float64], "V"], seed: int = 0
) -> list[Case]:
    """Return scenes with an intruder that the parent reports.

    The intruder is drawn in proportion to `weights` from the classes that can raise an alarm.
    """
    rng = np.random.default_rng(seed)
    weights = weights * (parent.vocabulary.judged & ~parent.rarely_shown)
    cases: list[Case] = []
    for classes, room in _hosts(parent, rng):
        left = weights.copy()
        left[classes] = 0.0
        if len(cases) == _CASES or not left.any():
            break
        intruder = int(rng.choice(len(left), p=left / left.sum()))
        scene = replace(of_classes(sorted([*classes.tolist(), intruder])), room_type=room)
        if intruder in alarms_of(parent, scene):
            cases.append((scene, intruder))
    return cases


def popularity(parent: SceneModel) -> Float[NDArray[np.float64], "V"]:
    """Return the odds of each class in the training scenes of a model; 1 without statistics."""
    found = np.array(parent.calibration.popularity, dtype=np.float64)
    return np.exp(np.nan_to_num(found, nan=-np.inf)) if len(found) else np.ones(parent.spec.V)


def _hosts(parent: SceneModel, rng: Rng) -> Iterator[tuple[Int[NDArray[Any], "n"], int | None]]:
    """Yield parts of stored and written scenes in turn, every other one with its room type."""
    vocabulary, samples = parent.vocabulary, parent.weights.chain_samples
    written = shipped_inventory().scenes(2, seed=0)
    for number in range(_ASKED):
        if number % 2:
            scene = written[rng.integers(len(written))]
            matches = (vocabulary.look_up(thing.label) for thing in scene.objects)
            classes = np.unique([x.entry for x in matches if x is not None]).astype(np.int64)
            room = vocabulary.room_index(scene.room_type) if scene.room_type else None
        else:
            row = rng.integers(len(samples))
            classes, room = np.flatnonzero(samples[row]), int(parent.weights["fantasy_rooms"][row])
        classes = classes[~vocabulary.structure[classes]]
        if len(classes) >= _LEAST:
            size = rng.integers(_LEAST, min(_MOST, len(classes)), endpoint=True)
            known = room is not None and room >= 0 and number % 4 < 2
            yield np.sort(rng.permutation(classes)[:size]), room if known else None


def lost(model: SceneModel, cases: list[Case]) -> int:
    """Return the number of cases whose intruder a model does not report."""
    return sum(intruder not in alarms_of(model, scene) for scene, intruder in cases)
