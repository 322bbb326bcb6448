"""Poses to relations: the one rule set of training and serving.

Viewer axes: x away from the viewer, y to the left, z up; metres and radians. Boxes stand upright;
their footprint is the rectangle of the horizontal extents, turned by the yaw.

1. *on-top*(i, j): the footprints overlap by at least 30 % of the smaller one and the bottom of i is
   within 5 cm of the top of j.
2. *above*(i, j): the same overlap, the bottom of i more than 5 cm over the top of j.
3. Otherwise, for neighbours, the larger of the offsets |dx|, |dy| between the centres decides:
   *left* is larger y, *front* is nearer (smaller x). Offsets under 10 cm decide nothing.

Neighbours are boxes whose footprints are at most 1 m apart or, where a size is unknown, whose
centres are at most 1.5 m apart in the horizontal plane. What the rules leave open is settled here
so that no pair is contradictory: equal offsets count as sideways; of two thin boxes that would each
lie on the other, the one with the higher centre does, and neither if the centres are level.

Every relation of a pair of neighbours is observed, so a pair in a vertical relation is observed not
to be in a horizontal one. Vertical relations need both sizes, and stay unobserved without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.compiling import compiled
from app.scene.footprints import measure
from app.scene.relations import ABOVE, CANONICAL, FRONT, LEFT, ON_TOP

MIN_OVERLAP: Final = 0.30  # share of the smaller footprint
CONTACT: Final = 0.05  # m between bottom and top
NEIGHBOUR_GAP: Final = 1.0  # m between footprints
NEIGHBOUR_DISTANCE: Final = 1.5  # m between centres, sizes unknown
MIN_OFFSET: Final = 0.10  # m between centres

_NONE: Final = -1  # in place of a relation

Array = NDArray[np.float64]
Rows = Array | Sequence[Sequence[float]]


class Viewpoint(NamedTuple):
    """Where the viewer stands: x and y in metres, heading yaw in radians."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseRelations:
    """Relations of n instances.

    Attributes:
        holds: (A, n, n) bool; ``holds[a, i, j]``: instance i stands in relation a to instance j.
        observed: (A, n, n) bool, symmetric in i and j; ``holds`` implies ``observed``.
    """

    holds: NDArray[np.bool_]
    observed: NDArray[np.bool_]


def to_viewer_frame(
    positions: Rows, viewpoint: Viewpoint, yaws: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Positions (n, 3) and yaws (n,) as seen from ``viewpoint``; heights stay as they are.

    Without ``yaws`` the boxes are taken to stand along the axes of the given frame.

    Raises:
        ValueError: wrong shapes, or a viewpoint that is not finite.
    """
    points = _array("positions", positions, (len(positions), 3))
    turns = np.zeros(len(points)) if yaws is None else _array("yaws", yaws, (len(points),))
    if not all(map(math.isfinite, viewpoint)):
        raise ValueError(f"viewpoint must be finite, not {tuple(viewpoint)}")
    cos, sin = math.cos(viewpoint.yaw), math.sin(viewpoint.yaw)
    dx, dy = points[:, 0] - viewpoint.x, points[:, 1] - viewpoint.y
    turned = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, points[:, 2]], axis=1)
    return turned, turns - viewpoint.yaw


def derive_relations(
    positions: Rows,
    sizes: Rows,
    yaws: ArrayLike | None = None,
    *,
    horizontal: bool = True,
) -> PoseRelations:
    """The relations between n boxes by the rules of this module.

    Args:
        positions: (n, 3) centres in viewer axes; a row with NaN is a thing without a position, and
            nothing about it is observed.
        sizes: (n, 3) extents before the yaw; a row with NaN is a thing without a size.
        yaws: (n,) turn of each box about z; all zero by default.
        horizontal: False where the viewer is unknown: left and front stay unobserved.

    Raises:
        ValueError: wrong shapes, infinite values, or sizes that are not positive.
    """
    points = _array("positions", positions, (len(positions), 3))
    n = len(points)
    extents = _array("sizes", sizes, (n, 3))
    turns = np.zeros(n) if yaws is None else _array("yaws", yaws, (n,))
    if not _are_finite(points, extents, turns):
        raise ValueError("positions, sizes and yaws must not be infinite")
    if not _are_positive(extents):
        raise ValueError("sizes must be positive")
    holds = np.zeros((len(CANONICAL), n, n), dtype=np.bool_)
    observed = np.zeros_like(holds)
    _relate_all(points, extents, turns, horizontal, holds, observed)
    return PoseRelations(holds, observed)


@compiled
def _are_finite(points, extents, turns):
    """Or NaN, which only a yaw must not be."""
    for i in range(len(points)):
        for k in range(3):
            if math.isinf(points[i, k]) or math.isinf(extents[i, k]):
                return False
        if not math.isfinite(turns[i]):
            return False
    return True


@compiled
def _are_positive(extents):
    """Or NaN."""
    for i in range(len(extents)):
        for k in range(3):
            if extents[i, k] <= 0.0:
                return False
    return True


@compiled
def _relate_all(points, extents, turns, horizontal, holds, observed):
    n = len(points)
    located, sized, radius = np.empty(n, np.bool_), np.empty(n, np.bool_), np.empty(n)
    for i in range(n):
        located[i], sized[i] = _is_known(points[i]), _is_known(extents[i])
        radius[i] = math.hypot(extents[i, 0], extents[i, 1]) / 2
    for i in range(n):
        for j in range(i + 1, n):
            if not (located[i] and located[j]):
                continue
            distance = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            boxed, stacked = sized[i] and sized[j], False
            if not boxed:
                neighbours = distance <= NEIGHBOUR_DISTANCE
            # Rectangles are measured only where the circles around them come near enough.
            elif distance - radius[i] - radius[j] <= NEIGHBOUR_GAP:
                share, gap = measure(
                    points[i], extents[i], turns[i], points[j], extents[j], turns[j]
                )
                neighbours, stacked = gap <= NEIGHBOUR_GAP, share >= MIN_OVERLAP
            else:
                neighbours = False
            if neighbours:
                _relate(points, extents, i, j, boxed, stacked, horizontal, holds, observed)


@compiled
def _is_known(row):
    return not (math.isnan(row[0]) or math.isnan(row[1]) or math.isnan(row[2]))


@compiled
def _relate(points, extents, i, j, boxed, stacked, horizontal, holds, observed):
    """Enter the relations of two neighbours."""
    # Left and front come before on-top and above.
    first, last = LEFT if horizontal else ON_TOP, ABOVE if boxed else FRONT
    for relation in range(first, last + 1):
        observed[relation, i, j] = observed[relation, j, i] = True
    for subject, anchor in ((i, j), (j, i)):
        relation = _vertical(points, extents, subject, anchor) if stacked else _NONE
        if relation != _NONE:
            holds[relation, subject, anchor] = True
            return
    if not horizontal:
        return
    for subject, anchor in ((i, j), (j, i)):
        relation = _horizontal(points, subject, anchor)
        if relation != _NONE:
            holds[relation, subject, anchor] = True


@compiled
def _vertical(points, extents, i, j):
    """The relation of i to j, the footprint of which it overlaps."""
    lift = (points[i, 2] - extents[i, 2] / 2) - (points[j, 2] + extents[j, 2] / 2)
    if lift > CONTACT:
        return ABOVE
    if abs(lift) <= CONTACT and points[i, 2] > points[j, 2]:
        return ON_TOP
    return _NONE


@compiled
def _horizontal(points, i, j):
    """The relation of i to j, its neighbour."""
    nearer, aside = points[j, 0] - points[i, 0], points[i, 1] - points[j, 1]
    if abs(aside) >= abs(nearer):
        return LEFT if aside >= MIN_OFFSET else _NONE
    return FRONT if nearer >= MIN_OFFSET else _NONE


def _array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.asarray(values, dtype=np.float64, order="C")
    if array.size == 0 and 0 in shape:
        return array.reshape(shape)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, must be {shape}")
    return array
