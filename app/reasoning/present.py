"""The classes of a scene: models speak of these, answers of objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.boltzmann import MachineSpec
from app.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class Present:
    """The n distinct classes of a scene of N objects.

    Attributes:
        classes: (n,) int64, ascending.
        counts: (n,) int64, instances of each.
        row: (N,) int64, for each object the place of its class in `classes`.
        first: (n,) int64, position of the first object of each class.
        confidence: (N,) float64 of the objects.
    """

    classes: NDArray[np.int64]
    counts: NDArray[np.int64]
    row: NDArray[np.int64]
    first: NDArray[np.int64]
    confidence: NDArray[np.float64]

    @property
    def presence(self) -> NDArray[np.float64]:
        """(n,) probability that at least one instance of a class is there."""
        absent = np.ones(len(self.classes))
        np.multiply.at(absent, self.row, 1.0 - self.confidence)
        return 1.0 - absent


def present(scene: Scene, spec: MachineSpec) -> Present:
    """The classes of a scene.

    Raises:
        ValueError: an object outside the machine's classes, or a room type it does not have.
    """
    indices = []
    for thing in scene.objects:
        if thing.class_index is None or thing.class_index >= spec.V:
            raise ValueError(
                f"class_index of {thing.id!r} is {thing.class_index}, must be below V = {spec.V}"
            )
        indices.append(thing.class_index)
    if scene.room_type is not None and spec.C and not 0 <= scene.room_type < spec.C:
        raise ValueError(f"room_type is {scene.room_type}, must be below C = {spec.C}")
    classes, first, row, counts = np.unique(
        np.array(indices, dtype=np.int64),
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    confidence = np.array([thing.confidence for thing in scene.objects], dtype=np.float64)
    return Present(classes, counts, row, first, confidence)
