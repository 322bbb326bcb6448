"""The classes of a scene: models speak of these, answers of objects."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference import MachineSpec
from app.scene.scene import Scene


class Present(NamedTuple):
    """The n distinct classes of a scene of N objects.

    Attributes:
        classes: (n,) int64, ascending.
        counts: (n,) int64, instances of each.
        row: (N,) int64, for each object the place of its class in `classes`.
        first: (n,) int64, position of the first object of each class.
        presence: (n,) float32, probability that at least one instance of the class is there.
        log_counts: (n,) float32.
    """

    classes: NDArray[np.int64]
    counts: NDArray[np.int64]
    row: NDArray[np.int64]
    first: NDArray[np.int64]
    presence: NDArray[np.float32]
    log_counts: NDArray[np.float32]


def present(scene: Scene, spec: MachineSpec) -> Present:
    """The classes of a scene.

    Raises:
        ValueError: an object outside the machine's classes, or a room type it does not have.
    """
    V, classes = spec.V, [thing.class_index for thing in scene.objects]
    for place, index in enumerate(classes):
        if index is None or index >= V:
            name = scene.objects[place].id
            raise ValueError(f"class_index of {name!r} is {index}, must be below V = {V}")
    if scene.room_type is not None and spec.C and not 0 <= scene.room_type < spec.C:
        raise ValueError(f"room_type is {scene.room_type}, must be below C = {spec.C}")
    indices = np.array(classes, dtype=np.int64)
    confidence = np.array([thing.confidence for thing in scene.objects], dtype=np.float64)
    return Present(*_present(indices, confidence))


@compiled
def _present(indices: NDArray[np.int64], confidence: NDArray[np.float64]) -> tuple[Any, ...]:
    order = np.argsort(indices, kind="mergesort")
    classes, row = np.empty(len(indices), np.int64), np.empty(len(indices), np.int64)
    counts, first = np.zeros(len(indices), np.int64), np.empty(len(indices), np.int64)
    absent, n = np.ones(len(indices), np.float64), 0
    for position in order:
        if n == 0 or classes[n - 1] != indices[position]:
            classes[n], first[n] = indices[position], position
            n += 1
        row[position] = n - 1
        counts[n - 1] += 1
        absent[n - 1] *= 1.0 - confidence[position]
    presence, log_counts = np.empty(n, np.float32), np.empty(n, np.float32)
    for k in range(n):
        presence[k], log_counts[k] = 1.0 - absent[k], np.log(np.float64(counts[k]))
    return classes[:n], counts[:n], row, first[:n], presence, log_counts
