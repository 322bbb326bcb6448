"""Bootstrap intervals over scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Figure:
    """A metric with its 95 % interval.

    Attributes:
        value: the metric over all scenes.
        low, high: percentiles 2.5 and 97.5 over scenes drawn with replacement.
        n: scored items (removed objects, relations, scenes).
    """

    value: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def ratio_figure(
    numerators: NDArray[np.float64],
    denominators: NDArray[np.float64],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> Figure:
    """sum(numerators) / sum(denominators) over scenes, as a micro-average is.

    Args:
        numerators, denominators: (scenes,); a scene with denominator 0 was skipped.

    Raises:
        ValueError: nothing was scored.
    """
    if not denominators.sum() > 0:
        raise ValueError("no scene could be scored")

    def ratio(index: NDArray[np.int64]) -> float:
        return float(numerators[index].sum() / max(denominators[index].sum(), 1e-12))

    return bootstrap(ratio, len(numerators), int(denominators.sum()), resamples, seed)


def bootstrap(
    statistic: Callable[[NDArray[np.int64]], float],
    scenes: int,
    n: int,
    resamples: int = 1000,
    seed: int = 0,
) -> Figure:
    """A statistic of scene positions with its percentile interval."""
    rng = np.random.default_rng(seed)
    draws = [statistic(rng.integers(scenes, size=scenes)) for _ in range(resamples)]
    low, high = np.percentile(draws, [2.5, 97.5])
    return Figure(statistic(np.arange(scenes)), float(low), float(high), n)
