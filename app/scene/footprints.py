"""Overlap and gap of turned rectangles, for many pairs at once.

Exact up to rounding. Two rectangles turned by a multiple of 90 degrees against each other share
axes, and intervals answer; the others are cut along their edges.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Radians below which two rectangles count as parallel. Only parallel edges can coincide, so that
# cutting along edges, which would count a shared edge twice, never meets one.
_PARALLEL: Final = 1e-6
# In place of edges of no length, which nothing can be divided by.
_SHORTEST: Final = 1e-150
_SIGNS: Final = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def overlap_and_gap(
    centre_a: Array, size_a: Array, yaw_a: Array, centre_b: Array, size_b: Array, yaw_b: Array
) -> tuple[Array, Array]:
    """Overlap and gap of P pairs of rectangles a, b.

    Args:
        centre_a, centre_b: (P, 2).
        size_a, size_b: (P, 2) extents along the rectangles' own axes.
        yaw_a, yaw_b: (P,) turns in radians.

    Returns:
        (P,) area of the intersection as a share of the smaller area, and (P,) distance between the
        rectangles, 0 where they touch.
    """
    # In b's axes b is the box |x| <= half_b[0], |y| <= half_b[1] around the origin.
    offset = _turn(centre_a - centre_b, -yaw_b)
    yaw = yaw_a - yaw_b
    half_a, half_b = size_a / 2, size_b / 2
    quarters = np.round(yaw / (np.pi / 2))
    parallel = np.abs(yaw - quarters * (np.pi / 2)) < _PARALLEL
    # A quarter turn exchanges the extents.
    swapped = np.where((quarters % 2 == 1)[:, None], half_a[:, ::-1], half_a)
    area, gap = _parallel(offset, swapped, half_b)
    if not parallel.all():
        skew = np.flatnonzero(~parallel)
        area[skew], gap[skew] = _skew(offset[skew], half_a[skew], yaw[skew], half_b[skew])
    smaller = np.minimum(size_a.prod(axis=1), size_b.prod(axis=1))
    # An area too small for a float is a point's, and lies wholly in what it touches.
    share = np.divide(area, smaller, out=(gap == 0).astype(np.float64), where=smaller > 0)
    return share, gap


def _parallel(offset: Array, half_a: Array, half_b: Array) -> tuple[Array, Array]:
    apart = np.abs(offset) - half_a - half_b
    overlap = np.minimum(-apart, 2 * np.minimum(half_a, half_b))
    area = np.maximum(overlap, 0).prod(axis=1)
    return area, np.hypot(*np.maximum(apart, 0).T)


def _skew(offset: Array, half_a: Array, yaw: Array, half_b: Array) -> tuple[Array, Array]:
    """Area and gap by edges: each rectangle's corners in the axes of the other."""
    corners_a = offset[:, None] + _turn(_corners(half_a), yaw[:, None])
    # b's corners in a's axes.
    corners_b = _turn(_corners(half_b) - offset[:, None], -yaw[:, None])
    # Green's theorem: the border of the intersection is made of a's edges inside b and b's edges
    # inside a; each part adds cross(p, q) / 2, taken about one common origin, the centre of b.
    pieces_a = _inside(corners_a, half_b)
    pieces_b = _inside(corners_b, half_a)
    pieces_b = offset[:, None, None] + _turn(pieces_b, yaw[:, None, None])
    area = np.maximum(_swept(pieces_a) + _swept(pieces_b), 0)
    # Disjoint convex polygons are nearest at a corner of one of them.
    gap = np.minimum(_distance(corners_a, half_b), _distance(corners_b, half_a))
    return area, np.where(area > 0, 0.0, gap)


def _corners(half: Array) -> Array:
    """(P, 4, 2) corners of boxes around the origin, counter-clockwise."""
    corners: Array = half[:, None] * _SIGNS
    return corners


def _turn(points: Array, yaw: Array) -> Array:
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _inside(corners: Array, half: Array) -> Array:
    """(P, 4, 2, 2) the part of each edge inside the box (Liang & Barsky 1984); ends fall together
    where no part is."""
    start = corners
    along = np.roll(corners, -1, axis=1) - corners
    # The edges are skew to the box, so a component of `along` is zero only where all its length was
    # lost to rounding; such an edge bounds no area wherever it is cut.
    along = np.where(along == 0, _SHORTEST, along)
    one = (-half[:, None] - start) / along
    other = (half[:, None] - start) / along
    enter = np.maximum(np.minimum(one, other).max(axis=-1), 0.0)
    leave = np.minimum(np.maximum(one, other).min(axis=-1), 1.0)
    leave = np.maximum(enter, leave)
    return np.stack([start + enter[..., None] * along, start + leave[..., None] * along], axis=2)


def _swept(pieces: Array) -> Array:
    p, q = pieces[:, :, 0], pieces[:, :, 1]
    crossed = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return np.asarray(crossed.sum(axis=1) / 2)


def _distance(points: Array, half: Array) -> Array:
    """(P,) least distance of 4 points each to a box around the origin."""
    beyond = np.maximum(np.abs(points) - half[:, None], 0)
    return np.asarray(np.hypot(beyond[..., 0], beyond[..., 1]).min(axis=1))
