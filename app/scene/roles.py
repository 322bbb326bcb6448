"""Roles of two boxes that reach into each other: the smaller is on, under or in the larger.

Boxes are solid, but furniture has legs, backs and doors. So the boxes of a bin under a desk, of a
pillow on a bed with a headboard, and of milk in a fridge look alike. Their heights exclude some
roles. The roles that such pairs of classes have in words and support links decide.
"""

from typing import Final, NamedTuple

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


def role_counts(roles: RoleCounts, i: int, j: int) -> NDArray[np.float32]:
    """Return the counts of the roles of a smaller class i at a larger class j, (3,)."""
    key = i * len(roles.anchor) + j
    row = int(roles.pair.searchsorted(key))
    if row < len(roles.pair) and roles.pair[row] == key:
        return roles.counts[row]
    return np.zeros(3, np.float32)


@compiled
def is_smaller(size_i, size_j):
    """Return whether box i is smaller than box j.

    The function compares the areas of the footprints. If these are equal up to the share `SAME`, it
    compares the volumes. If the volumes are also equal, no box is smaller than the other.

    Args:
        size_i, size_j: extents of the boxes in x, y and z, in metres, (3,).
    """
    extent_i, extent_j = size_i[0] * size_i[1], size_j[0] * size_j[1]  # areas in m²
    if abs(extent_i - extent_j) <= SAME * max(extent_i, extent_j):
        extent_i, extent_j = extent_i * size_i[2], extent_j * size_j[2]  # volumes in m³
    return extent_i < extent_j - SAME * max(extent_i, extent_j)


@compiled
def possible_roles(rise, height, larger_height):
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


@compiled
def likely_role(roles, i, j, possible):
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
    row, likeliest, largest, total = find_row(pair, i * len(anchor) + j), -1, 0.0, 0.0
    of_anchor = anchor[j, 0] + anchor[j, 1] + anchor[j, 2]
    for role in range(3):
        weight = 0.0
        if possible[role]:
            if of_anchor > 0:
                weight += _OF_ANCHOR * anchor[j, role] / of_anchor
            if row >= 0:
                weight += counts[row, role]
        total += weight
        if weight > largest:
            likeliest, largest = role, weight
    return likeliest if largest >= max(LEAST_WEIGHT, LEAST_SHARE * total) else -1


@compiled
def find_row(keys, key):
    """Return the row of a key in ascending keys (N,), or -1 without such a key."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1
