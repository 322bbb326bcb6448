"""Which objects speak for another, or against it: how its log-odds change by each of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import Because, entries
from app.reasoning.listing import strongest
from app.reasoning.present import Present

REASONS = 3
"""How many objects an answer names as reasons."""

EXPLAINED = 32
"""Reasons are given for so many entries of an answer at most, its first."""

_NOWHERE = np.zeros(0, dtype=np.int64)


def strongest_reasons(
    present: Present, change: NDArray[np.floating[Any]], rows: NDArray[np.int64] = _NOWHERE
) -> list[tuple[Because, ...]]:
    """The classes that change the log-odds of N others most, strongest first, for each of these.

    Of either sign; instances of a class are spoken of by the first.

    Args:
        change: (N, n) by each class present.
        rows: (N,) places of what is explained among the n; left out where it is absent.
    """
    places, values = strongest(change, rows, REASONS)
    objects = present.first[places.reshape(-1)].tolist()
    found, kept = entries(Because, objects, values.reshape(-1).tolist()), places.shape[1]
    return [tuple(found[k : k + kept]) for k in range(0, len(found), kept)]
