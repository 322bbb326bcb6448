"""Overlap and gap of the footprints of two boxes, which are rectangles in the horizontal plane."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.compiling import compiled

Pair = tuple[float, float]

# Maximum deviation in radians from a multiple of 90 degrees at which two rectangles count as
# parallel. Parallel rectangles can share an edge, and clipping would count such an edge twice.
_PARALLEL: Final = 1e-6
_SHORTEST: Final = 1e-150  # replaces an edge length of 0, to avoid division by zero
_QUARTER: Final = math.pi / 2


def overlap_and_gap(
    centre_a: Float[NDArray, "P 2"],
    size_a: Float[NDArray, "P 2"],
    yaw_a: Float[NDArray, " P"],
    centre_b: Float[NDArray, "P 2"],
    size_b: Float[NDArray, "P 2"],
    yaw_b: Float[NDArray, " P"],
) -> tuple[Float[NDArray, " P"], Float[NDArray, " P"]]:
    """Return overlap (share of the smaller area) and gap (metres) of P pairs of rectangles."""
    columns = (centre_a, size_a, yaw_a, centre_b, size_b, yaw_b)
    rows = zip(*(np.asarray(column, np.float64, order="C") for column in columns), strict=True)
    overlap, gap = np.array([measure(*row) for row in rows]).reshape(-1, 2).T
    return overlap, gap


@compiled
def measure(
    centre_a: Float[NDArray, " 2"],
    size_a: Float[NDArray, " 2"],
    yaw_a: float,
    centre_b: Float[NDArray, " 2"],
    size_b: Float[NDArray, " 2"],
    yaw_b: float,
) -> tuple[float, float]:
    """Return overlap and gap of two rectangles, in metres and radians.

    The overlap is the area of the intersection divided by the smaller area. The gap is the distance
    between the rectangles, or 0 if they touch. Sizes are along the axes of the rectangle. Centres
    and sizes may have a third component, which the function ignores.
    """
    # In its own axes, rectangle b is |x| <= half_b[0], |y| <= half_b[1].
    dx, dy = centre_a[0] - centre_b[0], centre_a[1] - centre_b[1]
    cos, sin = math.cos(yaw_b), math.sin(yaw_b)
    offset = cos * dx + sin * dy, cos * dy - sin * dx
    half_a, half_b = (size_a[0] / 2, size_a[1] / 2), (size_b[0] / 2, size_b[1] / 2)
    yaw = yaw_a - yaw_b
    quarters = np.rint(yaw / _QUARTER)
    if abs(yaw - quarters * _QUARTER) < _PARALLEL:
        if quarters % 2:  # a rotation by 90 degrees exchanges the extents
            half_a = half_a[1], half_a[0]
        # Along each axis, the intervals of a and b have a gap, or overlap if the gap is negative.
        # The overlap is at most the shorter interval.
        gap_x = abs(offset[0]) - half_a[0] - half_b[0]
        gap_y = abs(offset[1]) - half_a[1] - half_b[1]
        overlap_x = max(min(-gap_x, 2 * min(half_a[0], half_b[0])), 0.0)
        overlap_y = max(min(-gap_y, 2 * min(half_a[1], half_b[1])), 0.0)
        area, gap = overlap_x * overlap_y, math.hypot(max(gap_x, 0.0), max(gap_y, 0.0))
    else:
        area, gap = _skew(offset, half_a, math.cos(yaw), math.sin(yaw), half_b)
    smaller = min(size_a[0] * size_a[1], size_b[0] * size_b[1])
    if smaller > 0.0:
        return area / smaller, gap
    # If a rectangle has an area of 0, the overlap is 1 for touching rectangles and 0 for others.
    return 1.0 if gap == 0.0 else 0.0, gap


@compiled
def _skew(offset: Pair, half_a: Pair, cos: float, sin: float, half_b: Pair) -> Pair:
    """Return the area of the intersection and the gap of two rectangles that are not parallel."""
    # In the axes of b, a has the centre `offset` and a yaw with these values of cos and sin.
    # Corners of a in the axes of b, and corners of b in the axes of a, counter-clockwise.
    corners_a, corners_b = np.empty((4, 2)), np.empty((4, 2))
    gap = math.inf
    for k in range(4):
        sign_x, sign_y = 1.0 if k in (0, 3) else -1.0, 1.0 if k < 2 else -1.0
        x, y = sign_x * half_a[0], sign_y * half_a[1]
        corners_a[k, 0] = offset[0] + (cos * x - sin * y)
        corners_a[k, 1] = offset[1] + (sin * x + cos * y)
        x, y = sign_x * half_b[0] - offset[0], sign_y * half_b[1] - offset[1]
        corners_b[k, 0], corners_b[k, 1] = cos * x + sin * y, cos * y - sin * x
        # The shortest line between two separate convex polygons has an end at a corner.
        for corner, half in ((corners_a[k], half_b), (corners_b[k], half_a)):
            out_x, out_y = abs(corner[0]) - half[0], abs(corner[1]) - half[1]
            gap = min(gap, math.hypot(max(out_x, 0.0), max(out_y, 0.0)))
    # By Green's theorem, the area follows from the border of the intersection. The border consists
    # of the parts of edges of a inside b, and of edges of b inside a. A part from p to q adds
    # cross(p, q) / 2 to the area, with the centre of b as origin.
    swept_a, swept_b = 0.0, 0.0
    for k in range(4):
        p_x, p_y, q_x, q_y = _clipped(corners_a[k], corners_a[(k + 1) % 4], half_b)
        swept_a += p_x * q_y - p_y * q_x
        p_x, p_y, q_x, q_y = _clipped(corners_b[k], corners_b[(k + 1) % 4], half_a)
        p_x, p_y = offset[0] + (cos * p_x - sin * p_y), offset[1] + (sin * p_x + cos * p_y)
        q_x, q_y = offset[0] + (cos * q_x - sin * q_y), offset[1] + (sin * q_x + cos * q_y)
        swept_b += p_x * q_y - p_y * q_x
    area = max(swept_a / 2 + swept_b / 2, 0.0)
    return area, 0.0 if area > 0.0 else gap


@compiled
def _clipped(
    start: Float[NDArray, " 2"], end: Float[NDArray, " 2"], half: Pair
) -> tuple[float, float, float, float]:
    """Clip an edge to a rectangle around the origin (Liang & Barsky 1984); outside, to a point."""
    # Edges are never parallel to the axes of the rectangle. So x or y is 0 only if rounding has
    # reduced the edge to a point. Such an edge adds no area.
    x, y = end[0] - start[0] or _SHORTEST, end[1] - start[1] or _SHORTEST
    # A point of the edge is start + t (x, y). The sides of the rectangle have these values of t.
    low_x, high_x = (-half[0] - start[0]) / x, (half[0] - start[0]) / x
    low_y, high_y = (-half[1] - start[1]) / y, (half[1] - start[1]) / y
    enter = max(min(low_x, high_x), min(low_y, high_y), 0.0)
    leave = min(max(low_x, high_x), max(low_y, high_y), 1.0)
    leave = max(enter, leave)
    return start[0] + enter * x, start[1] + enter * y, start[0] + leave * x, start[1] + leave * y
