"""A scene as observed by one viewer: objects, and their relations, derived from poses by rules.

Scenes contain instances (objects), but models only know classes: `app.questions.posterior` pools
the instances of a class. `observe` derives the relations of a scene from the poses of its objects.
Training and serving use the same rules.

Viewer axes point away from the viewer (x), to the left (y) and up (z). Units are metres and
radians. Boxes are upright. The footprint of a box is the rectangle of its horizontal extents,
rotated by the yaw.

Positions and sizes have errors, so each relation has a probability. A relation holds if its
probability is at least .5. s is the standard deviation of the vertical distance of two faces, and
at least `SMALLEST_STD`. The lift of a box over a lower box is its bottom minus the top of the lower
box. Rules 1 to 3 apply to two boxes whose footprints overlap by at least 30 % of the smaller one:

1. The upper box, with the higher centre, touches the lower box, is above it, or reaches into it.
   The three cases have the weights `TOUCH` · N(lift; 0, s), Φ(lift / s) and Φ(-lift / s). So two
   boxes without errors touch if the lift is at most 5 cm. A box that surrounds a smaller box does
   not touch it. A box surrounds a smaller box if it is more than 10 cm high, and if it reaches both
   lower and higher than the smaller box. Boxes with centres at one height reach into each other.
2. If the upper box touches the lower box, *on-top* holds if the lower box carries the upper box.
   Otherwise *above* holds. A box carries every box with a smaller footprint, and each larger box
   whose centre is over it.
3. The roles of two boxes that reach into each other depend on the smaller box, the box with the
   smaller footprint. If the footprints differ by at most 1 %, it is the box with the smaller
   volume. The smaller box has one of three roles:

   - on the larger box: *on-top*(smaller, larger). The bottom of the smaller box must be at least
     20 % of the larger height above the bottom of the larger box.
   - under the larger box: *above*(larger, smaller). The bottom of the smaller box must be at
     most 10 cm, or at most 20 % of the larger height, above the bottom of the larger box.
   - in the larger box: *inside*(smaller, larger). The smaller box must have at most 1.2 times the
     larger height.

   The counts of `app.scene.roles` choose one of the possible roles, or leave the role undecided.
   Without counts, without classes, or if the volumes also differ by at most 1 %, the role is
   undecided.
4. If no stacked relation holds between two neighbours, their centres decide. dx and dy are the
   differences of the centres. If |dy| is at least |dx|, the box with the larger y is *left* of the
   other box. If |dx| is larger, the box with the smaller x, nearer to the viewer, is in *front* of
   the other box. If both |dx| and |dy| are under 10 cm, neither relation holds. The probability is
   that of the less certain of both conditions, if no stacked relation holds.
5. Two boxes are neighbours if their footprints are at most 1 m apart. If the size of a box is
   unknown, the centres must be at most 1.5 m apart in the horizontal plane.
6. All relations between two neighbours are observed, whether they hold or not. So if a stacked
   relation (on-top, above, inside) holds, left and front are observed not to hold.
7. If a role is undecided, the relations of the possible roles are unobserved. All other relations
   of the two boxes are observed not to hold. For two boxes of the same size, *on-top* and *inside*
   are unobserved in both directions.
8. Boxes that are further apart than neighbours exclude stacked relations: on-top, above and inside
   are observed not to hold. Left and front are unobserved.
9. If the size of a box is unknown, its stacked relations are unobserved. A box without height or
   depth is thin, and its size is known.

`excluded_by_centres` excludes further relations at every distance: those with a direction that rule
4 does not allow, and stacked relations of boxes too far apart to overlap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy.typing import ArrayLike, NDArray

from app.compiling import compiled, inlined
from app.scene.footprints import measure
from app.scene.relation_table import EXCLUDED, RelationTable, Triple
from app.scene.roles import IN, ON, SAME, UNDER, RoleCounts, is_smaller, likely_role, possible_roles
from app.scene.spatial_relations import (
    ABOVE,
    CANONICAL,
    FRONT,
    HOLDS,
    INSIDE,
    LEFT,
    ON_TOP,
    POSSIBLE,
)

MIN_OVERLAP: Final = 0.30  # minimum overlap as a share of the smaller footprint
CONTACT: Final = 0.05  # maximum lift in metres at which two boxes without errors touch
SMALLEST_STD: Final = 0.02  # minimum standard deviation in metres of a lift
POSITION_STD: Final = 0.05  # standard deviation in metres of a position without a stated one
SIZE_STD: Final = 0.1  # standard deviation of a stated size without its own, as a share of it
SPREAD: Final = 0.35  # standard deviation of the log of the sizes of a class without its own
NEIGHBOUR_GAP: Final = 1.0  # maximum distance in metres between the footprints of neighbours
NEIGHBOUR_DISTANCE: Final = 1.5  # maximum distance in metres between centres if a size is unknown
MIN_OFFSET: Final = 0.10  # minimum |dx| or |dy| in metres for *front* or *left*
UNKNOWN_REACH: Final = 1.5  # maximum reach in metres of a footprint of unknown size
MOST_DISTANT: Final = 100.0  # longest plausible distance from the viewer in metres; detects mm
SMALLEST: Final = 1e-3  # shortest plausible longest side of a box in metres
LARGEST: Final = 20.0  # longest plausible side of a box in metres

_SQRT_2: Final = math.sqrt(2.0)
_SQRT_2_PI: Final = math.sqrt(2.0 * math.pi)
TOUCH: Final = SMALLEST_STD * _SQRT_2_PI * math.exp(0.5 * (CONTACT / SMALLEST_STD) ** 2)
"""Weight of touching in metres: without errors, it equals that of a gap at a lift of `CONTACT`."""

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
    position_std: float | None = None  # standard deviation of each coordinate
    size_std: float | None = None  # standard deviation of each extent


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


# ------------------------------------------------------------------------- relations from poses

_UNKNOWN = (math.nan, math.nan, math.nan)


def observe(
    scene: Scene,
    *,
    viewpoint: Viewpoint | None = None,  # None: at the origin, looking along x
    has_viewer: bool = True,  # False: left and front are undefined
    typical_sizes: Float[NDArray[np.float64], "V 3"] | None = None,  # `Vocabulary.sizes`
    spread: Float[NDArray[np.floating], "V"] | None = None,  # of log sizes; None: `SPREAD`
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
    indices = [-1 if thing.class_index is None else thing.class_index for thing in objects]
    classes = np.array(indices)
    if stand_in is not None:
        classes = np.where(classes >= 0, stand_in[classes], classes)
    poses = derive_relations(
        points,
        sizes,
        [thing.yaw for thing in objects],
        errors=errors_of(objects, sizes, classes, spread),
        horizontal=has_viewer,
        classes=classes,
        roles=roles,
    )
    far = excluded_by_centres(points, sizes, horizontal=has_viewer)
    if scene.relations is not None:
        excluded = far | (poses.observed & (poses.probability < POSSIBLE))
        table = scene.relations.excluding(excluded, EXCLUDED)
        return replace(scene, objects=objects, relations=table)
    table = RelationTable.shown_by_boxes(poses.probability, poses.observed, far)
    return replace(scene, objects=objects, relations=table)


def _in_viewer_frame(
    objects: tuple[SceneObject, ...], viewpoint: Viewpoint
) -> tuple[SceneObject, ...]:
    """Return the objects with their poses in the axes of the viewer."""
    centres = [thing.position or _UNKNOWN for thing in objects]
    positions, yaws = to_viewer_frame(centres, viewpoint, [thing.yaw for thing in objects])
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


def errors_of(
    objects: Sequence[SceneObject],
    extents: Float[NDArray[np.float64], "n 3"],  # stated, or typical
    classes: Int[NDArray[np.int64], " n"],  # -1 where unknown
    spread: Float[NDArray[np.floating], "V"] | None,  # standard deviations of log sizes
) -> Float[NDArray[np.float64], "n 2"]:
    """Return standard deviations in metres: of the centres, and of the faces at bottom and top.

    The error of a face is that of the centre and of half of the height. Without stated values, a
    position has `POSITION_STD`, a stated size `SIZE_STD`, and a typical size that of its class.
    """
    errors = np.empty((len(objects), 2))
    columns = objects, classes.tolist(), extents[:, 2].tolist()
    for row, (thing, index, height) in enumerate(zip(*columns, strict=True)):
        centre, of_height = thing.position_std, thing.size_std
        if centre is None:
            centre = POSITION_STD
        if of_height is None:
            is_described = spread is not None and index >= 0
            share = float(spread[index]) if is_described else SPREAD  # type: ignore[index]
            of_height = height * (share if thing.size is None else SIZE_STD)
        errors[row] = centre, math.hypot(centre, of_height / 2)
    return errors


Rows = Float[NDArray, "n 3"] | Sequence[Sequence[float]]


class Viewpoint(NamedTuple):
    """Position and heading of the viewer: x and y in metres, yaw in radians."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseRelations:
    """Relations a(i, j) between n objects, derived from poses, at [a, i, j]."""

    probability: Float32[NDArray, "A n n"]
    # Whether it was observed if a relation holds. Symmetric in i and j, except for undecided roles.
    observed: Bool[NDArray, "A n n"]

    @property
    def holds(self) -> Bool[NDArray, "A n n"]:
        """The relations with a probability of at least `HOLDS`."""
        return self.probability >= HOLDS


def to_viewer_frame(
    positions: Rows, viewpoint: Viewpoint, yaws: ArrayLike | None = None
) -> tuple[Float[NDArray, "n 3"], Float[NDArray, " n"]]:
    """Convert positions (metres) and yaws (radians, 0 by default) of n boxes to viewer axes.

    Heights do not change.

    Raises:
        ValueError: a shape is wrong.
    """
    points = np.asarray(positions, np.float64).reshape(len(positions), 3)
    turns = np.zeros(len(points)) if yaws is None else np.asarray(yaws, np.float64)
    turns = turns.reshape(len(points))
    cos, sin = math.cos(viewpoint.yaw), math.sin(viewpoint.yaw)
    dx, dy = points[:, 0] - viewpoint.x, points[:, 1] - viewpoint.y
    turned = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, points[:, 2]], axis=1)
    return turned, turns - viewpoint.yaw


def derive_relations(
    positions: Rows,  # centres in viewer axes, in metres; a row with NaN where unknown
    sizes: Rows,  # extents before the rotation, in metres; 0 for flat boxes, NaN where unknown
    yaws: ArrayLike | None = None,  # rotations about z in radians; all 0 by default
    *,
    errors: Float[NDArray, "n 2"] | None = None,  # see `errors_of`; all 0 by default
    horizontal: bool = True,  # whether the viewer is known; if not, left and front are unobserved
    classes: Int[NDArray, " n"] | None = None,  # -1 where unknown
    roles: RoleCounts | None = None,  # for rule 3; None leaves all roles undecided
) -> PoseRelations:
    """Derive the relations between n boxes by the rules of this module.

    Raises:
        ValueError: a shape is wrong, a value is infinite, a size is negative, or the counts lack a
            class.
    """
    n = len(positions)
    points, extents = (
        np.asarray(rows, np.float64, order="C").reshape(n, 3) for rows in (positions, sizes)
    )
    turns = np.zeros(n) if yaws is None else np.asarray(yaws, np.float64, order="C").reshape(n)
    deviations = np.zeros((n, 2)) if errors is None else errors.reshape(n, 2)
    if np.isinf(points).any() or np.isinf(extents).any() or not np.isfinite(turns).all():
        raise ValueError("positions, sizes and yaws must not be infinite, and yaws must not be NaN")
    if np.any(extents < 0):
        raise ValueError("sizes must not be negative")
    if classes is None or roles is None:
        classes, roles = np.full(n, -1), _NO_ROLES
    elif classes.shape != (n,) or classes.max(initial=-1) >= len(roles.anchor):
        raise ValueError(f"classes must be {n} indices below {len(roles.anchor)}")
    probability = np.zeros((len(CANONICAL), n, n), np.float32)
    observed = np.zeros(probability.shape, np.bool_)
    boxes = points, extents, turns, deviations
    _relate_all(boxes, horizontal, classes, roles, probability, observed)
    return PoseRelations(probability, observed)


_NO_ROLES: Final = RoleCounts(
    np.empty(0, np.int64), np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
)


def excluded_by_centres(
    points: Float[NDArray, "n 3"], sizes: Float[NDArray, "n 3"], *, horizontal: bool
) -> Bool[NDArray, "A n n"]:
    """Return the relations that the centres exclude. Unknown footprints reach `UNKNOWN_REACH`."""
    x, y = points[:, 0], points[:, 1]
    dx, dy = x[:, None] - x, y[:, None] - y
    excluded = np.zeros((len(CANONICAL), len(x), len(x)), np.bool_)
    # A comparison with NaN is False.
    if horizontal:
        size_x, size_y = np.abs(dx), np.abs(dy)
        excluded[LEFT] = (dy < MIN_OFFSET) | (size_y < size_x)
        excluded[FRONT] = (dx > -MIN_OFFSET) | (size_x <= size_y)
    radius = np.hypot(sizes[:, 0], sizes[:, 1]) / 2
    radius[np.isnan(radius)] = UNKNOWN_REACH
    excluded[ON_TOP:] = np.hypot(dx, dy) > radius[:, None] + radius  # the stacked relations
    return excluded


Boxes = tuple[
    Float[NDArray, "n 3"], Float[NDArray, "n 3"], Float[NDArray, " n"], Float[NDArray, "n 2"]
]  # fmt: skip
"""Centres, extents, yaws, and standard deviations (`errors_of`) of n boxes."""


@compiled
def _relate_all(
    boxes: Boxes,
    horizontal: bool,
    classes: Int[NDArray, " n"],
    roles: RoleCounts,
    probability: Float32[NDArray, "A n n"],
    observed: Bool[NDArray, "A n n"],
) -> None:
    """Write the relations of all pairs of boxes. Left and front need `horizontal`, a viewer."""
    points, extents, turns, errors = boxes
    n = len(points)
    has_position, has_size = np.empty(n, np.bool_), np.empty(n, np.bool_)
    radius = np.empty(n)
    for i in range(n):
        radius[i] = math.hypot(extents[i, 0], extents[i, 1]) / 2
        has_size[i] = not math.isnan(radius[i] + extents[i, 2])
        has_position[i] = not math.isnan(points[i, 0] + points[i, 1] + points[i, 2])
    for i in range(n):
        for j in range(i + 1, n):
            if not (has_position[i] and has_position[j]):
                continue
            distance = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            have_sizes, stacked = has_size[i] and has_size[j], 0.0
            if not have_sizes:
                neighbours, share = distance <= NEIGHBOUR_DISTANCE, 0.0
            # The distance between the circles around the footprints is a fast first check, because
            # `measure` is slower.
            elif distance - radius[i] - radius[j] <= NEIGHBOUR_GAP:
                share, gap = measure(
                    points[i], extents[i], turns[i], points[j], extents[j], turns[j]
                )
                neighbours = gap <= NEIGHBOUR_GAP
            else:
                neighbours, share = False, 0.0
            # The order of relation indices is left, front, on-top, above, inside.
            first = LEFT if neighbours and horizontal else ON_TOP
            last = INSIDE if have_sizes else FRONT
            for relation in range(first, last + 1):
                observed[relation, i, j] = observed[relation, j, i] = True
            error = math.hypot(errors[i, 0], errors[j, 0])
            if share > 0.0:
                overlap = overlap_probability(boxes, i, j, share)
                if overlap >= POSSIBLE:
                    stacked = _stack(boxes, i, j, overlap, classes, roles, probability, observed)
            if neighbours and horizontal and stacked < HOLDS:
                for subject, anchor in ((i, j), (j, i)):
                    to_front = points[anchor, 0] - points[subject, 0]
                    to_left = points[subject, 1] - points[anchor, 1]
                    relation, offset = FRONT, to_front
                    if abs(to_left) >= abs(to_front):
                        relation, offset = LEFT, to_left
                    if offset > 0:
                        is_offset = normal_share(offset - MIN_OFFSET, error)
                        margin = abs(abs(to_left) - abs(to_front)) / math.sqrt(2.0)
                        p = min(is_offset, normal_share(margin, error))
                        probability[relation, subject, anchor] = (1.0 - stacked) * p


@inlined
def normal_share(margin, error):
    """Return the probability that a margin with a normal error (standard deviation) is not < 0."""
    if error <= 0.0:
        return 1.0 if margin >= 0.0 else 0.0
    return 0.5 + 0.5 * math.erf(margin / (error * _SQRT_2))


@compiled
def overlap_probability(boxes: Boxes, i: int, j: int, share: float) -> float:
    """Return the probability that the footprints of two boxes overlap by `MIN_OVERLAP`.

    ``share`` is the overlap as a share of the smaller footprint. The margin is the shift by which
    the overlap would become `MIN_OVERLAP`: also the way to the border, for a footprint within the
    other one.
    """
    _, extents, turns, errors = boxes
    smaller, larger = i, j
    if extents[i, 0] * extents[i, 1] > extents[j, 0] * extents[j, 1]:
        smaller, larger = j, i
    margin = (share - MIN_OVERLAP) * math.sqrt(extents[smaller, 0] * extents[smaller, 1])
    across, along = _offset(boxes, smaller, larger)
    turn = turns[smaller] - turns[larger]
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    half_across = (cos * extents[smaller, 0] + sin * extents[smaller, 1]) / 2
    half_along = (sin * extents[smaller, 0] + cos * extents[smaller, 1]) / 2
    inner = min(
        extents[larger, 0] / 2 - across - half_across, extents[larger, 1] / 2 - along - half_along
    )
    return normal_share(margin + max(inner, 0.0), math.hypot(errors[i, 0], errors[j, 0]))


@compiled
def _offset(boxes: Boxes, i: int, j: int) -> tuple[float, float]:
    """Return the distances of two centres along the two horizontal axes of box j."""
    points, _, turns, _ = boxes
    dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
    cos, sin = math.cos(turns[j]), math.sin(turns[j])
    return abs(cos * dx + sin * dy), abs(cos * dy - sin * dx)


@compiled
def contact_weights(lift: float, error: float) -> tuple[float, float, float]:
    """Return the weights of rule 1 for a lift in metres: touching, above, and reaching into."""
    s = max(error, SMALLEST_STD)
    touch = TOUCH * math.exp(-0.5 * (lift / s) ** 2) / (s * _SQRT_2_PI)
    above = 0.5 + 0.5 * math.erf(lift / (s * _SQRT_2))
    return touch, above, 1.0 - above


@compiled
def _carries(boxes: Boxes, subject: int, anchor: int) -> bool:
    """Return whether the anchor carries a box on it: a smaller one, or one centred over it."""
    _, extents, _, errors = boxes
    area = extents[anchor, 0] * extents[anchor, 1]
    if extents[subject, 0] * extents[subject, 1] <= area * (1.0 + SAME):
        return True
    margin = math.hypot(errors[subject, 0], errors[anchor, 0])
    across, along = _offset(boxes, subject, anchor)
    return across <= extents[anchor, 0] / 2 + margin and along <= extents[anchor, 1] / 2 + margin


@compiled
def _stack(
    boxes: Boxes,
    i: int,
    j: int,
    overlap: float,  # probability that the footprints overlap
    classes: Int[NDArray, " n"],
    roles: RoleCounts,
    probability: Float32[NDArray, "A n n"],
    observed: Bool[NDArray, "A n n"],
) -> float:
    """Apply rules 1 to 3 to two boxes. Return the probability that they are stacked."""
    points, extents, _, errors = boxes
    smaller, larger, is_nested = -1, -1, False
    for one, other in ((i, j), (j, i)):
        if is_smaller(extents[one], extents[other]):
            smaller, larger = one, other
    height, larger_height = extents[smaller, 2], extents[larger, 2]
    rise = points[smaller, 2] - height / 2 - (points[larger, 2] - larger_height / 2)
    if smaller >= 0:  # the larger box may surround the smaller box
        tops = points[smaller, 2] + height / 2, points[larger, 2] + larger_height / 2
        is_nested = rise > 0 and tops[1] > tops[0] and larger_height > 2 * CONTACT
    upper, lower = (i, j) if points[i, 2] > points[j, 2] else (j, i)
    lift = points[upper, 2] - extents[upper, 2] / 2 - (points[lower, 2] + extents[lower, 2] / 2)
    is_level = points[i, 2] == points[j, 2]
    if is_level and lift >= -CONTACT:
        return 0.0  # two thin boxes at the same height
    touch, above, deep = contact_weights(lift, math.hypot(errors[i, 1], errors[j, 1]))
    if is_level or (is_nested and upper == larger):
        touch, above, deep = 0.0, 0.0, 1.0
    total = (touch + above + deep) / overlap
    touch, above, deep = touch / total, above / total, deep / total
    if _carries(boxes, upper, lower):
        probability[ON_TOP, upper, lower] = touch
    else:
        above += touch
    probability[ABOVE, upper, lower] = above
    if smaller < 0:
        if deep >= HOLDS:
            for relation in (ON_TOP, INSIDE):
                observed[relation, i, j] = observed[relation, j, i] = False
        return overlap
    possible = possible_roles(rise, height, larger_height)
    role = likely_role(roles, classes[smaller], classes[larger], possible)
    if role == ON:
        probability[ON_TOP, smaller, larger] += deep
    elif role == UNDER:
        probability[ABOVE, larger, smaller] += deep
    elif role == IN:
        probability[INSIDE, smaller, larger] = deep
    elif deep >= HOLDS:  # the relations of the possible roles are unobserved
        observed[ON_TOP, smaller, larger] = not possible[ON]
        observed[ABOVE, larger, smaller] = not possible[UNDER]
        observed[INSIDE, smaller, larger] = not possible[IN]
    return overlap
