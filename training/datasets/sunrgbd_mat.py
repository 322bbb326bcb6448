"""SUN RGB-D 3D boxes (Song, Lichtenberg & Xiao, CVPR 2015): ``SUNRGBDMeta3DBB_v2.mat``.

The file contains a struct array ``SUNRGBDMeta`` with one element for each camera frame. Its field
``groundtruth3DBB`` is a struct array of boxes with the fields ``basis`` (rows are the box axes),
``coeffs`` (half extents along these axes), ``centroid`` and ``classname``. Coordinates are in
metres, with x to the right, y away from the camera and z up. The coordinates are already corrected
for the tilt of the camera.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from training.datasets.files import located, take
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError

SOURCE = "sunrgbd-mat"

# Number of consecutive frames in a group. Consecutive frames often show the same place.
_BLOCK = 20


def read_sunrgbd_mat(path: Path) -> list[AnnotatedScene]:
    """Read all camera frames with boxes as scenes.

    The file ``<sequenceName>/scene.txt`` gives the room type, if the image folders are in the same
    folder as the MATLAB file. Frames of one SUN3D place are in one group. Other frames form groups
    of 20 consecutive frames from one sensor and collection.

    Raises:
        DatasetError: the file does not have the official format.
    """
    scenes: list[AnnotatedScene] = []
    taken: Counter[str] = Counter()
    for number, frame in enumerate(_structs(_load(path))):
        where = f"SUNRGBDMeta({number + 1})"
        name = _text(path, where, frame, "sequenceName").strip("/")
        collection = "/".join(name.split("/")[:3])
        if "sun3ddata" in name:
            group = "sunrgbd-" + "/".join(name.split("/")[:4])
        else:
            group = f"sunrgbd-{collection}-{taken[collection] // _BLOCK}"
        taken[collection] += 1
        boxes = _structs(take(path, where, frame, "groundtruth3DBB", object))
        objects = tuple(
            _box(path, f"{where}.groundtruth3DBB({position + 1})", position, box)
            for position, box in enumerate(boxes)
        )
        if objects:
            scenes.append(
                AnnotatedScene(
                    scene_id=name,
                    source=SOURCE,
                    group=group,
                    room_type=_room_type(path.parent / name / "scene.txt"),
                    objects=objects,
                    viewer_frame=True,
                )
            )
    return scenes


def _load(path: Path) -> Any:
    try:
        content = loadmat(path, simplify_cells=True)
    except (OSError, ValueError, TypeError, NotImplementedError, MatReadError) as error:
        raise DatasetError(path, "", f"is not a MATLAB 5 file: {error}") from error
    if "SUNRGBDMeta" not in content:
        raise DatasetError(path, "", "the file lacks the variable SUNRGBDMeta of SUN RGB-D")
    return content["SUNRGBDMeta"]


def _structs(value: Any) -> list[Any]:
    """Convert a MATLAB struct array to a list.

    The value is a single struct, several structs, or an empty matrix for an empty array.
    """
    if isinstance(value, dict):
        return [value]
    return list(value) if isinstance(value, list) else list(np.atleast_1d(value))


def _text(path: Path, where: str, struct: Any, name: str) -> str:
    value = take(path, where, struct, name, object)
    if not isinstance(value, str) or not value.strip():
        raise DatasetError(path, where, f"{name} must be a non-empty string, not {value!r}")
    return value.strip()


def _array(path: Path, where: str, struct: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    value = take(path, where, struct, name, object)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DatasetError(path, where, f"{name} is not numeric") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise DatasetError(path, where, f"{name} must be finite, of shape {shape}, not {value!r}")
    return array


def _box(path: Path, where: str, number: int, struct: Any) -> AnnotatedObject:
    basis = _array(path, where, struct, "basis", (3, 3))
    # Some boxes in the file have negative half extents, so use the absolute values.
    half = np.abs(_array(path, where, struct, "coeffs", (3,)))
    x, y, z = _array(path, where, struct, "centroid", (3,)).tolist()
    upright = int(np.abs(basis[:, 2]).argmax())
    ahead, aside = (upright + 1) % 3, (upright + 2) % 3
    with located(path, where):
        return AnnotatedObject(
            id=str(number),
            label=_text(path, where, struct, "classname"),
            # In the file, x points right and y away from the camera. In viewer axes, x points away
            # from the viewer and y left.
            position=(y, -x, z),
            size=(2 * float(half[ahead]), 2 * float(half[aside]), 2 * float(half[upright])),
            yaw=math.atan2(-float(basis[ahead, 0]), float(basis[ahead, 1])),
        )


def _room_type(path: Path) -> str | None:
    return path.read_text(encoding="utf-8").strip() or None if path.is_file() else None
