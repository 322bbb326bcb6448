"""Roles of two boxes that reach into each other: the smaller is on, under or in the larger.

Boxes are solid, but furniture has legs, backs and doors. So the boxes of a bin under a desk, of a
pillow on a bed with a headboard, and of milk in a fridge look alike. Their heights exclude some
roles. The roles that such pairs of classes have in words and support links decide.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled

ON, UNDER, IN = 0, 1, 2
"""Roles of the smaller object: on-top of, under, or inside the larger object."""

SAME: Final = 0.01  # footprints or volumes count as equal up to this share of the larger one
LEAST_RISE: Final = 0.2  # minimum height of an object on the larger, as a share of its height
MAX_RISE: Final = 0.10  # height in metres above the bottom of the larger that counts as the floor
MAX_HEIGHT: Final = 1.2  # maximum height of an object in the larger, as a share of its height
LEAST_WEIGHT: Final = 0.5  # minimum smoothed count of a role that decides
LEAST_SHARE: Final = 0.8  # minimum share of a role among the possible roles of a pair
# Weight of the roles at the larger class, in counts. They decide for pairs that were never seen.
_OF_ANCHOR: Final = 2.0


class RoleCounts(NamedTuple):
    """How often classes have each role, as sources state it in words or by support links.

    Attributes:
        pair: (P,) int64 keys i V + j of pairs of smaller class i and larger class j, ascending.
        counts: (P, 3) float32 number of scenes in which i has each role at j.
        anchor: (V, 3) float32 number of scenes in which any class has each role at class j.
    """

    pair: NDArray[np.int64]
    counts: NDArray[np.float32]
    anchor: NDArray[np.float32]


@compiled
def is_smaller(size_i: NDArray[Any], size_j: NDArray[Any]) -> bool:
    """Return whether box i is smaller than box j, by footprint or else by volume.

    For two boxes of the same size, the result is False in both orders. The sizes (3,) are extents
    in metres.
    """
    a, b = size_i[0] * size_i[1], size_j[0] * size_j[1]
    if abs(a - b) <= SAME * max(a, b):
        a, b = a * size_i[2], b * size_j[2]
    return a < b - SAME * max(a, b)


@compiled
def possible_roles(rise: float, height: float, larger_height: float) -> NDArray[np.bool_]:
    """Return which roles the heights of two boxes allow, (3,) bool.

    Args:
        rise: bottom of the smaller box above the bottom of the larger box, in metres.
        height: height of the smaller box in metres.
        larger_height: height of the larger box in metres.
    """
    possible = np.empty(3, np.bool_)
    possible[ON] = rise >= LEAST_RISE * larger_height
    possible[UNDER] = rise <= max(MAX_RISE, LEAST_RISE * larger_height)
    possible[IN] = height <= MAX_HEIGHT * larger_height
    return possible


def role_counts(roles: RoleCounts, i: int, j: int) -> NDArray[np.float32]:
    """Return the counts of the roles of a smaller class i at a larger class j, (3,)."""
    key = i * len(roles.anchor) + j
    row = int(np.searchsorted(roles.pair, key))
    if row < len(roles.pair) and roles.pair[row] == key:
        counts: NDArray[np.float32] = roles.counts[row]
        return counts
    return np.zeros(3, np.float32)


@compiled
def likely_role(
    roles: tuple[NDArray[Any], NDArray[Any], NDArray[Any]], i: int, j: int, possible: NDArray[Any]
) -> int:
    """Return the role of a smaller object of class i at a larger object of class j, or -1.

    The result is -1 if no role has `LEAST_SHARE` of the smoothed counts, and at least
    `LEAST_WEIGHT`.

    Args:
        roles: see `RoleCounts`.
        i, j: class indices. -1 means an unknown class.
        possible: (3,) bool, True for the roles that the boxes allow.
    """
    pair, counts, anchor = roles
    if i < 0 or j < 0:
        return -1
    weight = np.zeros(3)
    total = anchor[j].sum()
    key = i * len(anchor) + j
    row = np.searchsorted(pair, key)
    is_seen = row < len(pair) and pair[row] == key
    for role in range(3):
        if total > 0:
            weight[role] += _OF_ANCHOR * anchor[j, role] / total
        if is_seen:
            weight[role] += counts[row, role]
        if not possible[role]:
            weight[role] = 0.0
    best = int(np.argmax(weight))
    is_clear = weight[best] >= max(LEAST_WEIGHT, LEAST_SHARE * weight.sum())
    return best if is_clear else -1
