"""Rectangles against an independent oracle: polygon clipping in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.geometry import overlap_and_gap

Point = tuple[float, float]
Rectangle = tuple[float, float, float, float, float]

coordinates = st.floats(-2, 2, width=32)
sides = st.floats(0.0625, 3, width=32)
turns = st.one_of(
    st.floats(-7, 7, width=32), st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi])
)
rectangles = st.tuples(coordinates, coordinates, sides, sides, turns)


def corners(rectangle: Rectangle) -> list[Point]:
    """The corners, counter-clockwise."""
    x, y, length, width, yaw = rectangle
    cos, sin = math.cos(yaw) / 2, math.sin(yaw) / 2
    return [
        (x + cos * u * length - sin * v * width, y + sin * u * length + cos * v * width)
        for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]


def common_area(subject: list[Point], clip: list[Point]) -> float:
    """Area of the intersection of two convex polygons (Sutherland & Hodgman 1974)."""
    for (ax, ay), (bx, by) in zip(clip, clip[1:] + clip[:1], strict=True):

        def side(p: Point, ax: float = ax, ay: float = ay, bx: float = bx, by: float = by) -> float:
            return (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax)

        kept: list[Point] = []
        for p, q in zip(subject, subject[1:] + subject[:1], strict=True):
            if side(p) >= 0:
                kept.append(p)
            if side(p) * side(q) < 0:
                t = side(p) / (side(p) - side(q))
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        subject = kept
    turns = zip(subject, subject[1:] + subject[:1], strict=True)
    return abs(sum(p[0] * q[1] - p[1] * q[0] for p, q in turns)) / 2


def distance_of(a: list[Point], b: list[Point]) -> float:
    """Least distance of two convex polygons, 0 where they overlap."""
    if common_area(a, b) > 1e-9:
        return 0.0
    return min(border_distance(a, b), border_distance(b, a))


def border_distance(points: list[Point], polygon: list[Point]) -> float:
    """Least distance of some points to the border of a polygon."""
    best = math.inf
    for px, py in points:
        for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            ux, uy = bx - ax, by - ay
            t = ((px - ax) * ux + (py - ay) * uy) / (ux * ux + uy * uy)
            t = min(max(t, 0.0), 1.0)
            best = min(best, math.hypot(px - ax - t * ux, py - ay - t * uy))
    return best


def measure(a: Rectangle, b: Rectangle) -> tuple[float, float]:
    share, gap = overlap_and_gap(
        *(np.array([part], dtype=float) for r in (a, b) for part in (r[:2], r[2:4], r[4]))
    )
    return float(share[0]), float(gap[0])


@given(rectangles, rectangles)
def test_overlap_and_gap_agree_with_polygon_clipping(a: Rectangle, b: Rectangle) -> None:
    share, gap = measure(a, b)
    area = common_area(corners(a), corners(b))
    assert share * min(a[2] * a[3], b[2] * b[3]) == pytest.approx(area, abs=1e-5)
    assert gap == pytest.approx(distance_of(corners(a), corners(b)), abs=1e-5)


def test_a_footprint_too_small_for_its_area_is_a_point() -> None:
    """1e-300 m squared underflows to 0: it lies wholly in what it touches, else not at all."""
    tiny, table = np.full((2, 2), 1e-300), np.ones((2, 2))
    centres = np.array([[0.0, 0.0], [3.0, 0.0]])
    share, gap = overlap_and_gap(
        centres, tiny, np.zeros(2), np.zeros((2, 2)), table, np.array([0.0, 0.3])
    )
    assert share.tolist() == [1.0, 0.0]
    assert gap[0] == 0
    assert gap[1] > 2
