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

from app.scene.footprints import overlap_and_gap
from app.scene.relations import ABOVE, CANONICAL, FRONT, LEFT, ON_TOP

MIN_OVERLAP: Final = 0.30  # share of the smaller footprint
CONTACT: Final = 0.05  # m between bottom and top
NEIGHBOUR_GAP: Final = 1.0  # m between footprints
NEIGHBOUR_DISTANCE: Final = 1.5  # m between centres, sizes unknown
MIN_OFFSET: Final = 0.10  # m between centres

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
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
        horizontal: False where nobody knows the viewer: left and front stay unobserved.

    Raises:
        ValueError: wrong shapes, infinite values, or sizes that are not positive.
    """
    points = _array("positions", positions, (len(positions), 3))
    n = len(points)
    extents = _array("sizes", sizes, (n, 3))
    turns = np.zeros(n) if yaws is None else _array("yaws", yaws, (n,))
    if np.isinf(points).any() or np.isinf(extents).any() or not np.isfinite(turns).all():
        raise ValueError("positions, sizes and yaws must not be infinite")
    if (extents <= 0).any():
        raise ValueError("sizes must be positive")

    located = np.asarray(np.isfinite(points).all(axis=1))
    first, second = np.triu_indices(n, 1)
    keep = located[first] & located[second]
    first, second = first[keep], second[keep]
    sized = np.asarray(np.isfinite(extents).all(axis=1))
    boxed = sized[first] & sized[second]
    neighbours, stacked = _footprints(points, extents, turns, first, second, boxed)

    holds = np.zeros((len(CANONICAL), n, n), dtype=np.bool_)
    observed = np.zeros_like(holds)
    vertical = _vertical(holds, points, extents, first[stacked], second[stacked])
    for relation in (ON_TOP, ABOVE):
        _mark(observed[relation], first[neighbours & boxed], second[neighbours & boxed])
    if horizontal:
        level = neighbours.copy()
        level[np.flatnonzero(stacked)[vertical]] = False
        _horizontal(holds, points, first[level], second[level])
        for relation in (LEFT, FRONT):
            _mark(observed[relation], first[neighbours], second[neighbours])
    return PoseRelations(holds, observed)


def _footprints(
    points: Array, extents: Array, turns: Array, first: Index, second: Index, boxed: Mask
) -> tuple[Mask, Mask]:
    """(P,) which pairs are neighbours, and which of them stand over one another."""
    distance = np.hypot(*(points[first, :2] - points[second, :2]).T)
    neighbours = ~boxed & (distance <= NEIGHBOUR_DISTANCE)
    stacked = np.zeros_like(neighbours)
    # Rectangles are measured only where the circles around them come near enough.
    radius = np.hypot(extents[:, 0], extents[:, 1]) / 2
    near = boxed & (distance - radius[first] - radius[second] <= NEIGHBOUR_GAP)
    i, j = first[near], second[near]
    share, gap = overlap_and_gap(
        points[i, :2], extents[i, :2], turns[i], points[j, :2], extents[j, :2], turns[j]
    )
    neighbours[near] = gap <= NEIGHBOUR_GAP
    stacked[near] = share >= MIN_OVERLAP
    return neighbours, stacked


def _vertical(
    holds: NDArray[np.bool_], points: Array, extents: Array, first: Index, second: Index
) -> Mask:
    """Enter on-top and above of pairs that stand over one another; True where one holds."""
    bottom, top = points[:, 2] - extents[:, 2] / 2, points[:, 2] + extents[:, 2] / 2
    decided = np.zeros(len(first), dtype=np.bool_)
    for i, j in ((first, second), (second, first)):
        lift = bottom[i] - top[j]
        on = (np.abs(lift) <= CONTACT) & (points[i, 2] > points[j, 2])
        over = lift > CONTACT
        holds[ON_TOP, i, j] = on
        holds[ABOVE, i, j] = over
        decided |= on | over
    return decided


def _horizontal(holds: NDArray[np.bool_], points: Array, first: Index, second: Index) -> None:
    """Enter left and front of neighbours."""
    dx, dy, _ = (points[first] - points[second]).T
    sideways = np.abs(dy) >= np.abs(dx)
    for relation, lead, decisive in ((LEFT, dy, sideways), (FRONT, -dx, ~sideways)):
        decides = decisive & (np.abs(lead) >= MIN_OFFSET)
        holds[relation, first, second] = decides & (lead > 0)
        holds[relation, second, first] = decides & (lead < 0)


def _mark(table: NDArray[np.bool_], first: Index, second: Index) -> None:
    table[first, second] = True
    table[second, first] = True


def _array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 and 0 in shape:
        return array.reshape(shape)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, must be {shape}")
    return array
