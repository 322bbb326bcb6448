"""Rectangles against an independent oracle: polygon clipping in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.geometry import overlap_and_gap
from tests.scene.pose_rules import Box, common_area, distance_of

Rectangle = tuple[float, float, float, float, float]

coordinates = st.floats(-2, 2, width=32)
sides = st.floats(0.0625, 3, width=32)
turns = st.one_of(
    st.floats(-7, 7, width=32), st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi])
)
rectangles = st.tuples(coordinates, coordinates, sides, sides, turns)


def corners(rectangle: Rectangle) -> list[tuple[float, float]]:
    x, y, width, depth, yaw = rectangle
    return Box((x, y, 0.0), (width, depth, 1.0), yaw).corners


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
