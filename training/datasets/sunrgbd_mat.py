"""SUN RGB-D 3D boxes (Song, Lichtenberg & Xiao, CVPR 2015): ``SUNRGBDMeta3DBB_v2.mat``.

The file contains a struct array ``SUNRGBDMeta`` with one element for each camera frame. Its field
``groundtruth3DBB`` is a struct array of boxes with the fields ``basis`` (rows are the box axes),
``coeffs`` (half extents along these axes), ``centroid`` and ``classname``. Coordinates are in
metres, with x to the right, y away from the camera and z up. The coordinates are already corrected
for the tilt of the camera.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, TypeAdapter, ValidationError
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from training.datasets.array_types import Floats
from training.datasets.files import check_size, position_and_problem
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError, Label, Text

SOURCE = "sunrgbd-mat"

MAX_BYTES: Final = 256 * 2**20
"""Maximum size of a file in bytes, after decompression. Text needs five times its size."""

# Types of elements of the file, and classes of arrays that have entries of any type.
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT = 1, 2, 3
# Bytes that an entry of a cell or struct array counts at least. It costs so much memory.
_ENTRY = 64

_BLOCK = 20  # consecutive frames in a group; they often show the same place


def _structs(value: Any) -> list[Any]:
    """Convert a struct array to a list: a struct, several, or an empty matrix for none."""
    if isinstance(value, dict):
        return [value]
    return list(value) if isinstance(value, list) else list(np.atleast_1d(value))


def _finite(*shape: int) -> BeforeValidator:
    """Return a check that a value is an array of finite numbers of a shape."""

    def check(value: Any) -> Floats:
        array = np.asarray(value, dtype=np.float64)
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"must be finite, of shape {shape}, not {value!r}")
        return array

    return BeforeValidator(check)


class _Box(BaseModel):
    """A box. The rows of the basis are its axes, and coeffs the half extents along them."""

    basis: Annotated[Any, _finite(3, 3)]
    coeffs: Annotated[Any, _finite(3)]
    centroid: Annotated[Any, _finite(3)]
    classname: Label

    def to_object(self, number: int) -> AnnotatedObject:
        """Return the object of the box. Its upright axis has the largest z component."""
        # Some boxes in the file have negative half extents, so use the absolute values.
        size = (2 * np.abs(self.coeffs)).tolist()
        x, y, z = self.centroid.tolist()
        upright = int(np.abs(self.basis[:, 2]).argmax())
        ahead, aside = (upright + 1) % 3, (upright + 2) % 3
        return AnnotatedObject(
            id=str(number),
            label=self.classname.strip(),
            # In the file, x points right and y ahead. In viewer axes, x points ahead and y left.
            position=(y, -x, z),
            size=(size[ahead], size[aside], size[upright]),
            yaw=math.atan2(-float(self.basis[ahead, 0]), float(self.basis[ahead, 1])),
        )


class _Frame(BaseModel):
    name: Annotated[Text, Field(alias="sequenceName")]
    boxes: Annotated[list[_Box], BeforeValidator(_structs), Field(alias="groundtruth3DBB")]


_FRAMES = TypeAdapter(Annotated[list[_Frame], BeforeValidator(_structs)])


def read_sunrgbd_mat(path: Path) -> list[AnnotatedScene]:
    """Read all frames with boxes. ``<sequenceName>/scene.txt`` contains the room type."""
    try:
        frames = _FRAMES.validate_python(_load(path))
    except ValidationError as error:
        raise DatasetError(path, *position_and_problem(error)) from error
    scenes: list[AnnotatedScene] = []
    counts: Counter[str] = Counter()
    for frame in frames:
        name = frame.name.strip().strip("/")
        collection = "/".join(name.split("/")[:3])
        if "sun3ddata" in name:
            group = "sunrgbd-" + "/".join(name.split("/")[:4])  # this path names the place
        else:
            group = f"sunrgbd-{collection}-{counts[collection] // _BLOCK}"
        counts[collection] += 1
        objects = tuple(box.to_object(index) for index, box in enumerate(frame.boxes))
        if objects:
            note = path.parent / name / "scene.txt"
            room = (note.read_text(encoding="utf-8").strip() if note.is_file() else "") or None
            scenes.append(AnnotatedScene(name, SOURCE, group, room, objects, viewer_frame=True))
    return scenes


def _load(path: Path) -> Any:
    """Return the variable SUNRGBDMeta of a MATLAB file. Raise DatasetError if it has none."""
    try:
        _check_sizes(path)
        content = loadmat(path, simplify_cells=True)
    except DatasetError:
        raise
    except RecursionError as error:
        raise DatasetError(path, "", "the arrays are nested too deeply") from error
    except (OSError, ValueError, TypeError, MatReadError, struct.error, zlib.error) as error:
        raise DatasetError(path, "", f"is not a MATLAB 5 file: {error}") from error
    if "SUNRGBDMeta" not in content:
        raise DatasetError(path, "", "the file lacks the variable SUNRGBDMeta of SUN RGB-D")
    return content["SUNRGBDMeta"]


def _check_sizes(path: Path) -> None:
    """Check compressed data and announced entries, before `loadmat` allocates memory for them."""
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    check_size(path, len(content), MAX_BYTES)
    orders = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}  # version and byte order
    if (order := orders.get(content[124:128])) is None:
        raise ValueError("its header names another version")
    size = 0

    def check(data: memoryview) -> None:
        """Add up the sizes of all elements in data, and of those within them."""
        nonlocal size
        for kind, body in _elements(data, order):
            if kind == _COMPRESSED:
                body = memoryview(zlib.decompressobj().decompress(body, MAX_BYTES + 1))
                size += len(body)
                check_size(path, size, MAX_BYTES)
                check(body)
            elif kind == _MATRIX and body and (entries := _entries(body, order)):
                size += _ENTRY * entries
                check_size(path, size, MAX_BYTES)
                check(body)

    check(memoryview(content)[128:])


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield type and contents of each element."""
    offset = 0
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        if kind >> 16:  # the contents are in the tag
            yield kind & 0xFFFF, data[offset + 4 : offset + 4 + (kind >> 16)]
            offset += 8
        else:
            yield kind, data[offset + 8 : offset + 8 + size]
            offset += 8 + size + (-size % 8 if kind != _COMPRESSED else 0)  # padded to 8 bytes


def _entries(body: memoryview, order: str) -> int:
    """Return the number of entries that the header of a cell or struct array announces."""
    parts = _elements(body, order)
    flags, shape = (next(parts, (0, body[:0]))[1] for _ in range(2))
    kind = struct.unpack_from(f"{order}I", flags)[0] & 0xFF
    if kind not in (_CELL, _STRUCT, _OBJECT):
        return 0
    count = abs(math.prod(struct.unpack(f"{order}{len(shape) // 4}i", shape)))
    if kind == _CELL:
        return count
    # A struct has an entry for each field. The names of the fields have the same `length`.
    _, (_, length), (_, names) = (next(parts, (0, body[:0])) for _ in range(3))
    return count * (len(names) // max(1, struct.unpack_from(f"{order}i", length)[0]))
