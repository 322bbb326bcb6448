"""A scene as observed by one viewer: objects and their relations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NoReturn

from app.scene.geometry import PoseRelations
from app.scene.relations import CANONICAL, contradiction

Point = tuple[float, float, float]


# The class is not frozen, because creating a frozen instance takes four times as long. A scene can
# have dozens of objects.
@dataclass(slots=True, unsafe_hash=True)
class SceneObject:
    """One object in a scene. Do not change its attributes.

    Attributes:
        id: name of the object in this scene.
        label: label of the object in the request.
        class_index: index of the object's class in the model's vocabulary. None means that the
            vocabulary does not contain the label.
        confidence: probability in (0, 1] that the object exists.
        position: centre (x, y, z) in metres in viewer axes (x away, y left, z up). None means that
            the position is unknown.
        size: extents (x, y, z) in metres before the rotation. None means that the size is unknown.
        yaw: rotation of the object about z in radians.

    Raises:
        ValueError: a value is outside its range.
    """

    id: str
    label: str
    class_index: int | None
    confidence: float = 1.0
    position: Point | None = None
    size: Point | None = None
    yaw: float = 0.0

    def __post_init__(self) -> None:
        if self.class_index is not None and self.class_index < 0:
            raise ValueError(
                f"class_index of {self.id!r} must not be negative, but is {self.class_index}"
            )
        if not 0.0 < self.confidence <= 1.0:
            raise ValueError(f"confidence of {self.id!r} must be in (0, 1], not {self.confidence}")
        if self.position is not None and not _are_finite(self.position):
            raise ValueError(f"position of {self.id!r} must be three finite numbers (metres)")
        if self.size is not None and not (_are_finite(self.size) and min(self.size) >= 0):
            raise ValueError(f"size of {self.id!r} must be three numbers of at least 0 (metres)")
        if not math.isfinite(self.yaw):
            raise ValueError(f"yaw of {self.id!r} must be finite, not {self.yaw}")


@dataclass(frozen=True, slots=True)
class Scene:
    """Objects and their relations.

    Attributes:
        objects: objects of the scene. ``relations`` refers to their indices in this tuple.
        relations: triples (canonical relation, subject, object) that hold. None means that all
            relations are unobserved.
        relations_complete: True if all relations that are missing from ``relations`` are known not
            to hold.
        room_type: index of the room type in the model's vocabulary. None means that the room type
            is unknown.
        poses: relations derived from poses by `app.scene.observe`. They include relations observed
            not to hold, and replace ``relations`` as evidence. ``relations`` must list the derived
            relations that hold, but the class does not check this condition. None means that no
            relations were derived from poses.

    Raises:
        ValueError: two objects have the same id, a triple is invalid, or `relations_complete` is
            True although `relations` is None. A triple is invalid if it has an invalid index,
            relates an object to itself or contradicts another triple.
    """

    objects: tuple[SceneObject, ...]
    relations: tuple[tuple[int, int, int], ...] | None = None
    relations_complete: bool = False
    room_type: int | None = None
    poses: PoseRelations | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.objects)
        if len({thing.id for thing in self.objects}) < n:
            raise ValueError("two objects of the scene have the same id; each id must be unique")
        if self.relations is None:
            if self.relations_complete:
                raise ValueError(
                    "relations_complete is True, but relations is None; pass a tuple of relations"
                )
        elif self.poses is None:
            for triple in self.relations:
                relation, subject, anchor = triple
                ends_exist = 0 <= subject < n and 0 <= anchor < n
                if subject == anchor or not (ends_exist and 0 <= relation < len(CANONICAL)):
                    self._refuse(triple, n)
            if clash := contradiction(self.relations):
                (relation, i, j), _ = clash
                first, second = self.objects[i].id, self.objects[j].id
                raise ValueError(
                    f"{CANONICAL[relation]!r} is stated from {first!r} to {second!r} and also from "
                    f"{second!r} to {first!r}, but both cannot hold"
                )
        if self.poses is not None and self.poses.holds.shape != (len(CANONICAL), n, n):
            raise ValueError(
                f"poses must have the shape {(len(CANONICAL), n, n)}, not {self.poses.holds.shape}"
            )

    def _refuse(self, triple: tuple[int, int, int], n: int) -> NoReturn:
        relation, subject, anchor = triple
        if not 0 <= relation < len(CANONICAL):
            raise ValueError(
                f"a relation index must be from 0 to {len(CANONICAL) - 1}, not {relation}"
            )
        for end in (subject, anchor):
            if not 0 <= end < n:
                raise ValueError(f"the object index {end} of a relation is not from 0 to {n - 1}")
        raise ValueError(
            f"{self.objects[subject].id!r} has the relation {CANONICAL[relation]} to itself; a "
            "relation needs two different objects"
        )


def _are_finite(point: Sequence[float]) -> bool:
    # A loop would be slower. This function runs twice for every object.
    finite = math.isfinite
    return len(point) == 3 and finite(point[0]) and finite(point[1]) and finite(point[2])
