"""Overlap and gap of the footprints of two boxes, which are rectangles in the horizontal plane."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled

Array = NDArray[np.float64]

# Maximum deviation in radians from a multiple of 90 degrees at which two rectangles count as
# parallel. Parallel rectangles can share an edge, and clipping would count such an edge twice.
_PARALLEL: Final = 1e-6
# This length replaces an edge length of 0, to avoid division by zero.
_SHORTEST: Final = 1e-150
_QUARTER: Final = math.pi / 2


def overlap_and_gap(
    centre_a: Array, size_a: Array, yaw_a: Array, centre_b: Array, size_b: Array, yaw_b: Array
) -> tuple[Array, Array]:
    """Compute overlap and gap of P pairs of rectangles a and b, the footprints of boxes.

    Centres (P, 2) and sizes (P, 2) along the rectangle's own axes are in metres, yaws (P,) in
    radians.

    Returns:
        Overlap of each pair, (P,): area of the intersection divided by the smaller area.
        Gap of each pair, (P,): distance between the rectangles in metres, or 0 if they touch.
    """
    share, gap = np.empty(len(yaw_a)), np.empty(len(yaw_a))
    rectangles = (centre_a, size_a, yaw_a, centre_b, size_b, yaw_b)
    _measure_pairs(*(np.asarray(part, np.float64, order="C") for part in rectangles), share, gap)
    return share, gap


@compiled
def _measure_pairs(centre_a, size_a, yaw_a, centre_b, size_b, yaw_b, share, gap):
    """Write overlap and gap of P pairs of rectangles to share (P,) and gap (P,)."""
    for p in range(len(share)):
        share[p], gap[p] = measure(
            centre_a[p], size_a[p], yaw_a[p], centre_b[p], size_b[p], yaw_b[p]
        )


@compiled
def measure(centre_a, size_a, yaw_a, centre_b, size_b, yaw_b):
    """Compute overlap and gap of one pair of rectangles; see `overlap_and_gap`.

    Centres and sizes may have a third component, which the function ignores.
    """
    # In its own axes, rectangle b is |x| <= half_b[0], |y| <= half_b[1].
    offset = _turn_back(
        (centre_a[0] - centre_b[0], centre_a[1] - centre_b[1]), math.cos(yaw_b), math.sin(yaw_b)
    )
    yaw = yaw_a - yaw_b
    half_a, half_b = (size_a[0] / 2, size_a[1] / 2), (size_b[0] / 2, size_b[1] / 2)
    quarters = np.rint(yaw / _QUARTER)
    if not abs(yaw - quarters * _QUARTER) < _PARALLEL:
        area, gap = _skew(offset, half_a, math.cos(yaw), math.sin(yaw), half_b)
    elif quarters / 2 != np.rint(quarters / 2):
        # A rotation by 90 degrees exchanges the extents.
        area, gap = _parallel(offset, (half_a[1], half_a[0]), half_b)
    else:
        area, gap = _parallel(offset, half_a, half_b)
    smaller = min(size_a[0] * size_a[1], size_b[0] * size_b[1])
    if smaller > 0.0:
        return area / smaller, gap
    # If a rectangle has an area of 0, the overlap is 1 for touching rectangles and 0 for others.
    return 1.0 if gap == 0.0 else 0.0, gap


@compiled
def _parallel(offset, half_a, half_b):
    """Compute the area of the intersection and the gap of two parallel rectangles.

    Along each axis, the intervals of a and b have a gap, or overlap if the gap is negative. The
    overlap is at most the shorter interval.
    """
    gap_x = abs(offset[0]) - half_a[0] - half_b[0]
    gap_y = abs(offset[1]) - half_a[1] - half_b[1]
    overlap_x = max(min(-gap_x, 2 * min(half_a[0], half_b[0])), 0.0)
    overlap_y = max(min(-gap_y, 2 * min(half_a[1], half_b[1])), 0.0)
    return overlap_x * overlap_y, math.hypot(max(gap_x, 0.0), max(gap_y, 0.0))


@compiled
def _skew(offset, half_a, cos, sin, half_b):
    """Compute the area of the intersection and the gap of two rectangles that are not parallel."""
    # By Green's theorem, the area follows from the border of the intersection. The border consists
    # of the parts of edges of a inside b, and of edges of b inside a. A part from p to q adds
    # cross(p, q) / 2 to the area, with the centre of b as origin.
    swept_a, swept_b, gap = 0.0, 0.0, math.inf
    for k in range(4):
        start, end = _corner(half_a, k), _corner(half_a, k + 1)
        start = _moved(_turn(start, cos, sin), offset)
        end = _moved(_turn(end, cos, sin), offset)
        p, q = _clipped(start, end, half_b)
        swept_a += p[0] * q[1] - p[1] * q[0]
        # The shortest line between two separate convex polygons has an end at a corner.
        gap = min(gap, _distance(start, half_b))
    back = (-offset[0], -offset[1])
    for k in range(4):
        start, end = _corner(half_b, k), _corner(half_b, k + 1)
        # Convert the corners of b to the axes of a.
        start = _turn_back(_moved(start, back), cos, sin)
        end = _turn_back(_moved(end, back), cos, sin)
        p, q = _clipped(start, end, half_a)
        p = _moved(_turn(p, cos, sin), offset)
        q = _moved(_turn(q, cos, sin), offset)
        swept_b += p[0] * q[1] - p[1] * q[0]
        gap = min(gap, _distance(start, half_a))
    area = max(swept_a / 2 + swept_b / 2, 0.0)
    return area, 0.0 if area > 0.0 else gap


@compiled
def _corner(half, k):
    """Return corner k of a rectangle around the origin, counting counter-clockwise."""
    k = k % 4
    return (half[0] if k in (0, 3) else -half[0], half[1] if k < 2 else -half[1])


@compiled
def _moved(point, offset):
    return offset[0] + point[0], offset[1] + point[1]


@compiled
def _turn(point, cos, sin):
    return cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]


@compiled
def _turn_back(point, cos, sin):
    return cos * point[0] + sin * point[1], cos * point[1] - sin * point[0]


@compiled
def _clipped(start, end, half):
    """Clip an edge to a rectangle around the origin (Liang & Barsky 1984).

    The function returns both ends of the clipped edge. They are equal if the edge lies outside the
    rectangle.
    """
    # Edges are never parallel to the axes of the rectangle. So x or y is 0 only if rounding has
    # reduced the edge to a point. Such an edge adds no area.
    x, y = end[0] - start[0] or _SHORTEST, end[1] - start[1] or _SHORTEST
    # A point of the edge is start + t (x, y). The sides of the rectangle have these values of t.
    low_x, high_x = (-half[0] - start[0]) / x, (half[0] - start[0]) / x
    low_y, high_y = (-half[1] - start[1]) / y, (half[1] - start[1]) / y
    enter = max(min(low_x, high_x), min(low_y, high_y), 0.0)
    leave = min(max(low_x, high_x), max(low_y, high_y), 1.0)
    leave = max(enter, leave)
    return (
        (start[0] + enter * x, start[1] + enter * y),
        (start[0] + leave * x, start[1] + leave * y),
    )


@compiled
def _distance(point, half):
    """Return the distance from a point to a rectangle around the origin."""
    return math.hypot(max(abs(point[0]) - half[0], 0.0), max(abs(point[1]) - half[1], 0.0))
