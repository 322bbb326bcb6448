"""Whether a series of readings of memory grows, beyond its own noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Trend:
    """A straight line through readings at even times.

    Attributes:
        growth: by the line, from the first reading to the last.
        noise: twice the standard error of that growth.
    """

    growth: float
    noise: float


def trend(readings: Sequence[float]) -> Trend:
    """The line of least squares. Its first readings should come after whatever is kept for good.

    Raises:
        ValueError: there are fewer than three readings.
    """
    if len(readings) < 3:
        raise ValueError("a trend needs three readings")
    y = np.asarray(readings, dtype=np.float64)
    x = np.linspace(0, 1, len(y))
    slope, start = np.polyfit(x, y, 1)
    residual = y - (slope * x + start)
    spread = np.sqrt(residual @ residual / (len(y) - 2) / ((x - x.mean()) ** 2).sum())
    return Trend(float(slope), float(2 * spread))
