"""Roles of two boxes that reach into each other: the smaller is on, under or in the larger.

Boxes are solid, but furniture has legs, backs and doors. So the boxes of a bin under a desk, of a
pillow on a bed with a headboard, and of milk in a fridge look alike. Their heights exclude some
roles. The roles that such pairs of classes have in words and support links decide.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
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
    """How many scenes show each role, as sources state it in words or by support links."""

    pair: Int[NDArray, " P"]  # keys i V + j of smaller class i and larger class j, ascending
    counts: Float[NDArray, "P 3"]
    anchor: Float[NDArray, "V 3"]  # any smaller class at each larger class


def role_counts(roles: RoleCounts, i: int, j: int) -> Float[NDArray, " 3"]:
    """Return the counts of the roles of a smaller class i at a larger class j."""
    row = find_row(roles.pair, i * len(roles.anchor) + j)
    return np.zeros(3, np.float32) if row < 0 else roles.counts[row]


@compiled
def is_smaller(size_i: Float[NDArray, " 3"], size_j: Float[NDArray, " 3"]) -> bool:
    """Return whether box i has the smaller footprint, or at the same footprint the smaller volume.

    Extents that differ by at most the share `SAME` are equal.
    """
    extent_i, extent_j = size_i[0] * size_i[1], size_j[0] * size_j[1]  # areas in m²
    if abs(extent_i - extent_j) <= SAME * max(extent_i, extent_j):
        extent_i, extent_j = extent_i * size_i[2], extent_j * size_j[2]  # volumes in m³
    return extent_i < extent_j - SAME * max(extent_i, extent_j)


@compiled
def possible_roles(rise: float, height: float, larger_height: float) -> Bool[NDArray, " 3"]:
    """Return which roles the heights of two boxes in metres allow.

    ``rise`` is the bottom of the smaller box above the bottom of the larger box.
    """
    possible = np.empty(3, np.bool_)
    possible[ON] = rise >= LEAST_RISE * larger_height
    possible[UNDER] = rise <= max(MAX_RISE, LEAST_RISE * larger_height)
    possible[IN] = height <= MAX_HEIGHT * larger_height
    return possible


@compiled
def likely_role(roles: RoleCounts, i: int, j: int, possible: Bool[NDArray, " 3"]) -> int:
    """Return the role of a smaller object of class i at a larger object of class j, or -1.

    A role needs `LEAST_SHARE` of the smoothed counts of the possible roles, and at least
    `LEAST_WEIGHT`. A class index of -1 means an unknown class.
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
def find_row(keys: Int[NDArray, " P"], key: int) -> int:
    """Return the row of a key in ascending keys, or -1 without such a key."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1
