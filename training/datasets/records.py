"""Annotated scenes as every reader returns them."""

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
"""Characters of what is wrong."""


class DatasetError(ValueError):
    """A data file that cannot be read as what it claims to be.

    Args:
        path: the file.
        where: the line or entry in it, such as ``line 3`` or ``scans[0].objects[2]``.
        problem: what is wrong there.
    """

    def __init__(self, path: Path, where: str, problem: str) -> None:
        if len(problem) > MAX_PROBLEM:  # it may quote a value of megabytes
            problem = problem[:MAX_PROBLEM] + "…"
        super().__init__(f"{path}, {where}: {problem}" if where else f"{path}: {problem}")
        self.path = path
        self.where = where
        self.problem = problem


@dataclass(frozen=True, slots=True)
class AnnotatedObject:
    """One annotated thing.

    Attributes:
        id: its name in the scene.
        label: its label as annotated.
        position: centre (x, y, z) in metres, or None.
        size: extents (x, y, z) in metres before the yaw, or None.
        yaw: turn about z in radians.
        supported_by: id of the thing that carries it, or None.
        box2d: (xmin, ymin, xmax, ymax) in the image, y downwards, or None.
        count: instances that this entry stands for.

    Raises:
        ValueError: numbers that are not finite, or extents or a count that are not positive.
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
        scene_id: its name, distinct within its source.
        source: the data set it comes from.
        group: near-duplicates (frames of one place, scans of one room) share it.
        room_type: as annotated, or None.
        objects: the things in it.
        relations: (subject, relation, object) with positions in ``objects`` and one of the eight
            relations; None = nobody annotated any.
        viewer_frame: positions are in viewer axes; otherwise left and front mean nothing in them
            until a viewpoint is chosen.
        false_relations: in the form of ``relations``, those that an annotator denied.

    Raises:
        ValueError: ids that are not distinct, or links and relations that point nowhere.
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
            raise ValueError(f"scene {self.scene_id!r} has two objects with one id")
        for thing in self.objects:
            if thing.supported_by is not None and thing.supported_by not in ids:
                raise ValueError(f"{thing.id!r} is supported by {thing.supported_by!r}: no such id")
        for subject, relation, anchor in (*(self.relations or ()), *self.false_relations):
            if relation not in RELATIONS:
                raise ValueError(f"unknown relation {relation!r}")
            for end in (subject, anchor):
                if not 0 <= end < len(self.objects):
                    raise ValueError(f"a relation names object {end} of {len(self.objects)}")


def _check_numbers(name: str, owner: str, values: Sequence[float] | None, length: int) -> None:
    if values is None:
        return
    if len(values) != length or not all(map(math.isfinite, values)):
        raise ValueError(f"{name} of {owner!r} must be {length} finite numbers, not {values}")
