"""Metrics that keep their values per scene, with bootstrap intervals.

The values per scene allow resampling, pairing with another model, pooling over sources, and storage
as JSON.

A resample draws scenes with replacement, as many as the set has. It is stored as the number of
times that each scene was drawn. The draws depend only on the number of scenes. So two
metrics of the same scenes use the same resamples, and their difference is paired.

Source: Efron and Tibshirani, "An introduction to the bootstrap" (1993).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from training.datasets.array_types import Flags, Floats, Ints
from training.evaluation.item_statistics import STATISTICS

RESAMPLES = 1000

FEWEST_GROUPS = 6
"""Minimum number of groups of near-duplicate scenes for a paired difference. A useless model is
better in all of five groups with a probability of 1/32, which is more than 2.5 %."""


@dataclass(frozen=True)
class Figure:
    """A metric with its 95 % interval.

    Attributes:
        value: the metric over all scenes.
        low, high: percentiles 2.5 and 97.5 over resampled scenes.
        n: number of scored items (removed objects, relations, scenes).
    """

    value: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, value: float, draws: Floats, n: int) -> Figure:
        """Compute the interval from resampled values; undefined values are left out."""
        low, high = np.nanpercentile(draws, [2.5, 97.5])
        return cls(value, float(low), float(high), n)

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


class Metric(ABC):
    """A metric over a set of scenes that can be resampled.

    Attributes:
        scenes: number of scenes, including scenes that could not be scored.
        n: number of scored items.
    """

    scenes: int
    n: int

    @abstractmethod
    def at(self, weight: Floats) -> float:
        """Return the metric with scene k counted weight[k] times; NaN if undefined."""

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Metric | None:
        """Return the metric over the scenes of all parts; None for metrics of whole sets."""
        return None

    @property
    def value(self) -> float:
        """The metric over all scenes."""
        return self.at(np.ones(self.scenes))

    @property
    def is_centred(self) -> bool:
        """True if resampling inflates the metric; its resamples are then centred on the value."""
        return False

    @cached_property
    def draws(self) -> Floats:
        """The metric over resampled scenes, (resamples,); NaN where undefined."""
        draws = resample(self.at, self.scenes)
        return _centred(draws, self.value) if self.is_centred else draws

    def figure(self, groups: Sequence[str] | None = None) -> Figure:
        """Return the value with its interval, over groups of scenes as in `paired_difference`."""
        if groups is None:
            return Figure.of(self.value, self.draws, self.n)
        draws = _group_draws(self.at, self.value, groups, RESAMPLES, centred=self.is_centred)
        return Figure.of(self.value, draws, self.n)


def paired_difference(
    a: Metric, b: Metric, *, groups: Sequence[str] | None = None, resamples: int = RESAMPLES
) -> Figure:
    """Return a minus b on the same scenes, with the interval of the difference.

    Args:
        groups: group of each scene. With groups, a resample draws groups instead of scenes, because
            scenes of one group are near-duplicates (Field and Welsh, "Bootstrapping clustered
            data", 2007). The draws are widened by `_widening`.
        resamples: number of draws of groups.

    Raises:
        ValueError: the numbers of scenes differ, or all scenes belong to one group.
    """
    if a.scenes != b.scenes or (groups is not None and len(groups) != a.scenes):
        of = "" if groups is None else f" and {len(groups)} group labels"
        raise ValueError(f"cannot pair {a.scenes} scenes with {b.scenes} scenes{of}")
    if groups is None:
        count = min(len(a.draws), len(b.draws))
        draws = a.draws[:count] - b.draws[:count]
    else:
        draws = _group_draws(lambda w: a.at(w) - b.at(w), a.value - b.value, groups, resamples)
    return Figure.of(a.value - b.value, draws, min(a.n, b.n))


def _group_draws(
    statistic: Callable[[Floats], float],
    value: float,
    groups: Sequence[str],
    resamples: int,
    *,
    centred: bool = False,
) -> Floats:
    """Return a statistic of the scene weights over resampled groups, widened by `_widening`.

    Raises:
        ValueError: all scenes belong to one group.
    """
    names, group_of = np.unique(np.array(groups), return_inverse=True)
    if len(names) < 2:
        raise ValueError("an interval needs scenes of at least two groups")
    weights = scene_weights(len(names), resamples)
    draws = np.array([statistic(weight[group_of]) for weight in weights])
    draws = _centred(draws, value) if centred else draws
    widened: Floats = value + _widening(len(names)) * (draws - value)
    return widened


def _widening(groups: int) -> float:
    """Return the factor that widens bootstrap intervals over G groups.

    The bootstrap variance of a mean is too small by (G - 1)/G. Its percentiles are those of a
    normal distribution; with an estimated variance, those of Student's t with G - 1 degrees of
    freedom apply.

    Source: Cameron, Gelbach and Miller, "Bootstrap-based improvements for inference with clustered
    errors" (2008), on the problem of few clusters.
    """
    quantiles = t.ppf(0.975, groups - 1) / norm.ppf(0.975)
    return float(quantiles * np.sqrt(groups / (groups - 1)))


@lru_cache(maxsize=4)  # many metrics resample the same scenes one after the other
def scene_weights(scenes: int, resamples: int = RESAMPLES) -> Floats:
    """Return how often each resample draws each scene, (resamples, scenes); read-only."""
    rng = np.random.default_rng(0)
    weights = np.empty((resamples, scenes))
    for row in weights:
        row[:] = np.bincount(rng.integers(scenes, size=scenes), minlength=scenes)
    weights.flags.writeable = False
    return weights


def resample(
    statistic: Callable[[Floats], float], scenes: int, resamples: int = RESAMPLES
) -> Floats:
    """Return a statistic of the scene weights for each resample, (resamples,)."""
    return np.array([statistic(weight) for weight in scene_weights(scenes, resamples)])


def _centred(drawn: Floats, value: float) -> Floats:
    """Shift the resamples so that their mean equals the value."""
    return drawn + (value - np.nanmean(drawn)) if np.isfinite(drawn).any() else drawn


@dataclass(frozen=True, eq=False)
class Ratio(Metric):
    """Micro-average: sum(numerators) / sum(denominators) over scenes.

    Both arrays have the shape (scenes,). A skipped scene has denominator 0.

    Raises:
        ValueError: all denominators are 0.
    """

    numerators: Floats
    denominators: Floats

    def __post_init__(self) -> None:
        if not self.denominators.sum() > 0:
            raise ValueError("no scene could be scored")

    @classmethod
    def of_items(cls, scene: Ints, values: NDArray[Any], scenes: int) -> Ratio:
        """Return the mean of item values (N,); `scene` (N,) is the scene of each item."""
        top = np.bincount(scene, weights=values, minlength=scenes).astype(np.float64)
        return cls(top, np.bincount(scene, minlength=scenes).astype(np.float64))

    @classmethod
    def of_scenes(cls, values: NDArray[Any], mask: NDArray[Any] | None = None) -> Ratio:
        """Return the mean of values (scenes,) over the scenes in ``mask``, by default all."""
        below = np.ones(len(values)) if mask is None else mask.astype(np.float64)
        return cls(values.astype(np.float64), below)

    @property
    def scenes(self) -> int:  # type: ignore[override]
        return len(self.numerators)

    @property
    def n(self) -> int:  # type: ignore[override]
        return round(float(self.denominators.sum()))

    def at(self, weight: Floats) -> float:
        below = float(weight @ self.denominators)
        return float(weight @ self.numerators) / below if below > 0 else float("nan")

    @cached_property
    def draws(self) -> Floats:
        # Two matrix products compute all resamples.
        weights = scene_weights(self.scenes)
        top, below = weights @ self.numerators, weights @ self.denominators
        return np.divide(top, below, where=below > 0, out=np.full(len(weights), np.nan))

    def mean_over_scenes(self) -> Ratio:
        """Return the metric with equal weight for every scored scene."""
        is_scored = self.denominators > 0
        share = np.zeros(self.scenes)
        np.divide(self.numerators, self.denominators, where=is_scored, out=share)
        return Ratio.of_scenes(share, is_scored)

    def __sub__(self, other: Ratio) -> Ratio:
        """Return the difference on the same items, as a metric with a paired interval.

        Raises:
            ValueError: the metrics have different items.
        """
        if not np.array_equal(self.denominators, other.denominators):
            raise ValueError("cannot subtract metrics with different items")
        return Ratio(self.numerators - other.numerators, self.denominators)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        return cls(
            np.concatenate([part.numerators for part in parts]),
            np.concatenate([part.denominators for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class Scored(Metric):
    """A statistic of the scores of N items that belong to scenes, such as the calibration error.

    Attributes:
        statistic: name in `STATISTICS`.
        scene: (N,) scene of each item.
        score, truth: (N,) score and truth value of each item.
        count: number of scenes.

    Raises:
        ValueError: there are no items, or the statistic is unknown.
    """

    statistic: str
    scene: Ints
    score: Floats
    truth: Flags
    count: int

    def __post_init__(self) -> None:
        if self.statistic not in STATISTICS:
            raise ValueError(
                f"unknown statistic {self.statistic!r}: must be one of {sorted(STATISTICS)}"
            )
        if not len(self.scene):
            raise ValueError("no scene could be scored")

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        # The scene indices of a part are shifted by the number of scenes in earlier parts.
        starts = np.cumsum([0, *(part.count for part in parts)]).tolist()
        shifted = [part.scene + start for part, start in zip(parts, starts[:-1], strict=True)]
        return cls(
            parts[0].statistic,
            np.concatenate(shifted).astype(np.int64),
            np.concatenate([part.score for part in parts]),
            np.concatenate([part.truth for part in parts]),
            starts[-1],
        )

    @property
    def scenes(self) -> int:  # type: ignore[override]
        return self.count

    @property
    def n(self) -> int:  # type: ignore[override]
        return len(self.scene)

    @cached_property
    def _prepared(self) -> Callable[[Floats], float]:
        """The statistic as a function of item weights; items are sorted once for all resamples."""
        return STATISTICS[self.statistic](self.score, self.truth)

    def at(self, weight: Floats) -> float:
        return self._prepared(weight[self.scene])

    @property
    def is_centred(self) -> bool:
        return self.statistic == "ECE"


@dataclass(frozen=True, eq=False)
class Items:
    """N scored items of some scenes, such as answers with their probabilities.

    Attributes:
        scene: (N,) scene of each item.
        score: (N,) score of each item.
        truth: (N,) bool, the item is true.
        skipped: number of scenes that could not be scored.
    """

    scene: Ints
    score: Floats
    truth: Flags
    scenes: int
    skipped: int = 0

    def hit_at_1(self) -> Ratio:
        """Return the share of scenes whose highest-scored item is true; expected over ties."""
        highest = np.full(self.scenes, -np.inf)
        np.maximum.at(highest, self.scene, self.score)
        is_highest = self.score == highest[self.scene]
        ties = np.bincount(self.scene[is_highest], minlength=self.scenes)
        hits = np.bincount(self.scene[is_highest & self.truth], minlength=self.scenes)
        return Ratio.of_scenes(hits / np.maximum(ties, 1), ties > 0)

    def metric(self, statistic: str) -> Scored:
        """Return one of `STATISTICS`."""
        return Scored(statistic, self.scene, self.score, self.truth, self.scenes)


@dataclass(frozen=True, eq=False)
class Resampled(Metric):
    """A metric of whole sets; only its value and its resamples are kept.

    Attributes:
        drawn: (resamples,) from `resample`.
        items: number of scenes in the other set of the comparison.
    """

    point: float
    drawn: Floats
    count: int
    items: int

    @classmethod
    def of(
        cls, statistic: Callable[[Floats], float], scenes: int, items: int, resamples: int
    ) -> Resampled:
        """Create the metric from a statistic of scene weights. The resamples are centred."""
        point = statistic(np.ones(scenes))
        drawn = resample(statistic, scenes, resamples)
        return cls(point, _centred(drawn, point), scenes, items)

    @property
    def scenes(self) -> int:  # type: ignore[override]
        return self.count

    @property
    def n(self) -> int:  # type: ignore[override]
        return self.items

    @property
    def value(self) -> float:
        return self.point

    def at(self, weight: Floats) -> float:
        raise NotImplementedError("a metric of whole sets cannot be computed for scene weights")

    @cached_property
    def draws(self) -> Floats:
        return self.drawn


class MeanOverSeeds(Metric):
    """The mean of a metric over training seeds; all seeds use the same resamples."""

    def __init__(self, members: Sequence[Metric]) -> None:
        if not members:
            raise ValueError("a mean over seeds needs at least one metric")
        if len({member.scenes for member in members}) > 1:
            raise ValueError("all seeds must have results on the same number of scenes")
        self.members = tuple(members)
        self.scenes, self.n = members[0].scenes, members[0].n

    @property
    def value(self) -> float:
        return float(np.mean([member.value for member in self.members]))

    def at(self, weight: Floats) -> float:
        return float(np.mean([member.at(weight) for member in self.members]))

    @cached_property
    def draws(self) -> Floats:
        shortest = min(len(member.draws) for member in self.members)
        mean: Floats = np.mean([member.draws[:shortest] for member in self.members], axis=0)
        return mean
