"""One interface of all baselines: a model proposes, validation chooses, every trial is kept.

A model is a generator: it fits on the training part alone and proposes (parameters, score) for
every point of its declared grid, an epoch of one run being a point too. It never sees the
validation part, by which `Baseline.fit` judges each proposal: by the primary metric of its task,
pooled over sources.
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
        parameters: what was tried.
        validation: its figure on the validation part.
        seconds: wall time of fitting it, without what it shares with earlier points, and of judging
            it.
    """

    parameters: Parameters
    validation: float
    seconds: float


@dataclass(frozen=True)
class Fitted(Generic[Score]):
    """The score of the best trial (the first of the highest figure), and every trial in order."""

    score: Score
    trials: tuple[Trial, ...]


def missing_mrr(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> float:
    """T2: mean reciprocal rank of removed objects."""
    return leave_one_out(scenes, structure, score).mrr().value


def partial_mrr(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> float:
    """T2 partial: mean reciprocal rank of the hidden half of every scene."""
    return rank_hidden(hide(scenes, structure, 0.5), structure, score)[0].value


def placed_mrr(scenes: SceneTensors, structure: Tensor, score: PlacedScore) -> float:
    """T2-at: mean reciprocal rank of removed objects of which one relation is known."""
    return leave_one_out_at(scenes, structure, score)[0].mrr().value


def r_precision(scenes: SceneTensors, structure: Tensor, score: RelationScore) -> float:
    """T1a: R-precision, the counts of instances known."""
    return rank_relations(scenes, structure, score).pooled().value


def completion_r_precision(scenes: SceneTensors, structure: Tensor, score: RelationScore) -> float:
    """T1b: R-precision on the half of the relations that is not given."""
    return rank(complete_scenes(scenes, structure, score), len(scenes)).pooled().value


def log_likelihood(scenes: SceneTensors, _structure: Tensor, density: ObjectDensity) -> float:
    """Density: mean log-likelihood of the objects, nats, with the upper estimate of log Z."""
    return float(density.log_unnormalised(scenes.v).double().mean()) - density.upper


@dataclass(frozen=True)
class Baseline(Generic[Score]):
    """A row of a table.

    Attributes:
        name: the row.
        propose: training scenes, structure classes (V,) bool and a seed -> what to choose from.
        judge: validation scenes, structure classes and a score -> figure, higher is better.
        scores: the attributes of `Contender` that the score gives.
        stochastic: the seed changes the fit.
    """

    name: str
    propose: Callable[[SceneTensors, Tensor, int], Proposals[Score]]
    judge: Callable[[SceneTensors, Tensor, Any], float] = missing_mrr
    scores: tuple[str, ...] = ("objects",)
    stochastic: bool = False

    @property
    def learns_relations(self) -> bool:
        """It needs scenes that are annotated with relations."""
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
        """Fit on one part, choose on another.

        Args:
            structure: (V,) bool; such classes may be evidence, but are never asked for.

        Raises:
            ValueError: shapes disagree, or there is nothing to learn from or to choose by.
            FloatingPointError: the figure of a trial is not a number.
        """
        V = train.v.shape[1]
        if validation.v.shape[1] != V or structure.shape != (V,):
            raise ValueError(
                f"training scenes have {V} classes, validation scenes {validation.v.shape[1]}, "
                f"and structure has shape {tuple(structure.shape)}"
            )
        if not train.v.any():
            raise ValueError(f"no objects in {len(train)} training scenes")
        trials: list[Trial] = []
        chosen: list[Score] = []
        highest = -math.inf
        start = time.perf_counter()
        for parameters, score in self.propose(train, structure, seed):
            figure = self.judge(validation, structure, score)
            if math.isnan(figure):
                raise FloatingPointError(f"{self.name}: {dict(parameters)} has no figure")
            if figure > highest:
                highest, chosen = figure, [score]
            now = time.perf_counter()
            trials.append(Trial(dict(parameters), figure, now - start))
            shown = ", ".join(f"{key} {value}" for key, value in parameters.items())
            progress(f"{self.name} {shown}: {figure:.4f}")
            start = now
        return Fitted(chosen[0], tuple(trials))
