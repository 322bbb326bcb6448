"""Cases of moved objects: one object of a scene stands at a wrong place.

Scenes with boxes get another pose of the object, and others another support relation. Strangers are
two objects whose classes never stand on or in each other in the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from app.scene import Scene
from app.scene.footprints import overlap_and_gap
from app.scene.scene import CONTACT
from app.scene.spatial_relations import ON_TOP, SUPPORTS
from app.scene.stands import FLOOR
from training.datasets.array_types import ClassMask, Rng
from training.datasets.cases import Triple, draw_true_relations, scene_of
from training.datasets.encoding import EncodedScene

_ATTEMPTS: Final = 50  # random spots that are tried
_LIFTED: Final = 1 / 3  # share of cases in which an object is lifted from the floor
_LIFTED_STATED: Final = 1 / 2  # the same share for stated supports
_LEAST_STEP: Final = 0.3  # minimum height in metres between the old and the new place
_LEAST_AREA: Final = 0.5  # minimum area under a lifted object, as a share of its footprint
_REACH: Final = 0.5  # maximum distance in metres between a supporter and an object beside it
_CENTRAL: Final = 0.25  # half of the share of a top, along each axis, where centres are placed
_FLOAT: Final = (0.3, 1.0)  # least and largest lift in metres of a floating object
_SINK: Final = (0.4, 0.9)  # least and largest share of the height of a sunk object that sinks
_LEAST_SINK: Final = 0.15  # minimum depth in metres


def has_boxes(encoded: EncodedScene) -> bool:
    """Return whether the scene has an object with position and size."""
    if encoded.instance_positions is None or encoded.instance_sizes is None:
        return False
    centre, size = encoded.instance_positions, encoded.instance_sizes
    return bool((np.isfinite(centre) & np.isfinite(size)).all(1).any())


def posed_scene(encoded: EncodedScene) -> Scene:
    """Return a scene with the poses of all instances, without relations."""
    centre, size, yaw = _poses(encoded)
    bare = scene_of(encoded, range(len(yaw)), ())
    objects = tuple(
        replace(
            thing,
            position=_point(at) if np.isfinite(at).all() else None,
            size=_point(extents) if np.isfinite(extents).all() else None,
            yaw=turn,
        )
        for thing, at, extents, turn in zip(bare.objects, centre, size, yaw.tolist(), strict=True)
    )
    return replace(bare, objects=objects)


def _poses(
    encoded: EncodedScene,
) -> tuple[Float[NDArray, "N 3"], Float[NDArray, "N 3"], Float[NDArray, "N"]]:
    """Return the positions, sizes and yaws of a scene whose relations come from positions."""
    centre, size, yaw = encoded.instance_positions, encoded.instance_sizes, encoded.instance_yaws
    if centre is None or size is None or yaw is None:
        raise ValueError(f"the relations of scene {encoded.scene_id!r} do not come from positions")
    return centre, size, yaw


def _point(row: Float[NDArray, "3"]) -> tuple[float, float, float]:
    x, y, z = row.tolist()
    return x, y, z


def untouched_scene(encoded: EncodedScene, structure: ClassMask, rng: Rng) -> Scene | None:
    """Return the scene of `moved_scene` before the move, with an equal `rng`."""
    if has_boxes(encoded):
        return posed_scene(encoded)
    triples = draw_true_relations(encoded, structure, rng)
    return scene_of(encoded, range(len(encoded.instance_classes)), triples) if triples else None


def moved_scene(encoded: EncodedScene, structure: ClassMask, rng: Rng) -> tuple[Scene, int] | None:
    """Return `moved_by_pose` for a scene with boxes, and `moved_by_triple` for other scenes."""
    return (moved_by_pose if has_boxes(encoded) else moved_by_triple)(encoded, structure, rng)


def moved_by_triple(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> tuple[Scene, int] | None:
    """Return a scene in which one "i on or in j" is "i on top of a stranger k", and the index i."""
    triples = draw_true_relations(encoded, structure, rng) or []
    supports = [(i, j) for a, i, j in triples if a in SUPPORTS]
    strange: Bool[NDArray, "N N"] = _strangers(encoded) & ~structure[encoded.instance_classes]
    for index in rng.permutation(len(supports)).tolist():
        i, j = supports[index]
        if len(anchors := np.flatnonzero(strange[i])):
            k = int(rng.choice(anchors))
            # Without the other supports of i, and without relations between i and j or k.
            others = [
                (a, x, y)
                for a, x, y in triples
                if {x, y} not in ({i, j}, {i, k}) and not (a in SUPPORTS and x == i)
            ]
            every = range(len(encoded.instance_classes))
            return scene_of(encoded, every, [*others, (ON_TOP, i, k)]), i
    return None


def stacked_by_triple(
    encoded: EncodedScene, structure: ClassMask, triples: Sequence[Triple], rng: Rng
) -> tuple[list[Triple], Triple] | None:
    """Return true triples with a false support, and the false support; None without any.

    Either an object of the floor is on top of a stranger, or a true support is turned round: the
    desk is on the lamp. `triples` are true triples that state no "under".
    """
    usable = ~structure[encoded.instance_classes]
    on_floor = usable & (encoded.instance_stands == FLOOR)
    strange = _strangers(encoded) & usable
    for i in rng.permutation(np.flatnonzero(on_floor)) if rng.random() < _LIFTED_STATED else ():
        if len(anchors := np.flatnonzero(strange[i])):
            false = ON_TOP, int(i), int(rng.choice(anchors))
            return [*(t for t in triples if {*t[1:]} != {*false[1:]}), false], false
    supports = [t for t in triples if t[0] in SUPPORTS]
    if not supports:
        return None
    a, i, j = supports[int(rng.integers(len(supports)))]
    return [*(t for t in triples if {*t[1:]} != {i, j}), (a, j, i)], (a, j, i)


def _supports(encoded: EncodedScene) -> Bool[NDArray, "N N"]:
    """Return which instances are on-top of or inside which instances."""
    holds = encoded.instance_holds
    return np.any(holds[[a for a in SUPPORTS if a < len(holds)]], axis=0)


def _strangers(encoded: EncodedScene) -> Bool[NDArray, "N N"]:
    """Return the pairs of instances of two classes that never support each other in the scene.

    Things of one class are no strangers, because a cookie on a cookie is right.
    """
    classes, row = np.unique(encoded.instance_classes, return_inverse=True)
    related = np.eye(len(classes), dtype=np.bool_)
    i, j = np.nonzero(_supports(encoded))
    related[row[i], row[j]] = related[row[j], row[i]] = True
    return np.logical_not(related[row[:, None], row])


def moved_by_pose(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> tuple[Scene, int] | None:
    """Return a scene with poses and one object at a wrong place, and the index of this object.

    Objects on the moved object move with it. In two thirds of the cases, the object has a larger
    supporter: it moves onto a larger stranger, to the floor beside its supporter, or under it. In
    one third, an object on the floor moves onto a high stranger. None means no free place.
    """
    bare = posed_scene(encoded)
    boxes = _Boxes.of(encoded, structure)
    for pairs, place in _moves(boxes, rng):
        for i in rng.permutation(np.flatnonzero(pairs.any(1))).tolist():
            group = boxes.group(i)
            for j in rng.permutation(np.flatnonzero(pairs[i] & ~group)).tolist():
                if (centre := place(boxes, i, j, rng)) is not None:
                    return _shifted(bare, group, centre - boxes.centre[i]), i
    return None


def lifted_or_sunk(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> tuple[Scene, int] | None:
    """Return a scene with a box that floats or is sunk in, and the index of its object, or None."""
    boxes = _Boxes.of(encoded, structure)
    lifts, usable = np.full(len(boxes.yaw), rng.uniform(*_FLOAT)), boxes.usable
    if rng.random() < 1 / 2:
        lifts = -rng.uniform(*_SINK) * boxes.size[:, 2]
        usable = usable & (lifts <= -_LEAST_SINK) & (boxes.bottom <= boxes.floor + CONTACT)
    for i in rng.permutation(np.flatnonzero(usable)).tolist():
        group, lift = boxes.group(i), float(lifts[i])
        bottom = boxes.bottom[i] + lift
        tops = boxes.top[boxes.usable & ~group]
        if lift < 0 or (np.abs(tops - bottom) > _LEAST_SINK).all():
            return _shifted(posed_scene(encoded), group, np.array([0.0, 0.0, lift])), i
    return None


def _shifted(scene: Scene, group: Bool[NDArray, "N"], step: Float[NDArray, "3"]) -> Scene:
    """Return the scene with the objects of a group moved by a step in metres."""
    objects = tuple(
        replace(thing, position=_point(np.add(thing.position, step)))
        if moves and thing.position is not None
        else thing
        for thing, moves in zip(scene.objects, group.tolist(), strict=True)
    )
    return replace(scene, objects=objects)


@dataclass(frozen=True, eq=False)
class _Boxes:
    """The boxes of n instances."""

    centre: Float[NDArray, "n 3"]
    size: Float[NDArray, "n 3"]  # extents before the rotation by `yaw`
    yaw: Float[NDArray, "n"]
    bottom: Float[NDArray, "n"]  # height
    top: Float[NDArray, "n"]  # height
    area: Float[NDArray, "n"]  # of the footprint
    usable: Bool[NDArray, "n"]  # instances with position and size that are not structure
    floor: float  # lowest bottom of the usable instances
    supports: Bool[NDArray, "n n"]  # instance i stands on or in instance j
    strange: Bool[NDArray, "n n"]  # usable instances whose classes never support each other

    @classmethod
    def of(cls, encoded: EncodedScene, structure: ClassMask) -> _Boxes:
        """Read the boxes of a scene whose relations come from positions."""
        centre, size, yaw = _poses(encoded)
        bottom, top = centre[:, 2] - size[:, 2] / 2, centre[:, 2] + size[:, 2] / 2
        area = size[:, 0] * size[:, 1]
        usable = np.isfinite(centre).all(1) & np.isfinite(size).all(1)
        usable &= ~structure[encoded.instance_classes]
        floor = float(bottom[usable].min(initial=np.inf))
        # "The bin is under the desk" is stored as "the desk is on top of the bin".
        is_inverse = (bottom[:, None] < top - CONTACT) & (area[:, None] > area)
        supports = _supports(encoded) & ~is_inverse
        strange = _strangers(encoded) & usable[:, None] & usable
        return cls(centre, size, yaw, bottom, top, area, usable, floor, supports, strange)

    def group(self, i: int) -> Bool[NDArray, "n"]:
        """Return instance i and all instances that stand on it, directly or not."""
        group = np.arange(len(self.yaw)) == i
        while (carried := self.supports[:, group].any(1) & ~group).any():
            group |= carried
        return group

    def beside(self, j: int, share: Float[NDArray, "2"], margin: float) -> Float[NDArray, "2"]:
        """Return the point at a share of the extents of j plus a margin (m) from its centre."""
        x, y = share * (self.size[j, :2] + 2 * margin)
        cos, sin = np.cos(self.yaw[j]), np.sin(self.yaw[j])
        return np.array([cos * x - sin * y, sin * x + cos * y]) + self.centre[j, :2]

    def is_free(self, i: int, point: Float[NDArray, "2"], obstacles: Bool[NDArray, "n"]) -> bool:
        """Return whether the footprint of instance i at a point (x, y) touches no obstacle."""
        rows = np.flatnonzero(obstacles)
        count = len(rows), 1
        mine = np.tile(point, count), np.tile(self.size[i, :2], count)
        others = self.centre[rows, :2], self.size[rows, :2], self.yaw[rows]
        _, gap = overlap_and_gap(*mine, np.full(len(rows), self.yaw[i]), *others)
        return bool((gap > 0).all())


_Place = Callable[[_Boxes, int, int, Rng], NDArray[np.float64] | None]
"""Function of boxes, moved instance, other instance and generator. It returns the new centre."""


def _moves(boxes: _Boxes, rng: Rng) -> Iterator[tuple[Bool[NDArray, "n n"], _Place]]:
    """Yield the kinds of moves in random order: pairs (moved, other instance), and the place.

    A moved instance is lifted onto another one, put on the floor, or under its support.
    """
    usable, area, bottom, height = boxes.usable, boxes.area, boxes.bottom, boxes.size[:, 2]
    # In each mask, row i is the moved instance, and column j is the other one.
    smaller = usable[:, None] & usable & (area[:, None] < area)
    supported = boxes.supports & smaller
    fits = boxes.strange & (area[:, None] <= area)
    is_high = bottom >= boxes.floor + _LEAST_STEP
    is_deep = bottom[:, None] >= bottom + _LEAST_STEP
    kinds: list[tuple[Bool[NDArray, "n n"], _Place]] = [
        (fits & supported.any(1, keepdims=True), _onto),
        (supported & is_high[:, None], _to_floor),
        (supported & is_deep & (height[:, None] <= height), _under),
    ]
    kinds = [kinds[k] for k in rng.permutation(len(kinds)).tolist()]
    on_floor = (bottom <= boxes.floor + CONTACT) & ~boxes.supports.any(1)
    # The stranger is high and large enough to carry the object.
    carries = boxes.strange & (height >= _LEAST_STEP) & (_LEAST_AREA * area[:, None] <= area)
    lifted = carries & on_floor[:, None], _onto
    # Objects of the floor are lifted first with the probability `_LIFTED`, otherwise last.
    kinds.insert(0 if rng.random() < _LIFTED else len(kinds), lifted)
    yield from kinds


def _onto(boxes: _Boxes, i: int, j: int, rng: Rng) -> Float[NDArray, "3"] | None:
    """Return a centre of instance i on the top of instance j, clear of the objects on it."""
    bottom, height = boxes.top[j], boxes.size[i, 2]
    obstacles = (boxes.top > bottom) & (boxes.bottom < bottom + height)
    return _free_spot(boxes, i, j, obstacles, _CENTRAL, 0.0, bottom, rng)


def _to_floor(boxes: _Boxes, i: int, j: int, rng: Rng) -> Float[NDArray, "3"] | None:
    """Return a centre of instance i on the floor near instance j, clear of all objects."""
    margin = _REACH + float(np.hypot(*boxes.size[i, :2])) / 2
    return _free_spot(boxes, i, j, boxes.usable, 0.5, margin, boxes.floor, rng)


def _free_spot(
    boxes: _Boxes,
    i: int,
    j: int,
    obstacles: Bool[NDArray, "n"],
    reach: float,  # largest distance from the centre of j, as a share of its extents
    margin: float,  # metres by which j is enlarged on each side
    z: float,  # height of the bottom of i
    rng: Rng,
) -> Float[NDArray, "3"] | None:
    """Return a random centre of instance i near j, clear of the obstacles, or None."""
    obstacles = obstacles & boxes.usable & ~boxes.group(i)
    for _ in range(_ATTEMPTS):
        point = boxes.beside(j, rng.uniform(-reach, reach, 2), margin)
        if boxes.is_free(i, point, obstacles):
            return np.array([*point, z + boxes.size[i, 2] / 2])
    return None


def _under(boxes: _Boxes, i: int, j: int, rng: Rng) -> Float[NDArray, "3"]:  # noqa: ARG001
    """Return the centre of instance i with its bottom at the bottom of instance j."""
    return np.array([*boxes.centre[i, :2], boxes.bottom[j] + boxes.size[i, 2] / 2])
