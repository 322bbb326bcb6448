"""Metrics that keep their values per scene or group of scenes, with bootstrap intervals.

The values allow resampling, pairing with another model, pooling over sources, and storage as JSON.

The scenes of a group are near-duplicates. So a task counts a metric per scene, and `by` sums it per
group. A resample draws groups with replacement, as many as the set has. It is stored as the number
of times that each group was drawn. The draws depend only on the number of groups. So two metrics of
the same groups use the same resamples, and their difference is paired.

Sources: Efron and Tibshirani, "An introduction to the bootstrap" (1993); Field and Welsh,
"Bootstrapping clustered data" (2007), on the resampling of groups.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from training.datasets.array_types import Flags, Floats, Ints
from training.evaluation.item_statistics import STATISTICS, by_score, reliability

RESAMPLES = 1000

FEWEST_GROUPS = 6
"""Minimum number of groups of near-duplicate scenes for a paired difference. A useless model is
better in all of five groups with a probability of 1/32, which is more than 2.5 %."""


@dataclass(frozen=True)
class Figure:
    """A metric over `n` scored items, and its 95 % interval.

    The interval has the percentiles 2.5 and 97.5 over resampled groups, widened by `_widening`.
    """

    value: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, value: float, draws: Floats, n: int, groups: int) -> Figure:
        """Compute the interval from resampled values; undefined values are left out.

        Raises:
            ValueError: the number of groups is below 2.
        """
        if groups < 2:
            raise ValueError("an interval needs scenes of at least two groups")
        low, high = value + _widening(groups) * (np.nanpercentile(draws, [2.5, 97.5]) - value)
        return cls(value, float(low), float(high), n)

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


class Metric(ABC):
    """A metric over a set of scenes that can be resampled.

    Attributes:
        groups: (G,) int64 ids of the groups of scenes, with groups that could not be scored. A
            metric per scene has one group for each scene.
        n: number of scored items.
        draws: (resamples,) the metric over resampled groups; NaN where undefined.
    """

    groups: Ints
    n: int
    draws: Floats

    @abstractmethod
    def at(self, weight: Floats) -> float:
        """Return the metric with group k counted weight[k] times; NaN if undefined."""

    def by(self, groups: Ints) -> Metric:
        """Return the metric with its values summed by group; `groups` (G,) has the new ids."""
        return self

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Metric | None:
        """Return the metric over the groups of all parts; None for metrics of whole sets."""
        return None

    @property
    def value(self) -> float:
        """The metric over all scenes."""
        return self.at(np.ones(len(self.groups)))

    def figure(self) -> Figure:
        """Return the value with its interval."""
        return Figure.of(self.value, self.draws, self.n, len(self.groups))


def paired_difference(a: Metric, b: Metric) -> Figure:
    """Return a minus b on the same scenes, with the interval of the difference.

    Raises:
        ValueError: the groups differ, or all scenes belong to one group.
    """
    if not np.array_equal(a.groups, b.groups):
        raise ValueError(f"cannot pair {len(a.groups)} groups with {len(b.groups)} other groups")
    count = min(len(a.draws), len(b.draws))
    draws = a.draws[:count] - b.draws[:count]
    return Figure.of(a.value - b.value, draws, min(a.n, b.n), len(a.groups))


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


@lru_cache(maxsize=4)  # many metrics resample the same groups one after the other
def group_weights(groups: int, resamples: int = RESAMPLES) -> Floats:
    """Return how often each resample draws each group, (resamples, groups); read-only."""
    draws = np.random.default_rng(0).integers(groups, size=(resamples, groups))
    weights = np.array([np.bincount(row, minlength=groups) for row in draws], dtype=np.float64)
    weights.flags.writeable = False
    return weights


def resample(
    statistic: Callable[[Floats], float], groups: int, resamples: int = RESAMPLES
) -> Floats:
    """Return a statistic of the group weights for each resample, (resamples,)."""
    return np.array([statistic(weight) for weight in group_weights(groups, resamples)])


def _centred(drawn: Floats, value: float) -> Floats:
    """Shift the resamples so that their mean equals the value."""
    return drawn + (value - np.nanmean(drawn)) if np.isfinite(drawn).any() else drawn


@dataclass(frozen=True, eq=False)
class Ratio(Metric):
    """Micro-average: sum(numerators) / sum(denominators) over scenes, all arrays (G,).

    A skipped scene has denominator 0. If all denominators are 0, a ValueError is raised.
    """

    numerators: Floats
    denominators: Floats
    groups: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if not self.denominators.sum() > 0:
            raise ValueError("no scene could be scored")
        if not len(self.groups):
            object.__setattr__(self, "groups", np.arange(len(self.numerators)))

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
    def n(self) -> int:  # type: ignore[override]
        return round(float(self.denominators.sum()))

    def at(self, weight: Floats) -> float:
        below = float(weight @ self.denominators)
        return float(weight @ self.numerators) / below if below > 0 else float("nan")

    def by(self, groups: Ints) -> Ratio:
        ids, index = np.unique(groups, return_inverse=True)
        top, below = np.zeros((2, len(ids)))
        np.add.at(top, index, self.numerators)
        np.add.at(below, index, self.denominators)
        return Ratio(top, below, ids)

    @cached_property
    def draws(self) -> Floats:  # type: ignore[override]
        # Two matrix products compute all resamples.
        weights = group_weights(len(self.groups))
        top, below = weights @ self.numerators, weights @ self.denominators
        return np.divide(top, below, where=below > 0, out=np.full(len(weights), np.nan))

    def mean_over_scenes(self) -> Ratio:
        """Return the metric with equal weight for every scored scene."""
        is_scored = self.denominators > 0
        share = self.numerators / np.where(is_scored, self.denominators, np.inf)
        return Ratio.of_scenes(share, is_scored)

    def __sub__(self, other: Ratio) -> Ratio:
        """Return the difference on the same items, as a metric with a paired interval.

        Raises:
            ValueError: the metrics have different items.
        """
        if not np.array_equal(self.denominators, other.denominators):
            raise ValueError("cannot subtract metrics with different items")
        return Ratio(self.numerators - other.numerators, self.denominators, self.groups)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Ratio:
        names = ("numerators", "denominators", "groups")
        top, below, groups = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
        return cls(top, below).by(groups)


@dataclass(frozen=True, eq=False)
class Scored(Metric):
    """One of `STATISTICS` of the scores of N items that belong to scenes.

    Attributes:
        unit: (N,) position of the scene or group of each item in `groups`.
        score, truth: (N,) score and truth value of each item.

    Raises:
        ValueError: there are no items, or the statistic is unknown.
    """

    statistic: str
    unit: Ints
    score: Floats
    truth: Flags
    groups: Ints

    def __post_init__(self) -> None:
        if self.statistic not in STATISTICS:
            raise ValueError(
                f"unknown statistic {self.statistic!r}: must be one of {sorted(STATISTICS)}"
            )
        if not len(self.unit):
            raise ValueError("no scene could be scored")

    def by(self, groups: Ints) -> Scored:
        ids, index = np.unique(groups, return_inverse=True)
        return replace(self, unit=index[self.unit], groups=ids)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Scored:
        groups = np.concatenate([part.groups for part in parts])
        starts = np.cumsum([0, *(len(part.groups) for part in parts)])[:-1]
        unit = np.concatenate([p.unit + start for p, start in zip(parts, starts, strict=True)])
        score, truth = (np.concatenate([getattr(p, x) for p in parts]) for x in ("score", "truth"))
        return cls(parts[0].statistic, unit, score, truth, groups).by(groups)

    @property
    def n(self) -> int:  # type: ignore[override]
        return len(self.unit)

    @cached_property
    def _by_score(self) -> tuple[Floats, Callable[[Floats], tuple[Floats, Floats]]]:
        return by_score(self.score, self.truth)  # sorts the items once for all resamples

    def at(self, weight: Floats) -> float:
        scores, count = self._by_score
        return STATISTICS[self.statistic](scores, *count(weight[self.unit]))

    def reliability(self) -> tuple[Floats, Floats]:
        """Return the mean score and the share of true items of each bin of the ECE."""
        scores, count = self._by_score
        return reliability(scores, *count(np.ones(self.n)))

    @cached_property
    def draws(self) -> Floats:  # type: ignore[override]
        values = resample(self.at, len(self.groups))
        # Resampling inflates calibration errors, so these resamples are centred on the value.
        return _centred(values, self.value) if self.statistic == "ECE" else values


@dataclass(frozen=True, eq=False)
class Items:
    """N scored items of some scenes, such as answers: scene, score and truth value, all (N,).

    `skipped` is the number of scenes that could not be scored.
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
        return Scored(statistic, self.scene, self.score, self.truth, np.arange(self.scenes))


@dataclass(frozen=True, eq=False)
class Resampled(Metric):
    """A metric of which only its value and its resamples are kept, such as one of whole sets.

    Attributes:
        drawn: (resamples,) from `resample`.
        items: number of scored items, such as scenes in the other set of a comparison.
    """

    point: float
    drawn: Floats
    groups: Ints
    items: int

    @classmethod
    def of(
        cls, statistic: Callable[[Floats], float], groups: Ints, items: int, resamples: int
    ) -> Resampled:
        """Create the metric from a statistic of scene weights. The resamples are centred.

        Args:
            groups: (scenes,) id of the group of each scene.
        """
        ids, index = np.unique(groups, return_inverse=True)
        point = statistic(np.ones(len(groups)))
        drawn = resample(lambda weight: statistic(weight[index]), len(ids), resamples)
        return cls(point, _centred(drawn, point), ids, items)

    @property
    def n(self) -> int:  # type: ignore[override]
        return self.items

    @property
    def value(self) -> float:
        return self.point

    @property
    def draws(self) -> Floats:  # type: ignore[override]
        return self.drawn

    def at(self, weight: Floats) -> float:
        raise NotImplementedError("a resampled metric cannot be computed for weights")


def mean_over_seeds(members: Sequence[Metric]) -> Resampled:
    """Return the mean of a metric over training seeds; all seeds use the same resamples.

    Raises:
        ValueError: there is no metric, or the metrics have different groups.
    """
    if not members:
        raise ValueError("a mean over seeds needs at least one metric")
    groups = members[0].groups
    if not all(np.array_equal(member.groups, groups) for member in members):
        raise ValueError("all seeds must have results on the same groups of scenes")
    shortest = min(len(member.draws) for member in members)
    drawn: Floats = np.mean([member.draws[:shortest] for member in members], axis=0)
    value = float(np.mean([member.value for member in members]))
    return Resampled(value, drawn, groups, members[0].n)
