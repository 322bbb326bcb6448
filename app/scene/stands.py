"""What holds an object: the floor, a wall or the ceiling, or another object."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.scene.scene import CONTACT
from app.scene.spatial_relations import ABOVE, INSIDE, ON_TOP

UNKNOWN, FLOOR, HANGS, SUPPORTED = -1, 0, 1, 2
"""An object stands on the floor, hangs on a wall or from the ceiling, or is on or in an object."""

CLEARANCE: Final = 0.10  # maximum height in metres of the bottom of an object on the floor
CLOSE: Final = 0.15  # maximum gap in metres to an object that may support an object above it

USUAL: Final = 0.5  # share of a stand that is usual for a class
_UNIFORM: Final = 0.4  # density per metre of heights above the floor
_ERROR: Final = 0.05  # share of boxes at a wrong height
_SMALLEST: Final = 0.02  # smallest error in metres
_SQRT_2_PI: Final = math.sqrt(2 * math.pi)


@compiled
def floor_level(
    bottoms: Float[NDArray, " n"], shares: Float[NDArray, " n"], errors: Float[NDArray, " n"]
) -> float:
    """Return the likeliest height of the floor in metres, among the bottoms of n boxes, or NaN.

    The bottom of a box is at the floor f with the share S of its class, with a normal error s, or
    else above it. Boxes below the floor are errors. So f maximises

        Σ log( S · N(bottom - f; 0, s) + (1 - S) · U · [bottom ≥ f - s] + `_ERROR` · U )

    with U = .4 per metre. A candidate has S of at least `USUAL`, and is likelier the floor than
    another surface. A robot that sees a plant, a fork and a spoon at one height sees a table top. A
    surface at the height f has each box with the share H = (1 - S) / 2, so its log-likelihood is

        Σ log( H · N(bottom - f; 0, s) + (H + S · [bottom < f - s] + `_ERROR`) · U )

    Without any candidate, the height is NaN.
    """
    likeliest, level = -math.inf, math.nan
    for f in range(len(bottoms)):
        if math.isfinite(bottoms[f]) and shares[f] >= USUAL:
            floor, surface = _log_likelihoods(bottoms[f], bottoms, shares, errors)
            if floor >= surface and floor > likeliest:
                likeliest, level = floor, bottoms[f]
    return level


@compiled
def _log_likelihoods(level, bottoms, shares, errors):
    """Return the log-likelihoods of a floor and of a surface above it at this height."""
    floor, surface = 0.0, 0.0
    for i in range(len(bottoms)):
        error, distance = max(errors[i], _SMALLEST), bottoms[i] - level
        if not math.isnan(distance):
            near = math.exp(-0.5 * (distance / error) ** 2) / (error * _SQRT_2_PI)
            above = (1.0 - shares[i]) * (distance >= -error)
            floor += math.log(shares[i] * near + _UNIFORM * (above + _ERROR))
            half, below = (1.0 - shares[i]) / 2, shares[i] * (distance < -error)
            surface += math.log(half * near + _UNIFORM * (half + below + _ERROR))
    return floor, surface


@dataclass(frozen=True)
class Heights:
    """Bottoms, tops and footprint areas of n boxes, in metres and square metres; NaN: unknown."""

    bottoms: Float[NDArray, " n"]
    tops: Float[NDArray, " n"]
    areas: Float[NDArray, " n"]

    @classmethod
    def of(cls, centres: Float[NDArray, "n 3"], sizes: Float[NDArray, "n 3"]) -> Self:
        """Return the heights of boxes with these centres and extents."""
        half = sizes[:, 2] / 2
        return cls(centres[:, 2] - half, centres[:, 2] + half, sizes[:, 0] * sizes[:, 1])

    @cached_property
    def around(self) -> Bool[NDArray, "n n"]:
        """Whether box i reaches below a smaller box j, or far below its top: then j is under i."""
        is_deep = self.bottoms[:, None] < np.maximum(self.bottoms, self.tops - CONTACT)
        return is_deep & (self.areas[:, None] >= self.areas)


def stands_of(
    holds: Bool[NDArray, "A n n"], observed: Bool[NDArray, "A n n"], heights: Heights, floor: float
) -> Int[NDArray, " n"]:
    """Return the stand of each of n boxes, by relations a(i, j) that hold and that are observed.

    A low object stands on the floor, also if it is on a rug. The value is `UNKNOWN` if a bottom is
    unknown, if on-top or inside is not observed (box i reaches into box j), or if a box is closely
    above another box. Without a floor (in metres, or NaN), only `SUPPORTED` is known.
    """
    bottoms, tops, has_floor = heights.bottoms, heights.tops, not math.isnan(floor)
    is_known = np.isfinite(bottoms)
    is_close = (holds[ABOVE] & (bottoms[:, None] - tops <= CLOSE)).any(1)
    is_closed = observed[ON_TOP] & observed[INSIDE]
    np.fill_diagonal(is_closed, True)
    carried = holds[ON_TOP] & ~heights.around & ~(tops <= floor + CLEARANCE)
    # A later line overrules the earlier lines.
    stands = np.where(is_close, UNKNOWN, HANGS)
    stands[bottoms <= floor + CLEARANCE] = FLOOR
    stands[(~is_closed & is_known).any(1)] = UNKNOWN
    stands[(carried | holds[INSIDE]).any(1)] = SUPPORTED
    stands[~is_known if has_floor else ~is_known | (stands != SUPPORTED)] = UNKNOWN
    return stands
