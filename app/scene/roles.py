"""Roles of two boxes that reach into each other: the smaller is on, under or in the larger.

Boxes are solid, but furniture has legs, backs and doors. So the boxes of a bin under a desk, of a
pillow on a bed with a headboard, and of milk in a fridge look alike. Their heights exclude some
roles. The roles that such pairs of classes have in words and support links decide.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


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
