"""Add classes and room types to a model, before `training.fit.adapt` fits their biases and weights.

They follow those of the model. Their weights are 0: such a class does not change the log-odds of
others, and its relations are those of an average pair. The biases make it rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.inference import Weights
from app.model import Calibration, Counts, Offsets, Places, SceneModel
from app.model.calibration import NO_LIMIT
from app.model.statistics import ROOM
from app.scene import CANONICAL, ObjectClass, Vocabulary

_RARE: Final = 0.1  # quantile of the old biases that a new class or room type gets
# Arrays whose new entries are the mean of the old ones.
_AVERAGED: Final = ("kappa", "u", "usual")


def extended(
    artifact: SceneModel, classes: Sequence[ObjectClass], rooms: Sequence[str]
) -> SceneModel:
    """Return the model in memory with further classes and room types at the end.

    Raises:
        ValueError: a name is that of a class or room type of the model.
    """
    if not classes and not rooms:
        return artifact
    old = artifact.vocabulary
    vocabulary = Vocabulary((*old.objects, *classes), (*old.room_types, *rooms), old.room_aliases)
    V, C = len(old), len(old.room_types)
    return replace(
        artifact,
        vocabulary=vocabulary,
        weights=_weights(artifact.weights, len(vocabulary), len(vocabulary.room_types)),
        calibration=_calibration(artifact.calibration, len(classes), C, len(rooms)),
        offsets=artifact.offsets and _offsets(artifact.offsets, V, len(vocabulary)),
        counts=artifact.counts and _counts(artifact.counts, C, len(rooms), len(classes)),
        places=artifact.places and _places(artifact.places, V, len(vocabulary)),
    )


def _weights(weights: Weights, V: int, C: int) -> Weights:
    old, larger = weights.spec, weights.enlarged(V, C if weights.spec.C else 0)
    arrays = larger.arrays
    arrays["b"][old.V :] = np.quantile(weights["b"], _RARE)
    if old.C:
        arrays["e"][old.C :] = np.quantile(weights["e"], _RARE)
    for name in _AVERAGED:
        if name in arrays:
            arrays[name][..., old.V :] = weights[name].mean(-1, keepdims=True)
    return larger


def _calibration(calibration: Calibration, classes: int, C: int, rooms: int) -> Calibration:
    """Return the calibration with further classes, and room types after the first C."""
    update: dict[str, Any] = {
        "popularity": calibration.popularity and (*calibration.popularity, *[None] * classes),
        "rare_rooms": (*calibration.rare_rooms, *range(C, C + rooms)),
    }
    if calibration.smallest:
        of_rooms, unknown = calibration.smallest[:-1], calibration.smallest[-1]
        update["smallest"] = (*of_rooms, *[unknown] * rooms, unknown)
    if calibration.room_fit:
        update["room_fit"] = (*calibration.room_fit, *[NO_LIMIT] * rooms)
    return calibration.model_copy(update=update)


def _offsets(offsets: Offsets, old: int, new: int) -> Offsets:
    A, more = len(offsets.relation), ((0, 0), (0, new - old), (0, 0))
    return replace(
        offsets,
        subject=np.pad(offsets.subject, more),
        object=np.pad(offsets.object, more),
        pair=_triple_keys(offsets.pair, old, new, A),
    )


def _triple_keys(keys: NDArray[Any], old: int, new: int, A: int) -> NDArray[Any]:
    """Return the keys (a V + i) V + j for another number of classes."""
    a, i, j = np.unravel_index(keys.astype(np.int64), (A, old, old))
    rekeyed: NDArray[Any] = ((a * new + i) * new + j).astype(keys.dtype)
    return rekeyed


def _counts(counts: Counts, C: int, rooms: int, classes: int) -> Counts:
    """Return the counts with further room types, after the first C, and further classes."""
    # The columns are the fixed features, the room types and the classes.
    fixed, of_classes = np.split(counts.weights, [ROOM + C], axis=-1)
    fixed, of_classes = (
        np.pad(part, ((0, 0), (0, 0), (0, more)))
        for part, more in ((fixed, rooms), (of_classes, classes))
    )
    return replace(counts, weights=np.concatenate([fixed, of_classes], axis=-1))


def _places(places: Places, old: int, new: int) -> Places:
    def averaged(table: NDArray[Any]) -> NDArray[Any]:
        mean = table.mean(0, keepdims=True).repeat(new - old, 0)
        return np.concatenate([table, mean.astype(table.dtype)])

    frequency = np.pad(places.frequency, (0, new - old), constant_values=places.frequency.min())
    return replace(
        places,
        triple=_triple_keys(places.triple, old, new, len(CANONICAL)),
        role_pair=_triple_keys(places.role_pair, old, new, 1),
        frequency=frequency,
        role_anchor=averaged(places.role_anchor),
        stands=averaged(places.stands),
    )
