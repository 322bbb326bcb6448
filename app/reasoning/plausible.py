"""Which drawn scenes a person would accept.

A chain now and then ends between two kinds of rooms: almost empty, or with a thing that belongs to
neither. A drawn scene is drawn again where

- it has fewer classes than nine in ten real rooms of its type (`Calibration.smallest`),
- it suits its room type less than 85 % of the real rooms of that type (`Calibration.room_fit`), or
- one of its classes raises an alarm of `/outliers` at the default sensitivity.

What a request gives is never a reason. The last of `ATTEMPTS` draws stands whatever it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.inference import Weights
from app.reasoning.outliers import outliers
from app.registry.artifact import Artifact
from app.scene.scene import Scene, SceneObject

ATTEMPTS: Final = 8
"""Draws of a scene at most."""


class Plausible:
    """The test of drawn scenes for one request.

    Args:
        artifact: the model that draws.
        scene: the evidence.
    """

    def __init__(self, artifact: Artifact, scene: Scene) -> None:
        self._artifact, self._room = artifact, scene.room_type
        self._given = {thing.class_index for thing in scene.objects}
        smallest = artifact.calibration.smallest
        # The last entry is for any room.
        self._least = 0
        if smallest:
            self._least = smallest[-1 if scene.room_type is None else scene.room_type]

    def __call__(self, labels: Sequence[str]) -> bool:
        """Whether a drawn scene of these classes is one."""
        if len(labels) < self._least:
            return False
        index = self._artifact.vocabulary.index
        objects = tuple([SceneObject(label, label, index(label)) for label in labels])
        classes = [thing.class_index for thing in objects if thing.class_index is not None]
        if not self._suits_room(classes):
            return False
        judged = Scene(objects, room_type=self._room)
        # A drawn scene is whole, however few its classes are.
        whole = self._artifact.calibration.outlier_thresholds.medium
        found = outliers(self._artifact, judged, threshold=whole, details=False).outliers
        return not any(
            entry.is_outlier and objects[entry.object].class_index not in self._given
            for entry in found
        )

    def _suits_room(self, classes: list[int]) -> bool:
        limits = self._artifact.calibration.room_fit
        if self._room is None or not limits:
            return True
        v = np.zeros((1, self._artifact.spec.V), dtype=np.float32)
        v[0, classes] = 1.0
        return bool(room_fit(self._artifact.weights, v, self._room)[0] >= limits[self._room])


def room_fit(weights: Weights, v: NDArray[np.float32], room: int) -> NDArray[np.float64]:
    """log p(v | room type) / p(v), up to a constant of the room type, (B,), for presence (B, V).

    sum_k [softplus(x_k + Q_tk) - softplus(x_k)],   x = c1 + v'W

    A second layer is left out.
    """
    x = weights["c1"] + v @ weights["W"]
    found: NDArray[np.float64] = np.sum(
        np.logaddexp(0.0, x + weights["Q"][room]) - np.logaddexp(0.0, x), axis=1, dtype=np.float64
    )
    return found
