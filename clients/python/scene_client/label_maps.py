"""From the class ids of a detector to labels.

Detectors report classes as text, and many of them as numbers in text ("56"). What a number means
only the detector's makers know: a mapping, a list in the order of the numbers, a
vision_msgs/LabelInfo message, or the name of a well-known list says it here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeAlias

from scene_client.ros_fields import MessageError, items, take

LabelMap: TypeAlias = Mapping[Any, str | None] | Sequence[str] | str | object

COCO: Final = (
    *("person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat"),
    *("traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat"),
    *("dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack"),
    *("umbrella", "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball"),
    *("kite", "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket"),
    *("bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple"),
    *("sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair"),
    *("couch", "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse"),
    *("remote", "keyboard", "cell phone", "microwave", "oven", "toaster", "sink"),
    *("refrigerator", "book", "clock", "vase", "scissors", "teddy bear", "hair drier"),
    "toothbrush",
)
"""The 80 classes of COCO's boxes as most detectors number them: without gaps, from 0."""

_WELL_KNOWN: Final = {"coco": COCO}


def read_label_map(label_map: LabelMap | None) -> dict[str, str | None]:
    """Class id, as text, to label; a class that is mapped to None is left out of scenes.

    Args:
        label_map: a mapping from class ids (text or numbers); labels in the order of the numbers;
            a vision_msgs/LabelInfo, as a message or as JSON; "coco"; or None, an empty map.

    Raises:
        MessageError: none of these.
    """
    if label_map is None:
        return {}
    if isinstance(label_map, str):
        if label_map not in _WELL_KNOWN:
            known = ", ".join(sorted(_WELL_KNOWN))
            raise MessageError(f"no label map is called {label_map!r}; known: {known}")
        label_map = _WELL_KNOWN[label_map]
    elif (classes := take(label_map, "class_map")) is not None:
        label_map = {
            take(entry, "class_id"): take(entry, "class_name")
            for entry in items(classes, "class_map")
            if isinstance(take(entry, "class_id"), int | str)
        }
    if isinstance(label_map, Mapping):
        pairs = list(label_map.items())
    elif isinstance(label_map, Sequence):
        pairs = list(enumerate(label_map))
    else:
        raise MessageError(
            "label_map must be a mapping, a list of labels, a vision_msgs/LabelInfo or a name"
        )
    labels: dict[str, str | None] = {}
    for class_id, label in pairs:
        if not (label is None or isinstance(label, str)):
            raise MessageError("every entry of label_map must be a label or None")
        labels[str(class_id).strip()] = label
    return labels
