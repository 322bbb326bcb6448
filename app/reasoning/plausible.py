"""Which drawn scenes a person would accept.

A chain now and then ends between two kinds of rooms: almost empty, or with a thing that belongs to
neither. A drawn scene is drawn again where

- it has fewer classes than one in twenty real rooms of its type has (`Calibration.smallest`), or
- one of its classes raises an alarm of `/outliers` at low sensitivity, as one in fifty real scenes
  of the hardest source does.

What a request gives is never a reason. The last of `ATTEMPTS` draws stands whatever it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

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
        judged = Scene(objects, room_type=self._room)
        found = outliers(self._artifact, judged, sensitivity="low", details=False).outliers
        return not any(
            entry.is_outlier and objects[entry.object].class_index not in self._given
            for entry in found
        )
