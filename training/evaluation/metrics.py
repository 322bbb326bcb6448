"""Metrics that keep their values per scene or group of scenes, with bootstrap intervals.

The scenes of a group are near-duplicates. So a task counts a metric per scene, and `by` sums it per
group. A resample draws groups with replacement, as many as the set has. It is stored as the number
of times that each group was drawn. The draws depend only on the number of groups. So two metrics of
the same groups use the same resamples, and their difference is paired.

Sources: Efron and Tibshirani, "An introduction to the bootstrap" (1993); Field and Welsh,
"Bootstrapping clustered data" (2007), on the resampling of groups.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Self, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

Statistic: TypeAlias = Callable[[Float[NDArray, " G"]], float]
"""Function of the weights of groups or scenes."""

Levels: TypeAlias = Float[NDArray, "3 levels"]
"""The distinct scores, lowest first, and the weights of all and of the true items of each."""

RESAMPLES = 1000
BINS = 10
_EDGES = np.linspace(0.0, 1.0, BINS + 1)

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
    def of(cls, value: float, draws: Float[NDArray, " resamples"], n: int, groups: int) -> Figure:
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


class Metric:
    """A metric over a set of scenes that can be resampled."""

    groups: Int[NDArray, " G"]  # ids of all groups of scenes; one per scene before `by`
    n: int  # number of scored items
    draws: Float[NDArray, " resamples"]  # NaN where undefined

    def at(self, weight: Float[NDArray, " G"]) -> float:
        """Return the metric with group k counted weight[k] times; NaN if undefined."""
        raise NotImplementedError

    def by(self, groups: Int[NDArray, " G"]) -> Metric:
        """Return the metric with its values summed by the new ids of the groups."""
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
    return float(stdtrit(groups - 1, 0.975) / ndtri(0.975) * np.sqrt(groups / (groups - 1)))


@lru_cache(maxsize=4)  # many metrics resample the same groups one after the other
def group_weights(groups: int, resamples: int = RESAMPLES) -> Float[NDArray, "resamples G"]:
    """Return how often each resample draws each group, as a read-only array."""
    draws = np.random.default_rng(0).integers(groups, size=(resamples, groups))
    weights = np.array([np.bincount(row, minlength=groups) for row in draws], dtype=np.float64)
    weights.flags.writeable = False
    return weights


def resample(
    statistic: Statistic, groups: int, resamples: int = RESAMPLES
) -> Float[NDArray, " resamples"]:
    """Return a statistic of the group weights for each resample."""
    return np.array([statistic(weight) for weight in group_weights(groups, resamples)])


def _centred(drawn: Float[NDArray, " resamples"], value: float) -> Float[NDArray, " resamples"]:
    """Shift the resamples so that their mean equals the value."""
    return drawn + (value - np.nanmean(drawn)) if np.isfinite(drawn).any() else drawn


@dataclass(frozen=True, eq=False)
class Ratio(Metric):
    """Micro-average: sum(numerators) / sum(denominators) over scenes.

    A skipped scene has denominator 0. If all denominators are 0, a ValueError is raised.
    """

    numerators: Float[NDArray, " G"]
    denominators: Float[NDArray, " G"]
    groups: Int[NDArray, " G"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if not self.denominators.sum() > 0:
            raise ValueError("no scene could be scored")
        if not len(self.groups):
            object.__setattr__(self, "groups", np.arange(len(self.numerators)))

    @classmethod
    def of_items(
        cls, scene: Int[NDArray, " N"], values: Shaped[NDArray, " N"], scenes: int
    ) -> Ratio:
        """Return the mean of the values of items, each of which belongs to a scene."""
        top = np.bincount(scene, weights=values, minlength=scenes).astype(np.float64)
        return cls(top, np.bincount(scene, minlength=scenes).astype(np.float64))

    @classmethod
    def of_scenes(
        cls, values: Shaped[NDArray, " G"], mask: Bool[NDArray, " G"] | None = None
    ) -> Ratio:
        """Return the mean of values over the scenes in `mask`, by default all."""
        counted = np.ones(len(values), np.bool_) if mask is None else mask
        return cls(np.where(counted, values, 0.0), counted.astype(np.float64))

    @property
    def n(self) -> int:  # type: ignore[override]
        return round(float(self.denominators.sum()))

    def at(self, weight: Float[NDArray, " G"]) -> float:
        below = float(weight @ self.denominators)
        return float(weight @ self.numerators) / below if below > 0 else float("nan")

    def by(self, groups: Int[NDArray, " G"]) -> Ratio:
        ids, index = np.unique(groups, return_inverse=True)
        top = np.bincount(index, self.numerators, len(ids))
        return Ratio(top, np.bincount(index, self.denominators, len(ids)), ids)

    @cached_property
    def draws(self) -> Float[NDArray, " resamples"]:  # type: ignore[override]
        # Two matrix products compute all resamples.
        weights = group_weights(len(self.groups))
        top, below = weights @ self.numerators, weights @ self.denominators
        return np.divide(top, below, where=below > 0, out=np.full(len(weights), np.nan))

    @property
    def skipped(self) -> int:
        """Number of scenes without an item."""
        return int((self.denominators == 0).sum())

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
    """One of `STATISTICS` of N items that belong to scenes, such as answers.

    For items of equal score, the statistic is the expectation under random order.

    Raises:
        ValueError: there are no items.
    """

    statistic: str
    unit: Int[NDArray, " N"]  # position of the scene or group of each item in `groups`
    score: Float[NDArray, " N"]
    truth: Bool[NDArray, " N"]
    groups: Int[NDArray, " G"]

    def __post_init__(self) -> None:
        if not len(self.unit):
            raise ValueError("no scene could be scored")

    def by(self, groups: Int[NDArray, " G"]) -> Scored:
        ids, index = np.unique(groups, return_inverse=True)
        return replace(self, unit=index[self.unit], groups=ids)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Scored:
        """Return the statistic over the items of all parts. Equal groups become one group."""
        groups = np.concatenate([part.groups for part in parts])
        starts = np.cumsum([0, *(len(part.groups) for part in parts)])[:-1]
        unit = np.concatenate([p.unit + start for p, start in zip(parts, starts, strict=True)])
        score, truth = (np.concatenate([getattr(p, x) for p in parts]) for x in ("score", "truth"))
        return cls(parts[0].statistic, unit, score, truth, groups).by(groups)

    @property
    def n(self) -> int:  # type: ignore[override]
        return len(self.unit)

    @cached_property
    def _levels(self) -> tuple[Float[NDArray, " levels"], Int[NDArray, " N"]]:
        """The distinct scores, lowest first, and their index for each item."""
        scores, level = np.unique(self.score, return_inverse=True)
        return scores, level

    def _weights(self, weight: Float[NDArray, " G"]) -> Levels:
        scores, level = self._levels
        of_item = weight[self.unit]
        counts = (np.bincount(level, w, len(scores)) for w in (of_item, of_item * self.truth))
        return np.stack([scores, *counts])

    def at(self, weight: Float[NDArray, " G"]) -> float:
        return STATISTICS[self.statistic](self._weights(weight))

    def reliability(self) -> tuple[Float[NDArray, " bins"], Float[NDArray, " bins"]]:
        """Return the mean score and the share of true items of each bin of the ECE."""
        return reliability(self._weights(np.ones(len(self.groups))))

    @cached_property
    def draws(self) -> Float[NDArray, " resamples"]:  # type: ignore[override]
        values = resample(self.at, len(self.groups))
        # Resampling inflates calibration errors, so these resamples are centred on the value.
        return _centred(values, self.value) if self.statistic == "ECE" else values


def reliability(levels: Levels) -> tuple[Float[NDArray, " bins"], Float[NDArray, " bins"]]:
    """Return the mean probability and the share of true items of each bin.

    The items are sorted by probability and divided into `BINS` bins of equal weight. If a bin
    border divides items of equal score, each bin gets a proportional part of the true items.
    """
    scores, totals, true = levels
    total = totals.sum()
    last = np.concatenate([[0.0], np.cumsum(totals)])

    def means(values: Float[NDArray, " levels"]) -> Float[NDArray, " bins"]:
        upto = np.interp(total * _EDGES, last, np.concatenate([[0.0], np.cumsum(values)]))
        return (upto[1:] - upto[:-1]) * (BINS / total)

    return means(totals * scores), means(true)


def calibration_error(levels: Levels) -> float:
    """Return the expected calibration error (ECE) of probabilities; NaN without items.

    The ECE is the mean over the bins of |mean probability - share of true items|.
    """
    if not levels[1].sum():
        return float("nan")
    p, y = reliability(levels)
    return float(np.abs(p - y).mean())


def brier_skill(levels: Levels) -> float:
    """Return the Brier skill: 1 - Brier score / Brier score of the base rate.

    The base rate is the share of true items. The skill is 0 if all probabilities are the base rate.
    It is NaN if no item or every item is true.
    """
    scores, totals, true = levels
    total = totals.sum()
    rate = true.sum() / total if total else 0.0
    base = rate * (1 - rate)
    brier = (true * (1 - scores) ** 2 + (totals - true) * scores**2).sum()
    return float(1 - brier / total / base) if base > 0 else float("nan")


STATISTICS: dict[str, Callable[[Levels], float]] = {
    "ECE": calibration_error,
    "Brier skill": brier_skill,
}
"""Statistics of scored items by name."""


@dataclass(frozen=True, eq=False)
class Resampled(Metric):
    """A metric of which only its value and its resamples are kept, such as one of whole sets."""

    point: float
    drawn: Float[NDArray, " resamples"]
    groups: Int[NDArray, " G"]
    items: int  # scored items, such as scenes in the other set of a comparison

    @classmethod
    def of(
        cls, statistic: Statistic, groups: Int[NDArray, " scenes"], items: int, resamples: int
    ) -> Resampled:
        """Create the metric from a statistic of scene weights. The resamples are centred."""
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
    def draws(self) -> Float[NDArray, " resamples"]:  # type: ignore[override]
        return self.drawn


def evidence_changes(metric: str, kind: str, without: Ratio, informed: Ratio) -> dict[str, Metric]:
    """Return a metric with and without one kind of evidence, and its change, which comes first."""
    return {
        f"change of {metric}, {kind}": informed - without,
        f"{metric}, {kind}": informed,
        f"{metric}, {kind} withheld": without,
    }
