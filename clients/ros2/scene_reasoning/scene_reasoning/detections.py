"""Conversion of ROS messages of detections to a frame of a `scene_client.Home`. It needs no ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from scene_client.frames import Conventions, is_optical, is_world_fixed
from scene_client.ros_fields import LabelMap, read_label_map
from scene_client.vision_msgs import from_message

Pose = tuple[float, float, float]  # x and y in metres, yaw in radians


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

    def detections(
        self, message: Any, pose: Pose | None = None, pose_frame: str = ""
    ) -> list[dict[str, Any]]:
        """Return the detections of a message, with positions if the pose of the robot is known.

        Positions in `pose_frame`, or without its name in any frame of the world, are kept. Those in
        a frame of the robot are moved by its pose; the offset of the camera on the robot is
        neglected. Positions in another frame of the world are left out.

        Raises:
            MessageError: the message cannot be converted.
        """
        fields = from_message(message, self.label_map, min_score=self.min_score, boxes=self.boxes)
        frame = fields.get("frame_id", "")
        is_fixed = is_world_fixed(frame) or (frame != "" and frame == pose_frame)
        if pose is None or (is_fixed and pose_frame not in ("", frame)):
            unknown = {"position", "size", "orientation"}
            return [
                {name: value for name, value in one.items() if name not in unknown}
                for one in fields["objects"]
            ]
        conventions = Conventions(**self.conventions)
        if is_optical(frame):
            conventions = conventions._replace(up="-y")
        origin = (0.0, 0.0, 0.0) if is_fixed else pose
        return [_moved(one, conventions, origin) for one in fields["objects"]]


def _moved(thing: dict[str, Any], conventions: Conventions, origin: Pose) -> dict[str, Any]:
    """Return a detection with an upright box, moved from a frame whose origin is at a pose."""
    position, size, orientation = (thing.pop(n, None) for n in ("position", "size", "orientation"))
    if position is None:
        return thing
    (x, y, z), size, yaw = conventions.box(
        tuple(position.values()),
        None if size is None else tuple(size.values()),
        None if orientation is None else tuple(orientation.values()),
    )
    sin, cos = math.sin(origin[2]), math.cos(origin[2])
    place = (origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, z)
    thing |= {"position": place, "yaw": math.remainder(yaw + origin[2], math.tau)}
    return thing if size is None else thing | {"size": size}
