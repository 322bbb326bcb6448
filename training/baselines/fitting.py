"""Common interface of all baselines: fit on training scenes, select on validation scenes.

A baseline is a generator. It fits on the training part and yields (parameters, score) for each
point of its hyperparameter grid. A network also yields a grid point for each candidate epoch.
`Baseline.fit` evaluates each score on the validation part by the primary metric of its task, pooled
over sources. The generator never sees the validation part. `Fitted` keeps all trials.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.density import ObjectDensity
from training.evaluation.missing import (
    ObjectScore,
    PlacedScore,
    hide,
    leave_one_out,
    leave_one_out_at,
    rank_hidden,
)
from training.evaluation.relations import RelationScore, complete_scenes, rank, rank_relations

Score = TypeVar("Score")
Parameters: TypeAlias = Mapping[str, float | int | str]
Proposals: TypeAlias = Iterator[tuple[Parameters, Score]]


@dataclass(frozen=True)
class Trial:
    """One point of a grid.

    Attributes:
        parameters: the grid point.
        validation: metric on the validation part.
        seconds: wall time of fit and evaluation. Work done for earlier grid points is not included.
    """

    parameters: Parameters
    validation: float
    seconds: float


@dataclass(frozen=True)
class Fitted(Generic[Score]):
    """The score of the best trial, and all trials in order. On a tie, the first trial is best."""

    score: Score
    trials: tuple[Trial, ...]


def missing_mrr(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> float:
    """Return the mean reciprocal rank (MRR) of removed objects, task T2."""
    return leave_one_out(scenes, structure, score).mrr().value


def partial_mrr(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> float:
    """Return the MRR of the hidden half of every scene, task T2 partial."""
    return rank_hidden(hide(scenes, structure, 0.5), structure, score)[0].value


def placed_mrr(scenes: SceneTensors, structure: Tensor, score: PlacedScore) -> float:
    """Return the MRR of removed objects with one known relation, task T2-at."""
    return leave_one_out_at(scenes, structure, score)[0].mrr().value


def r_precision(scenes: SceneTensors, structure: Tensor, score: RelationScore) -> float:
    """Return the R-precision of relations with known instance counts, task T1a."""
    return rank_relations(scenes, structure, score).pooled().value


def completion_r_precision(scenes: SceneTensors, structure: Tensor, score: RelationScore) -> float:
    """Return the R-precision on the half of the relations that is not given, task T1b."""
    return rank(complete_scenes(scenes, structure, score), len(scenes)).pooled().value


def log_likelihood(scenes: SceneTensors, _structure: Tensor, density: ObjectDensity) -> float:
    """Return the mean log-likelihood of the objects in nats, with the upper estimate of log Z."""
    return float(density.log_unnormalised(scenes.v).double().mean()) - density.upper


@dataclass(frozen=True)
class Baseline(Generic[Score]):
    """One baseline, a row of a table.

    Attributes:
        name: name of the row.
        propose: generator function of (training scenes, structure classes (V,) bool, seed). It
            yields (parameters, score) for each trial.
        judge: function of (validation scenes, structure classes, score). It returns the metric;
            higher is better.
        scores: fields of `Contender` that the score fills.
        stochastic: True if the fit depends on the seed.
    """

    name: str
    propose: Callable[[SceneTensors, Tensor, int], Proposals[Score]]
    judge: Callable[[SceneTensors, Tensor, Any], float] = missing_mrr
    scores: tuple[str, ...] = ("objects",)
    stochastic: bool = False

    @property
    def learns_relations(self) -> bool:
        """True if the baseline needs scenes with annotated relations."""
        return self.scores not in (("objects",), ("density",))

    def fit(
        self,
        train: SceneTensors,
        validation: SceneTensors,
        structure: Tensor,
        *,
        seed: int = 0,
        progress: Callable[[str], None] = lambda _: None,
    ) -> Fitted[Score]:
        """Fit on the training part and select on the validation part.

        Args:
            structure: (V,) bool; structure classes are evidence only, never candidates.

        Raises:
            ValueError: shapes disagree, or the training or validation scenes are unusable.
            FloatingPointError: the metric of a trial is NaN.
        """
        V = train.v.shape[1]
        if validation.v.shape[1] != V or structure.shape != (V,):
            raise ValueError(
                f"training scenes have {V} classes, validation scenes {validation.v.shape[1]}, "
                f"and structure has shape {tuple(structure.shape)}"
            )
        if not train.v.any():
            raise ValueError(f"the {len(train)} training scenes contain no objects")
        trials: list[Trial] = []
        chosen: list[Score] = []
        highest = -math.inf
        start = time.perf_counter()
        for parameters, score in self.propose(train, structure, seed):
            figure = self.judge(validation, structure, score)
            if math.isnan(figure):
                raise FloatingPointError(f"{self.name}: the metric of {dict(parameters)} is NaN")
            if figure > highest:
                highest, chosen = figure, [score]
            now = time.perf_counter()
            trials.append(Trial(dict(parameters), figure, now - start))
            shown = ", ".join(f"{key} {value}" for key, value in parameters.items())
            progress(f"{self.name} {shown}: {figure:.4f}")
            start = now
        return Fitted(chosen[0], tuple(trials))
