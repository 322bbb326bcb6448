"""Percentile bootstrap over scenes: intervals of a metric, and of the difference of two.

A resample draws as many scenes as there are, with replacement; it is held as the number of times
that each scene was drawn. The draws depend on the seed and the number of scenes alone, so two
metrics of the same scenes are resampled alike, and their difference is a paired one.

Source: Efron and Tibshirani, "An introduction to the bootstrap" (1993).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES = 1000


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

    @property
    def above_zero(self) -> bool:
        """The whole interval is above zero: in a paired difference, the first is better."""
        return self.low > 0


class Metric(ABC):
    """A metric over a set of scenes that can be resampled.

    Attributes:
        scenes: how many scenes were given, those that could not be scored among them.
        n: scored items.
        value: the metric over all of them.
    """

    @property
    @abstractmethod
    def scenes(self) -> int: ...

    @property
    @abstractmethod
    def n(self) -> int: ...

    @property
    @abstractmethod
    def value(self) -> float: ...

    def at(self, weight: Floats) -> float:
        """The metric where scene k counts weight[k] times; nan where it is undefined.

        Raises:
            NotImplementedError: the metric is of a whole set and keeps only its resamples.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot be weighted by scene")

    @abstractmethod
    def resampled(self, resamples: int, seed: int) -> Floats:
        """The metric over resampled scenes, (resamples,); nan where it is undefined."""

    def draws(self, resamples: int = RESAMPLES, seed: int = 0) -> Floats:
        """`resampled`, computed once."""
        if (resamples, seed) not in self._known:
            self._known[resamples, seed] = self.resampled(resamples, seed)
        return self._known[resamples, seed]

    @cached_property
    def _known(self) -> dict[tuple[int, int], Floats]:
        return {}

    def figure(self, *, resamples: int = RESAMPLES, seed: int = 0) -> Figure:
        """The value with its interval."""
        low, high = interval(self.draws(resamples, seed))
        return Figure(self.value, low, high, self.n)


def paired_difference(
    a: Metric,
    b: Metric,
    *,
    groups: Sequence[str] | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Figure:
    """a minus b on the same scenes, with the interval of the difference.

    Args:
        groups: of each scene; groups are drawn then, not scenes, since scenes of one group are
            near-duplicates (Field and Welsh, "Bootstrapping clustered data", 2007).

    Raises:
        ValueError: the two were measured on different numbers of scenes.
    """
    if a.scenes != b.scenes or (groups is not None and len(groups) != a.scenes):
        of = "" if groups is None else f", of {len(groups)} groups"
        raise ValueError(f"cannot pair {a.scenes} scenes with {b.scenes}{of}")
    if groups is None:
        x, y = a.draws(resamples, seed), b.draws(resamples, seed)
        both = min(len(x), len(y))
        draws = x[:both] - y[:both]
    else:
        names, place = np.unique(np.array(groups), return_inverse=True)
        weights = scene_weights(len(names), resamples, seed)
        draws = np.array([a.at(weight[place]) - b.at(weight[place]) for weight in weights])
    low, high = interval(draws)
    return Figure(a.value - b.value, low, high, min(a.n, b.n))


def interval(draws: Floats) -> tuple[float, float]:
    """Percentiles 2.5 and 97.5, resamples without a value left out."""
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return float(low), float(high)


@lru_cache(maxsize=4)
def scene_weights(scenes: int, resamples: int, seed: int) -> Floats:
    """How often each scene is drawn, (resamples, scenes); not to be written to.

    Kept, since many metrics are resampled over the same scenes one after the other.
    """
    rng = np.random.default_rng(seed)
    weights = np.empty((resamples, scenes))
    for row in weights:
        row[:] = np.bincount(rng.integers(scenes, size=scenes), minlength=scenes)
    weights.flags.writeable = False
    return weights


def resample(
    statistic: Callable[[Floats], float], scenes: int, resamples: int = RESAMPLES, seed: int = 0
) -> Floats:
    """A statistic of the scenes' weights over the resamples, (resamples,)."""
    return np.array([statistic(weight) for weight in scene_weights(scenes, resamples, seed)])
