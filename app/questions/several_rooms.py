"""Scenes from several rooms: a flat in one request, though every answer is about one room.

r_it = `SHARPNESS` (log p(t | i) - log p(t)) is the evidence of class i for room type t, where
p(t | i) is the probability of the room type given a scene of this class alone. The listed classes
are from one room with the log evidence max_t sum_i r_it, or from K rooms of the types T, which may
repeat, with

    sum_i log (1 / K) sum_{t in T} exp(r_it)

`gain` is the largest difference of both, with K from 2 to `MOST_ROOMS`. The search starts with each
of the `_STARTS` best single types, and adds the best further type, one after another. A warning
needs at least `LEAST_CLASSES` classes, and the gain `Calibration.several_rooms`. Few lists of one
room reach it (`training.fit.calibrate_rooms`). Weak detections do not count, and a request that
states its room type gets no warning.

The warning names the likeliest room of each object. With positions, straight lines divide the
plane: each cut has the largest gain of log evidence, and at least `_LEAST_CUT`.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.scene_model import SceneModel
from app.questions.doubt import LEAST_REAL
from app.scene.scene import Scene, SceneObject
from scene_client.schemas import RoomPart, SceneWarning

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

MOST_ROOMS: Final = 4
LEAST_CLASSES: Final = 6
_STARTS: Final = 3
_LEAST_CUT: Final = 4.0
_MOST_CUTS: Final = 3  # one after another
_LEAST_PART: Final = 4  # objects of a part that is cut further
_DIRECTIONS: Final = np.stack([np.cos(angle := np.arange(8) * np.pi / 8), np.sin(angle)])

_MESSAGE: Final = (
    "the objects may be from {number} rooms ({names}), but the answers are about one room: send "
    "one request for each room, or state the `room_type` of this room"
)


def several_rooms(model: SceneModel, scene: Scene) -> list[SceneWarning]:
    """Return the warning about a scene from several rooms, or no warning."""
    least = model.calibration.several_rooms
    if least is None or model.spec.C < 2 or scene.room_type is not None:
        return []
    classes = [one.class_index for one in scene.objects if one.confidence >= LEAST_REAL]
    if len(classes) < LEAST_CLASSES:
        return []
    value, types = gain(*model.room_evidence, np.array(classes), least)
    if value < least:
        return []
    things = [one for one in scene.objects if one.confidence >= LEAST_REAL]
    rooms = [
        RoomPart(model.vocabulary.room_types[t], [things[k].id for k in members])
        for t, members in _parts(model, things, types).items()
    ]
    if len(rooms) < 2:
        return []
    message = _MESSAGE.format(number=len(rooms), names=", ".join(one.room_type for one in rooms))
    return [SceneWarning(code="several-rooms", message=message, objects=[], rooms=rooms)]


def warm_up(model: SceneModel) -> None:
    """Compute the evidence of a model, and compile the loop."""
    if model.spec.C:
        gain(*model.room_evidence, np.zeros(1, np.int64), 0.0)


@compiled
def gain(
    log: Float[NDArray, "V C"],  # the fields of `RoomEvidence`
    odds: Float[NDArray, "V C"],
    top: Float[NDArray, " V"],
    row: Int[NDArray, " W"],
    classes: Int[NDArray, " N"],
    least: float,  # a smaller upper bound of the gain ends the search
) -> tuple[float, Int[NDArray, " K"]]:
    """Return the gain of several rooms over one, and their types; see the module.

    The gain of fewer than `LEAST_CLASSES` classes is -inf. The upper bound is the gain if each
    class had a room of its best type.
    """
    C, is_listed = log.shape[1], np.zeros(len(log), np.bool_)
    for i in classes:
        is_listed[row[i]] |= row[i] >= 0
    listed = np.flatnonzero(is_listed)
    n, types = len(listed), np.zeros(MOST_ROOMS, np.int64)
    best, best_types = -np.inf, types[:0]
    if n < LEAST_CLASSES:
        return best, best_types
    single, most = np.zeros(C, np.float32), np.float32(0.0)
    for i in listed:
        single += log[i]
        most += top[i]
    one = np.float64(single.max())
    if most - one < least:
        return best, best_types
    total, product = np.empty(n, np.float32), np.empty(C, np.float64)
    for _ in range(_STARTS):
        types[0] = np.argmax(single)
        single[types[0]] = -np.inf
        for k in range(n):
            total[k] = odds[listed[k], types[0]]
        for K in range(2, MOST_ROOMS + 1):
            # The mean instead of the sum of odds keeps the product within float64.
            product[:] = 1.0
            share = np.float32(1.0) / np.float32(K)
            for k in range(n):
                of_class, before = odds[listed[k]], total[k]
                for t in range(C):
                    product[t] *= share * (before + of_class[t])
            t = int(np.argmax(product))
            types[K - 1] = t
            value = 0.0
            for k in range(n):
                total[k] += odds[listed[k], t]
                value += np.log(np.float64(share * total[k]))
            if value - one > best:
                best, best_types = value - one, types[:K].copy()
    return best, best_types


def _parts(
    model: SceneModel, things: Sequence[SceneObject], types: Int[Indices, "K"]
) -> dict[int, list[int]]:
    """Return the indices of the objects of each room type, in the order of the first object."""
    parts: dict[int, list[int]] = {}
    rows = model.vocabulary.stand_in[np.array([thing.class_index for thing in things])]
    r = model.room_evidence.log[rows]
    if any(thing.position is None for thing in things):
        for row, t in enumerate(types[r[:, types].argmax(1)].tolist()):
            parts.setdefault(t, []).append(row)
        return parts
    points = np.array([thing.position[:2] for thing in things if thing.position])
    for members in _cut(r, points, np.arange(len(rows)), _MOST_CUTS):
        t = int(r[members].sum(0).argmax())
        parts[t] = sorted(parts.get(t, []) + members.tolist())
    return parts


def _cut(
    r: Float[Floats, "N C"],
    points: Float[Floats, "N 2"],
    members: Int[Indices, "m"],
    most: int,
) -> list[Int[Indices, "k"]]:
    """Divide objects by straight lines as long as the evidence grows; see the module."""
    if len(members) < _LEAST_PART or not most:
        return [members]
    whole, best, halves = r[members].sum(0).max(), _LEAST_CUT, None
    for along in (points[members] @ _DIRECTIONS).T:
        order = members[np.argsort(along, kind="stable")]
        sums = np.cumsum(r[order], axis=0)
        values = sums[:-1].max(1) + (sums[-1] - sums[:-1]).max(1) - whole
        k = int(values.argmax())
        if values[k] > best:
            best, halves = float(values[k]), (order[: k + 1], order[k + 1 :])
    if halves is None:
        return [members]
    return [part for half in halves for part in _cut(r, points, half, most - 1)]
