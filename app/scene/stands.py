"""What holds an object: the floor, a wall or the ceiling, or another object."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.scene.relations import SUPPORTS

UNKNOWN, FLOOR, HANGS, SUPPORTED = -1, 0, 1, 2
"""An object stands on the floor, hangs on a wall or from the ceiling, or is on or in an object."""

CLEARANCE: Final = 0.10  # maximum height in metres of the bottom of an object on the floor

Flags = NDArray[np.bool_]
Floats = NDArray[np.float64]


def floor_level(bottoms: Floats, weights: Floats) -> float:
    """Return the height of the floor: the weighted median of the bottoms of objects, in metres.

    Args:
        bottoms: (n,) heights in metres; NaN where unknown.
        weights: (n,) shares of the objects of each class that stand on the floor.
    """
    usable = np.isfinite(bottoms) & (weights > 0)
    if not usable.any():
        return float("nan")
    bottoms, weights = bottoms[usable], weights[usable]
    order = np.argsort(bottoms, kind="stable")
    total = np.cumsum(weights[order])
    return float(bottoms[order][np.searchsorted(total, total[-1] / 2)])


def stands_of(holds: Flags, observed: Flags, bottoms: Floats, floor: float) -> NDArray[np.int64]:
    """Return what holds each of n boxes, (n,).

    A low object stands on the floor, also if a rug is under it. A desk stands on the floor, also if
    a bin is under it ("the desk is on top of the bin"). The value is `UNKNOWN` if a bottom is
    unknown, or if a box reaches into another box and its relation to this box is open.

    Args:
        holds, observed: (A, n, n) relations between the boxes; see `PoseRelations`.
        bottoms: (n,) heights in metres; NaN where unknown.
        floor: height of the floor in metres.
    """
    is_known = np.isfinite(bottoms)
    supports = [*SUPPORTS]
    is_open = (~observed[supports] & is_known & ~np.eye(len(bottoms), dtype=np.bool_)).any((0, 2))
    stands = np.where(holds[supports].any((0, 2)), SUPPORTED, HANGS)
    stands[is_known & is_open & (stands == HANGS)] = UNKNOWN
    stands[bottoms <= floor + CLEARANCE] = FLOOR
    stands[~is_known] = UNKNOWN
    return stands
