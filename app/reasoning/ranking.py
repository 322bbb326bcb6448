"""The best of many, in an order that never depends on chance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def best(
    values: NDArray[np.floating[Any]], usable: NDArray[np.bool_], count: int
) -> NDArray[np.intp]:
    """Positions of the `count` largest usable values, largest first, earlier first among equals."""
    where = np.flatnonzero(usable)
    if len(where) > count:
        # Everything at least as large as the last one wanted, so that ties are not cut at random.
        last = np.partition(values[where], -count)[-count]
        where = where[values[where] >= last]
    order = np.argsort(-values[where], kind="stable")[:count]
    return where[order]
