"""Overlap and gap of two rotated rectangles, exact up to rounding.

The rectangles are the footprints of boxes. If the angle between two rectangles is a multiple of 90
degrees, the module compares intervals along the common axes. Otherwise it clips the edges of each
rectangle to the area of the other rectangle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.inference import kernels

Array = NDArray[np.float64]


def overlap_and_gap(
    centre_a: Array, size_a: Array, yaw_a: Array, centre_b: Array, size_b: Array, yaw_b: Array
) -> tuple[Array, Array]:
    """Compute overlap and gap of P pairs of rectangles a and b.

    Centres (P, 2) and sizes (P, 2) along the rectangle's own axes are in metres, yaws (P,) in
    radians.

    Returns:
        Overlap of each pair, (P,): area of the intersection divided by the smaller area.
        Gap of each pair, (P,): distance between the rectangles in metres, or 0 if they touch.
    """
    share, gap = np.empty(len(yaw_a)), np.empty(len(yaw_a))
    rectangles = (centre_a, size_a, yaw_a, centre_b, size_b, yaw_b)
    kernels.measure_pairs(
        *(np.asarray(part, np.float64, order="C") for part in rectangles), share, gap
    )
    return share, gap
