"""A scene as observed by one viewer: objects, and their relations.

`observe` derives the relations of a scene from the poses of its objects. Scenes contain instances
(objects), but models only know classes: `app.questions.posterior` pools the instances of a class.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.scene.geometry import (
    SMALLEST,
    Viewpoint,
    derive_relations,
    excluded_by_centres,
    to_viewer_frame,
)
from app.scene.relation_table import EXCLUDED, RelationTable, Triple
from app.scene.roles import RoleCounts

Point = tuple[float, float, float]


# The class is not frozen, because creating a frozen instance takes four times as long. A scene can
# have dozens of objects.
@dataclass(slots=True, unsafe_hash=True)
class SceneObject:
    """One object in a scene. Do not change its attributes. Lengths are in metres."""

    id: str
    label: str  # in the request
    class_index: int | None  # None: the vocabulary does not contain the label
    confidence: float = 1.0  # probability in (0, 1] that the object exists
    position: Point | None = None  # centre (x, y, z) in viewer axes: x away, y left, z up
    size: Point | None = None  # extents (x, y, z) before the rotation
    yaw: float = 0.0  # rotation about z in radians


@dataclass(frozen=True, slots=True)
class Scene:
    """Objects and their relations."""

    objects: tuple[SceneObject, ...]
    relations: RelationTable | None = None  # None: nothing states or shows a relation
    room_type: int | None = None
    profile: int | None = None  # source whose base rates apply. None: inferred from the objects

    @property
    def triples(self) -> tuple[Triple, ...]:
        """The relations that hold."""
        return () if self.relations is None else self.relations.triples

    @property
    def opposites(self) -> frozenset[Triple]:
        """The relations that the request states by their opposite."""
        return frozenset() if self.relations is None else self.relations.opposites

    @property
    def has_boxes(self) -> bool:
        """Whether the observed relations come from boxes."""
        return self.relations is not None and self.relations.of_boxes


# ------------------------------------------------------------------------- relations from poses

_UNKNOWN = (math.nan, math.nan, math.nan)


def observe(
    scene: Scene,
    *,
    viewpoint: Viewpoint | None = None,  # None: at the origin, looking along x
    has_viewer: bool = True,  # False: left and front are undefined
    typical_sizes: Float[NDArray[np.float64], "V 3"] | None = None,  # `Vocabulary.sizes`
    stand_in: Int[NDArray[np.int64], "V"] | None = None,  # `Vocabulary.stand_in`; None: itself
    roles: RoleCounts | None = None,  # see `derive_relations`
) -> Scene:
    """Derive the relations of a scene from the poses of its objects.

    Positions and yaws must be in body axes (x forward, y left, z up). The result has viewer axes.
    If the scene states relations, the function only adds those that the boxes exclude. It returns a
    scene without positions unchanged. Typical extents in metres replace missing sizes of objects,
    and sizes below `SMALLEST`. NaN means an unknown size.
    """
    if all(thing.position is None for thing in scene.objects):
        return scene
    objects = scene.objects if viewpoint is None else _in_viewer_frame(scene.objects, viewpoint)
    points, sizes = boxes_of(objects, typical_sizes)
    classes = np.array([-1 if one.class_index is None else one.class_index for one in objects])
    if stand_in is not None:
        classes = np.where(classes >= 0, stand_in[classes], classes)
    poses = derive_relations(
        points,
        sizes,
        [thing.yaw for thing in objects],
        horizontal=has_viewer,
        classes=classes,
        roles=roles,
    )
    far = excluded_by_centres(points, sizes, horizontal=has_viewer)
    if scene.relations is not None:
        excluded = far | (poses.observed & ~poses.holds)
        return replace(scene, relations=scene.relations.excluding(excluded, EXCLUDED))
    table = RelationTable.shown_by_boxes(poses.holds, poses.observed, far)
    return replace(scene, objects=objects, relations=table)


def _in_viewer_frame(
    objects: tuple[SceneObject, ...], viewpoint: Viewpoint
) -> tuple[SceneObject, ...]:
    positions, yaws = to_viewer_frame(
        [thing.position or _UNKNOWN for thing in objects], viewpoint, [one.yaw for one in objects]
    )
    poses = zip(objects, map(tuple, positions.tolist()), yaws.tolist(), strict=True)
    return tuple(
        thing if thing.position is None else replace(thing, position=position, yaw=yaw)
        for thing, position, yaw in poses
    )


def boxes_of(
    objects: Sequence[SceneObject], typical_sizes: Float[NDArray[np.float64], "V 3"] | None
) -> tuple[Float[NDArray[np.float64], "n 3"], Float[NDArray[np.float64], "n 3"]]:
    """Return centres and extents, typical ones for implausible sizes, and NaN where unknown."""
    centres = np.array([thing.position or _UNKNOWN for thing in objects]).reshape(-1, 3)
    indices = [-1 if thing.class_index is None else thing.class_index for thing in objects]
    extents = np.full((len(objects), 3), math.nan)
    if typical_sizes is not None:
        extents = typical_sizes[indices]
    for row, thing in enumerate(objects):
        if thing.size is not None and max(thing.size) >= SMALLEST:
            extents[row] = thing.size
        elif thing.class_index is None:
            extents[row] = math.nan
    return centres, extents


@compiled
def pool_classes(
    classes: Int[NDArray, " N"], confidence: Float[NDArray, " N"]
) -> tuple[
    Int[NDArray, " n"], Int[NDArray, " n"], Int[NDArray, " N"], Int[NDArray, " n"],
    Float[NDArray, " n"],
]:  # fmt: skip
    """Return the n distinct classes of N instances, ascending.

    The other results are the index of the first instance of each class, the row of each instance's
    class, the number of instances of each class, and the probability that at least one exists.
    """
    N = len(classes)
    distinct, first, counts = np.empty(N, np.int64), np.empty(N, np.int64), np.zeros(N, np.int64)
    order, row, presence, n = np.empty(N, np.int64), np.empty(N, np.int64), np.empty(N), 0
    for k in range(N):  # insertion sort
        rank = k
        while rank and classes[order[rank - 1]] > classes[k]:
            order[rank] = order[rank - 1]
            rank -= 1
        order[rank] = k
    absent = 1.0
    for k in range(N):
        instance = order[k]
        if n == 0 or distinct[n - 1] != classes[instance]:
            distinct[n], first[n], absent = classes[instance], instance, 1.0
            n += 1
        row[instance] = n - 1
        counts[n - 1] += 1
        absent *= 1.0 - confidence[instance]
        presence[n - 1] = 1.0 - absent
    return distinct[:n], first[:n], row, counts[:n], presence[:n]
