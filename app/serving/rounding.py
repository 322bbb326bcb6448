"""Numbers of answers to six significant digits.

A module of its own: the compiler's cache is keyed by the files that hold loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled

DIGITS: Final = 6
"""Significant digits of probabilities, log-odds and metres."""

# Exact doubles: a whole number divided by one of them is the double nearest to the decimal number.
_POWERS: Final = np.array([10.0**power for power in range(23)])


def significant(numbers: Sequence[float]) -> list[float]:
    """The same numbers to `DIGITS` significant digits."""
    values = np.array(numbers, dtype=np.float64)
    exact = _round(values)
    rounded: list[float] = values.tolist()
    if not exact:
        return [float(f"{value:.{DIGITS}g}") for value in rounded]
    return rounded


@compiled
def _round(values: NDArray[np.float64]) -> bool:
    """Round numbers in place; False if one is too small or too large for exact powers of ten."""
    exact = True
    for k in range(len(values)):
        size = np.abs(values[k])
        if 1e-16 < size < 1e5:
            shift = DIGITS - 1 - np.int64(np.floor(np.log10(size)))
            scale = _POWERS[shift]
            values[k] = np.rint(values[k] * scale) / scale
        elif size != 0.0:
            exact = False
    return exact
