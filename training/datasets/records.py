"""Annotated scenes: the common output of all readers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from app.scene import RELATIONS

Point = tuple[float, float, float]
Box2d = tuple[float, float, float, float]

MAX_COUNT: Final = 1_000_000
MAX_PROBLEM: Final = 500
"""Maximum length of an error text, in characters."""


class DatasetError(ValueError):
    """A data file cannot be read or is malformed.

    Args:
        path: the file.
        where: position in the file, such as ``line 3`` or ``scans[0].objects[2]``.
        problem: description of the error.
    """

    def __init__(self, path: Path, where: str, problem: str) -> None:
        if len(problem) > MAX_PROBLEM:  # the text may quote a value of several megabytes
            problem = problem[:MAX_PROBLEM] + "…"
        super().__init__(f"{path}, {where}: {problem}" if where else f"{path}: {problem}")
        self.path = path
        self.where = where
        self.problem = problem


@dataclass(frozen=True, slots=True)
class AnnotatedObject:
    """One annotated object.

    Attributes:
        id: id of the object, distinct within the scene.
        label: label as annotated.
        position: centre (x, y, z) in metres, or None.
        size: extents (x, y, z) in metres before rotation by the yaw, or None.
        yaw: rotation about z in radians.
        supported_by: id of the supporting object, or None.
        box2d: (xmin, ymin, xmax, ymax) in the image, y downwards, or None.
        count: number of instances that this entry represents.

    Raises:
        ValueError: numbers are not finite, or extents or the count are not positive.
    """

    id: str
    label: str
    position: Point | None = None
    size: Point | None = None
    yaw: float = 0.0
    supported_by: str | None = None
    box2d: Box2d | None = None
    count: int = 1

    def __post_init__(self) -> None:
        if not self.label:
            raise ValueError(f"object {self.id!r} has an empty label")
        _check_numbers("position", self.id, self.position, 3)
        _check_numbers("size", self.id, self.size, 3)
        _check_numbers("box2d", self.id, self.box2d, 4)
        if self.size is not None and min(self.size) <= 0:
            raise ValueError(f"size of {self.id!r} must be positive, not {self.size}")
        if self.box2d is not None and (
            self.box2d[0] > self.box2d[2] or self.box2d[1] > self.box2d[3]
        ):
            raise ValueError(
                f"box2d of {self.id!r} must be (xmin, ymin, xmax, ymax), not {self.box2d}"
            )
        if not math.isfinite(self.yaw):
            raise ValueError(f"yaw of {self.id!r} must be finite, not {self.yaw}")
        if not 1 <= self.count <= MAX_COUNT:
            raise ValueError(f"count of {self.id!r} must be 1 to {MAX_COUNT}, not {self.count}")


@dataclass(frozen=True, slots=True)
class AnnotatedScene:
    """One annotated scene.

    Attributes:
        scene_id: id of the scene, distinct within its source.
        source: name of the data set.
        group: group of near-duplicates, such as frames of one place or scans of one room.
        room_type: room type as annotated, or None.
        objects: the objects of the scene.
        relations: (subject index, relation, object index) with one of the eight relations; the
            indices refer to ``objects``. None if relations were not annotated.
        viewer_frame: True if positions are in viewer axes. Otherwise left and front are undefined
            until a viewpoint is chosen.
        false_relations: relations that an annotator denied, in the form of ``relations``.

    Raises:
        ValueError: ids are not distinct, or a support or relation names an unknown object.
    """

    scene_id: str
    source: str
    group: str
    room_type: str | None
    objects: tuple[AnnotatedObject, ...]
    relations: tuple[tuple[int, str, int], ...] | None = None
    viewer_frame: bool = False
    false_relations: tuple[tuple[int, str, int], ...] = ()

    def __post_init__(self) -> None:
        ids = {thing.id for thing in self.objects}
        if len(ids) < len(self.objects):
            raise ValueError(f"scene {self.scene_id!r} has two objects with the same id")
        for thing in self.objects:
            if thing.supported_by is not None and thing.supported_by not in ids:
                raise ValueError(
                    f"supported_by of {thing.id!r} is {thing.supported_by!r}, which is no object"
                )
        for subject, relation, anchor in (*(self.relations or ()), *self.false_relations):
            if relation not in RELATIONS:
                raise ValueError(f"unknown relation {relation!r}")
            for end in (subject, anchor):
                if not 0 <= end < len(self.objects):
                    raise ValueError(
                        f"a relation has object index {end}, "
                        f"but the scene has {len(self.objects)} objects"
                    )


def _check_numbers(name: str, owner: str, values: Sequence[float] | None, length: int) -> None:
    if values is None:
        return
    if len(values) != length or not all(map(math.isfinite, values)):
        raise ValueError(f"{name} of {owner!r} must be {length} finite numbers, not {values}")
