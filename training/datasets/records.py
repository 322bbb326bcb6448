"""Annotated scenes, the common result of all readers of scene files."""

from __future__ import annotations

import hashlib
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
"""Maximum length of the text of a `DatasetError`, in characters."""


class DatasetError(ValueError):
    """A data file cannot be read or has invalid content at a position, such as ``line 3``."""

    def __init__(self, path: Path, where: str, problem: str) -> None:
        if len(problem) > MAX_PROBLEM:  # the text can contain a value of several megabytes
            problem = problem[:MAX_PROBLEM] + "…"
        super().__init__(f"{path}, {where}: {problem}" if where else f"{path}: {problem}")
        self.path = path
        self.where = where
        self.problem = problem


@dataclass(frozen=True, slots=True)
class AnnotatedObject:
    """One annotated object. None means that a value is unknown.

    Raises:
        ValueError: the label is empty, or a number is not finite or out of range.
    """

    id: str  # distinct within the scene
    label: str
    position: Point | None = None  # centre (x, y, z) in metres
    size: Point | None = None  # extents before rotation by the yaw, (x, y, z) in metres
    yaw: float = 0.0  # rotation about the z axis in radians
    supported_by: str | None = None  # id of the supporting object
    box2d: Box2d | None = None  # (xmin, ymin, xmax, ymax) in the image, with y downwards
    count: int = 1  # number of instances that this entry represents

    def __post_init__(self) -> None:
        if not self.label:
            raise ValueError(f"object {self.id!r} has an empty label")
        for name, length in (("position", 3), ("size", 3), ("box2d", 4)):
            x = getattr(self, name)
            if x is not None and (len(x) != length or not all(map(math.isfinite, x))):
                raise ValueError(f"{name} of {self.id!r} must be {length} finite numbers, not {x}")
        if self.size is not None and min(self.size) < 0:
            raise ValueError(f"size of {self.id!r} must not be negative, but is {self.size}")
        if self.box2d and (self.box2d[0] > self.box2d[2] or self.box2d[1] > self.box2d[3]):
            corners = "(xmin, ymin, xmax, ymax)"
            raise ValueError(f"box2d of {self.id!r} must be {corners}, not {self.box2d}")
        if not math.isfinite(self.yaw):
            raise ValueError(f"yaw of {self.id!r} must be finite, not {self.yaw}")
        if not 1 <= self.count <= MAX_COUNT:
            raise ValueError(f"count of {self.id!r} must be 1 to {MAX_COUNT}, not {self.count}")


@dataclass(frozen=True, slots=True)
class AnnotatedScene:
    """One annotated scene. Relations are triples (subject index, relation, object index).

    Raises:
        ValueError: two objects have the same id, or a link or relation names an unknown object.
    """

    scene_id: str  # distinct within the data source
    source: str
    group: str  # name of a group of near-duplicate scenes, such as frames of one place
    room_type: str | None  # as in the data set; None means unknown
    objects: tuple[AnnotatedObject, ...]
    relations: tuple[tuple[int, str, int], ...] | None = None  # None: not annotated
    # True if positions are in viewer axes. Otherwise a viewpoint must be chosen for left and front.
    viewer_frame: bool = False
    false_relations: tuple[tuple[int, str, int], ...] = ()  # marked as false by an annotator
    # Indices of the objects whose support is listed, also by other relations than the ten of the
    # service, such as "attached to".
    supported: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        ids = {thing.id for thing in self.objects}
        if len(ids) < len(self.objects):
            raise ValueError(f"scene {self.scene_id!r} has two objects with the same id")
        for thing in self.objects:
            if thing.supported_by is not None and thing.supported_by not in ids:
                raise ValueError(
                    f"supported_by of {thing.id!r} is {thing.supported_by!r}, which is no object "
                    "of the scene"
                )
        size = len(self.objects)
        for subject, relation, anchor in (*(self.relations or ()), *self.false_relations):
            if relation not in RELATIONS:
                raise ValueError(f"unknown relation {relation!r}")
            if unknown := [end for end in (subject, anchor) if not 0 <= end < size]:
                raise ValueError(
                    f"a relation has object index {unknown[0]}, but the scene has {size} objects"
                )


def digest_of(scenes: Sequence[AnnotatedScene]) -> str:
    """Return the sha256 of the contents of the scenes. It does not depend on the file format."""
    return hashlib.sha256("".join(map(repr, scenes)).encode()).hexdigest()
