"""What holds an object: the floor, a wall or the ceiling, or another object."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from app.scene.geometry import CONTACT
from app.scene.spatial_relations import ABOVE, INSIDE, ON_TOP

UNKNOWN, FLOOR, HANGS, SUPPORTED = -1, 0, 1, 2
"""An object stands on the floor, hangs on a wall or from the ceiling, or is on or in an object."""

CLEARANCE: Final = 0.10  # maximum height in metres of the bottom of an object on the floor
CLOSE: Final = 0.15  # maximum gap in metres to an object that may support an object above it

Flags = NDArray[np.bool_]
Floats = NDArray[np.float64]


USUAL: Final = 0.5  # share of a stand that is usual for a class


def floor_level(bottoms: Floats, weights: Floats) -> float:
    """Return the height of the floor: the lower weighted tertile of bottoms (n,), in metres.

    Only objects that usually stand on the floor count: the weights (n,) are the shares of the
    objects of each class that do. Without them, the height is NaN.
    """
    usable = np.isfinite(bottoms) & (weights >= USUAL)
    bottoms, weights = bottoms[usable], weights[usable]
    if not len(bottoms):
        return math.nan
    order = bottoms.argsort(kind="stable")
    total = weights[order].cumsum()
    return float(bottoms[order[total.searchsorted(total[-1] / 3)]])


@dataclass(frozen=True)
class Heights:
    """Bottoms, tops and footprint areas of n boxes, in metres and square metres; NaN: unknown."""

    bottoms: Floats
    tops: Floats
    areas: Floats

    @classmethod
    def of(cls, centres: Floats, sizes: Floats) -> Self:
        """Return the heights of boxes with these centres and extents, (n, 3) each."""
        half = sizes[:, 2] / 2
        return cls(centres[:, 2] - half, centres[:, 2] + half, sizes[:, 0] * sizes[:, 1])

    @cached_property
    def around(self) -> Flags:
        """Whether box i reaches below a smaller box j, or far below its top, (n, n).

        "i is on top of j" then means that j is under i, as a bin is under a desk.
        """
        is_deep = self.bottoms[:, None] < np.maximum(self.bottoms, self.tops - CONTACT)
        return is_deep & (self.areas[:, None] >= self.areas)


def stands_of(holds: Flags, observed: Flags, heights: Heights, floor: float) -> NDArray[np.int64]:
    """Return the stand of each of n boxes, (n,).

    A low object stands on the floor, also if it is on a rug. The value is `UNKNOWN` if a bottom or
    the floor is unknown, if a box reaches into another box and its relation to this box is open, or
    if a box is closely above another box.

    Args:
        holds, observed: (A, n, n) relations between the boxes; see `PoseRelations`.
        floor: height of the floor in metres, or NaN.
    """
    bottoms, tops, has_floor = heights.bottoms, heights.tops, not math.isnan(floor)
    is_known = np.isfinite(bottoms)
    is_close = (holds[ABOVE] & (bottoms[:, None] - tops <= CLOSE)).any(1)
    is_closed = observed[ON_TOP] & observed[INSIDE]
    np.fill_diagonal(is_closed, True)
    carried = holds[ON_TOP] & ~heights.around & ~(tops <= floor + CLEARANCE)
    stands = np.where(is_close, UNKNOWN, HANGS)
    stands[bottoms <= floor + CLEARANCE] = FLOOR
    stands[(~is_closed & is_known).any(1)] = UNKNOWN
    stands[(carried | holds[INSIDE]).any(1)] = SUPPORTED
    stands[~is_known if has_floor else ~is_known | (stands != SUPPORTED)] = UNKNOWN
    return stands
