"""Conversion of messages of detectors (vision_msgs and others) to the fields of a request.

    fields = from_detection3d_array(message, label_map="coco")
    answer = client.missing(**fields, top_k=5)

A message may be JSON (from rosbridge, with or without its envelope) or a Python object (from rclpy
or bags). The message may have the layout of ROS Galactic and later (fields
``results[].hypothesis.class_id`` and ``id``) or the earlier layout (``results[].id`` and
``tracking_id``). `SceneFields.notes` lists the unknown and unset values of the message.
"""

from __future__ import annotations

from typing import Any, Final

from scene_client.paths import each
from scene_client.records import FORMATS, Form, Record, matches, read
from scene_client.ros_fields import LabelMap, MessageError, read_label_map, take, unwrapped
from scene_client.schemas import UnknownLabels
from scene_client.sightings import SceneFields, Viewpoint, to_fields

_FORMS: Final[dict[str, Form]] = {form["name"]: form for form in FORMATS}
_SOLID: Final = _FORMS["vision_msgs/Detection3DArray"]
_FLAT: Final = _FORMS["vision_msgs/Detection2DArray"]


def from_detection3d_array(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    boxes: bool = True,
    viewpoint: Viewpoint | None = None,
    unknown_labels: UnknownLabels = "nearest-or-ignore",
) -> SceneFields:
    """Convert objects with poses. The service derives their relations in the axes of ``frame_id``.

    If the box of a detection is unset, the pose of the best hypothesis replaces the box. Extents
    count as unknown if one is negative or not finite, or if all are 0. An all-zero quaternion means
    no rotation. An object without a finite position has no position in the request.

    Args:
        message: a vision_msgs/Detection3DArray.
        label_map: labels of the class ids (see `read_label_map`). A class id that the label map
            does not contain is itself the label.
        min_score: minimum score of the detections in the request.
        boxes: whether the boxes are in metres. False means that the boxes are in pixels. Positions
            then come from the hypotheses, and extents are unknown.
        viewpoint: position and viewing direction (x, y, yaw) of the robot in the frame of the
            detections. In a map, odom or world frame, the relations left and front need the
            viewpoint. By default, the robot is at the origin of the frame and looks along x.
        unknown_labels: field of the request. With the default, the service leaves out classes
            that the model lacks.

    Raises:
        MessageError: the message does not contain a valid scene, or an argument is invalid.
    """
    form = _SOLID
    if not boxes:
        form = {name: path for name, path in form.items() if name != "size"} | form["else"]
    return _converted(form, message, label_map, viewpoint, min_score, unknown_labels)


def from_detection2d_array(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    unknown_labels: UnknownLabels = "nearest-or-ignore",
) -> SceneFields:
    """Convert objects without poses. The relation left comes from neighbouring boxes in the image.

    An image does not show depth or support, so the relations front, on-top, above and inside stay
    unobserved. ``message`` is a vision_msgs/Detection2DArray. `from_detection3d_array` describes
    the other arguments and the errors.
    """
    return _converted(_FLAT, message, label_map, None, min_score, unknown_labels)


def from_message(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    boxes: bool = True,
    viewpoint: Viewpoint | None = None,
    unknown_labels: UnknownLabels = "nearest-or-ignore",
) -> SceneFields:
    """Convert a message of vision_msgs, yolo_ros, depthai, darknet_ros, ZED or another detector.

    The fields of the message show its type. `from_detection3d_array` describes the arguments and
    the errors.
    """
    form = form_of(message := unwrapped(message)) or _SOLID
    if form is _SOLID:
        return from_detection3d_array(
            message, label_map, min_score=min_score, boxes=boxes, viewpoint=viewpoint,
            unknown_labels=unknown_labels,
        )  # fmt: skip
    return _converted(form, message, label_map, viewpoint, min_score, unknown_labels)


def form_of(data: Any) -> Form | None:
    """Return the format of data or of a message, or None."""
    if take(data, "detections") in ([], ()):
        return _SOLID
    return next((form for form in FORMATS if matches(form, data)), None)


def _converted(
    form: Form,
    message: Any,
    label_map: LabelMap | None,
    viewpoint: Viewpoint | None,
    min_score: float,
    unknown_labels: str,
) -> SceneFields:
    message = unwrapped(message)
    if "is_solid" in form and not isinstance(take(message, "detections"), list | tuple):
        raise MessageError("the message must have a list of detections")
    seen = read(form, [Record(chain) for chain in each(message, form["items"])], message)
    seen.viewpoint = viewpoint or seen.viewpoint
    labels = read_label_map(label_map)
    return to_fields(seen, labels, min_score=min_score, unknown_labels=unknown_labels)
