"""Metrics that keep what they were made of, scene by scene.

So they can be resampled, paired with another model's, pooled over sources, and stored as JSON.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from training.evaluation.intervals import Floats, Metric, resample, scene_weights
from training.evaluation.item_statistics import STATISTICS

Ints = NDArray[np.int64]


class SceneMetric(Metric):
    """A metric whose items belong to scenes: it can be pooled and stored."""

    @abstractmethod
    def at(self, weight: Floats) -> float:
        """The metric where scene k counts weight[k] times; nan where it is undefined."""

    @classmethod
    @abstractmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """The metric over the scenes of all parts, one after the other."""

    @property
    def value(self) -> float:
        return self.at(np.ones(self.scenes))

    def resampled(self, resamples: int, seed: int) -> Floats:
        return resample(self.at, self.scenes, resamples, seed)


@dataclass(frozen=True, eq=False)
class Ratio(SceneMetric):
    """sum(numerators) / sum(denominators) over scenes, as a micro-average is.

    Attributes:
        numerators, denominators: (scenes,); denominator 0 where a scene was skipped.

    Raises:
        ValueError: nothing was scored.
    """

    numerators: Floats
    denominators: Floats

    def __post_init__(self) -> None:
        if not self.denominators.sum() > 0:
            raise ValueError("no scene could be scored")

    @classmethod
    def of_items(cls, scene: Ints, values: Floats, scenes: int) -> Ratio:
        """The mean of values (N,) of items that belong to the scenes at `scene` (N,)."""
        top = np.bincount(scene, weights=values, minlength=scenes).astype(np.float64)
        return cls(top, np.bincount(scene, minlength=scenes).astype(np.float64))

    @property
    def scenes(self) -> int:
        return len(self.numerators)

    @property
    def n(self) -> int:
        return round(float(self.denominators.sum()))

    def at(self, weight: Floats) -> float:
        below = float(weight @ self.denominators)
        return float(weight @ self.numerators) / below if below > 0 else float("nan")

    def resampled(self, resamples: int, seed: int) -> Floats:
        # All resamples in two products.
        weights = scene_weights(self.scenes, resamples, seed)
        top, below = weights @ self.numerators, weights @ self.denominators
        nothing = np.full(resamples, np.nan)
        share: Floats = np.divide(top, below, where=below > 0, out=nothing)
        return share

    def mean_over_scenes(self) -> Ratio:
        """The same with every scored scene counting alike."""
        some = self.denominators > 0
        share = np.divide(self.numerators, self.denominators, where=some, out=np.zeros(len(some)))
        return Ratio(share, some.astype(np.float64))

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        return cls(
            np.concatenate([part.numerators for part in parts]),
            np.concatenate([part.denominators for part in parts]),
        )


def lowest_is(scene: Ints, value: Floats, right: NDArray[np.bool_], scenes: int) -> Ratio:
    """hit@1: share of scenes whose item of the lowest value is a right one, ties in expectation.

    Args:
        scene, value, right: (N,) of each item.
    """
    lowest = np.full(scenes, np.inf)
    np.minimum.at(lowest, scene, value)
    least = value == lowest[scene]
    ties = np.bincount(scene[least], minlength=scenes)
    hits = np.bincount(scene[least & right], minlength=scenes)
    return Ratio(hits / np.maximum(ties, 1), (ties > 0).astype(np.float64))


@dataclass(frozen=True, eq=False)
class Macro(SceneMetric):
    """The mean over groups (classes, say) of the mean over a group's items.

    Rare groups drop out of resamples, which lifts their mean where rare groups do worse: the
    resamples are centred on the value, so that they tell its spread alone.

    Attributes:
        scene, group: (N,) of each item; value_of: (N,).
        count: scenes given.

    Raises:
        ValueError: nothing was scored.
    """

    scene: Ints
    group: Ints
    value_of: Floats
    count: int

    def __post_init__(self) -> None:
        if not len(self.scene):
            raise ValueError("no scene could be scored")

    @property
    def scenes(self) -> int:
        return self.count

    @property
    def n(self) -> int:
        return len(np.unique(self.group))

    def at(self, weight: Floats) -> float:
        item = weight[self.scene]
        below = np.bincount(self.group, weights=item)
        top = np.bincount(self.group, weights=item * self.value_of)
        some = below > 0
        return float((top[some] / below[some]).mean()) if some.any() else float("nan")

    def resampled(self, resamples: int, seed: int) -> Floats:
        return _centred(super().resampled(resamples, seed), self.value)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        return cls(
            _shifted(parts),
            np.concatenate([part.group for part in parts]),
            np.concatenate([part.value_of for part in parts]),
            sum(part.count for part in parts),
        )


@dataclass(frozen=True, eq=False)
class Scored(SceneMetric):
    """A statistic of all items' scores at once: AUROC, average precision, calibration.

    Attributes:
        statistic: its name in `STATISTICS`.
        scene: (N,) of each item; score: (N,); truth: (N,) bool.
        count: scenes given.

    Raises:
        ValueError: nothing was scored, or no such statistic.
    """

    statistic: str
    scene: Ints
    score: Floats
    truth: NDArray[np.bool_]
    count: int

    def __post_init__(self) -> None:
        if self.statistic not in STATISTICS:
            raise ValueError(f"unknown statistic {self.statistic!r}, not of {sorted(STATISTICS)}")
        if not len(self.scene):
            raise ValueError("no scene could be scored")

    @property
    def scenes(self) -> int:
        return self.count

    @property
    def n(self) -> int:
        return len(self.scene)

    def at(self, weight: Floats) -> float:
        return self._function()(weight[self.scene])

    def resampled(self, resamples: int, seed: int) -> Floats:
        # Items are sorted once for all resamples.
        function = self._function()
        drawn = resample(lambda weight: function(weight[self.scene]), self.count, resamples, seed)
        return _centred(drawn, self.value) if self.statistic in _GROWING else drawn

    def _function(self) -> Callable[[Floats], float]:
        return STATISTICS[self.statistic](self.score, self.truth)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        return cls(
            parts[0].statistic,
            _shifted(parts),
            np.concatenate([part.score for part in parts]),
            np.concatenate([part.truth for part in parts]),
            sum(part.count for part in parts),
        )


@dataclass(frozen=True, eq=False)
class Resampled(Metric):
    """A metric of whole sets, which is kept by its value and its resamples alone.

    Attributes:
        point: the value.
        drawn: (resamples,) by `intervals.resample` with seed 0 over the same scenes.
        count: scenes; items: what was compared with them.
    """

    point: float
    drawn: Floats
    count: int
    items: int

    @classmethod
    def of(
        cls, statistic: Callable[[Floats], float], scenes: int, items: int, resamples: int
    ) -> Resampled:
        """From a statistic of the scenes' weights.

        Distances between sets grow under resampling, as if the sets were smaller; the resamples are
        centred on the value, so that they tell its spread alone.
        """
        point = statistic(np.ones(scenes))
        drawn = resample(statistic, scenes, resamples)
        return cls(point, _centred(drawn, point), scenes, items)

    @property
    def scenes(self) -> int:
        return self.count

    @property
    def n(self) -> int:
        return self.items

    @property
    def value(self) -> float:
        return self.point

    def resampled(self, resamples: int, seed: int) -> Floats:
        if seed != 0:
            raise ValueError(f"only the resamples of seed 0 were kept, not those of {seed}")
        return self.drawn[:resamples]


def _centred(drawn: Floats, value: float) -> Floats:
    return drawn + (value - np.nanmean(drawn)) if np.isfinite(drawn).any() else drawn


# Calibration errors grow under resampling, as if there were fewer answers.
_GROWING = ("ECE",)

_KINDS: dict[str, type[Metric]] = {
    "ratio": Ratio,
    "macro": Macro,
    "scored": Scored,
    "resampled": Resampled,
}


def pool(parts: Sequence[Metric]) -> Metric | None:
    """One metric over the scenes of all parts; None for metrics of whole sets.

    Raises:
        ValueError: no parts, or parts of different kinds.
    """
    kinds = {(type(part), getattr(part, "statistic", "")) for part in parts}
    if len(kinds) != 1:
        raise ValueError(f"cannot pool metrics of {len(kinds)} kinds")
    first = parts[0]
    return type(first).join(parts) if isinstance(first, SceneMetric) else None  # type: ignore[arg-type]


def metric_to_dict(metric: Metric) -> dict[str, Any]:
    """JSON-able values, floats to nine significant digits."""
    kind = next(name for name, cls in _KINDS.items() if type(metric) is cls)
    values = {field.name: getattr(metric, field.name) for field in fields(metric)}  # type: ignore[arg-type]
    return {"kind": kind} | {name: _plain(value) for name, value in values.items()}


def metric_from_dict(values: dict[str, Any]) -> Metric:
    """What `metric_to_dict` wrote.

    Raises:
        ValueError: not one of its kinds.
    """
    rest = dict(values)
    kind = rest.pop("kind", None)
    if kind not in _KINDS:
        raise ValueError(f"kind must be one of {sorted(_KINDS)}, not {kind!r}")
    return _KINDS[kind](**{name: _array(name, value) for name, value in rest.items()})


_TYPES: dict[str, type] = {"scene": np.int64, "group": np.int64, "truth": np.bool_}


def _array(name: str, value: Any) -> Any:
    if not isinstance(value, list):
        return value
    # JSON has no nan; a resample without a value is null.
    values = [float("nan") if x is None else x for x in value]
    return np.array(values, dtype=_TYPES.get(name, np.float64))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return [float(f"{x:.9g}") if np.isfinite(x) else None for x in value.tolist()]
    if isinstance(value, np.ndarray):
        return value.astype(np.int64).tolist()
    return value


def _shifted(parts: Sequence[Any]) -> Ints:
    """The items' scenes, those of each part counted on from the parts before."""
    starts = np.cumsum([0, *(part.count for part in parts)])
    shifted = [part.scene + start for part, start in zip(parts, starts[:-1], strict=True)]
    return np.concatenate(shifted).astype(np.int64)
