"""Conversion of ROS messages of detections to a frame of a `scene_client.Home`. It needs no ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from scene_client.frames import (
    Conventions,
    Quaternion,
    Vector,
    is_optical,
    is_world_fixed,
    product,
    rotated,
)
from scene_client.ros_fields import LabelMap, read_label_map
from scene_client.vision_msgs import from_message

Pose = tuple[float, float, float]  # x and y in metres, yaw in radians

# Rotations to body axes, from an optical frame and from a frame whose y axis points up.
_OPTICAL: Quaternion = (-0.5, 0.5, -0.5, 0.5)
_Y_UP: Quaternion = (0.5, -0.5, -0.5, 0.5)


class Transform(NamedTuple):
    """A transform to the map: a rotation, then a translation in metres."""

    rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    translation: Vector = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, pose: Pose | None, pose_frame: str, frame: str) -> Transform | None:
        """Return the transform of a frame of the robot, or of the map, if the pose is known.

        Every frame of the robot counts as its base, because the pose has no offset of a camera. The
        result is None for another frame of the world than that of the pose.
        """
        if pose is None or (is_world_fixed(frame) and pose_frame not in ("", frame)):
            return None
        if is_world_fixed(frame) or frame == pose_frame:
            return cls()
        x, y, yaw = pose
        turn = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        return cls(product(turn, _OPTICAL) if is_optical(frame) else turn, (x, y, 0.0))

    @property
    def pose(self) -> Pose:
        """The pose of the origin of the frame."""
        x, y, z, w = self.rotation
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return self.translation[0], self.translation[1], yaw


@dataclass
class Converter:
    """Convert messages to detections in the frame of the map.

    Attributes:
        label_map: labels of the class ids; may be replaced at any time.
        min_score: detections with a lower score are left out.
        boxes: False if boxes are in pixels; positions are then taken from the hypotheses.
        conventions: conventions of the boxes other than those of ROS, such as ``{"units": "cm"}``.

    Raises:
        MessageError: an invalid label map.
    """

    label_map: LabelMap | None = None
    min_score: float = 0.0
    boxes: bool = True
    conventions: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        read_label_map(self.label_map)

    def detections(self, message: Any, transform: Transform | None) -> list[dict[str, Any]]:
        """Return the detections of a message, with positions if there is a transform.

        Raises:
            MessageError: the message cannot be converted.
        """
        fields = from_message(message, self.label_map, min_score=self.min_score, boxes=self.boxes)
        return [self._moved(one, transform) for one in fields["objects"]]

    def _moved(self, thing: dict[str, Any], transform: Transform | None) -> dict[str, Any]:
        """Return a detection with an upright box in the map."""
        position, size, orientation = (
            tuple(vector.values()) if (vector := thing.pop(name, None)) else None
            for name in ("position", "size", "orientation")
        )
        if position is None or transform is None:
            return thing
        conventions, rotation = Conventions(**self.conventions), transform.rotation
        if conventions.up == "y":
            rotation = product(rotation, _Y_UP)
        if orientation is not None and conventions.quaternion_order == "wxyz":
            orientation = (*orientation[1:], orientation[0])
        place, size, yaw = conventions._replace(up="z", quaternion_order="xyzw").box(
            rotated(position, rotation), size, product(rotation, orientation or (0, 0, 0, 1))
        )
        thing["position"] = tuple(a + b for a, b in zip(place, transform.translation, strict=True))
        return thing | ({"yaw": yaw} if size is None else {"yaw": yaw, "size": size})
