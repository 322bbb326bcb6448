"""Which of the relations that were drawn a scene can have, all at once."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

Triple = tuple[int, int, int]


def staying(
    units: NDArray[np.int64],
    logits: NDArray[np.floating[Any]],
    given: Collection[Triple],
    structure: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Which of the drawn relations stay, (m,).

    Those that are given do. Of a(x, y) and a(y, x) the likelier one does, unless the other is
    given. A class stands in no relation to itself, nor structure in any: training drops the
    relations of structure, so what is drawn of them means nothing.

    Args:
        units: (m, 3) distinct (a, i, j) over classes.
        logits: (m,) of each; where two are equal, the one from the smaller class stays.
        given: (a, i, j) over classes.
        structure: (V,) which classes are.
    """
    a, i, j = units.T
    classes = len(structure)
    keys, mirrored = (a * classes + i) * classes + j, (a * classes + j) * classes + i
    fixed = np.array([(b * classes + x) * classes + y for b, x, y in given], dtype=np.int64)
    order = keys.argsort()
    place = order[np.searchsorted(keys, mirrored, sorter=order).clip(max=len(keys) - 1)]
    rival = np.where(keys[place] == mirrored, logits[place], -np.inf) if len(keys) else logits
    wins = (logits > rival) | ((logits == rival) & (i < j))
    possible = (i != j) & ~structure[i] & ~structure[j] & ~np.isin(mirrored, fixed)
    stay: NDArray[np.bool_] = np.isin(keys, fixed) | (wins & possible)
    return stay
