"""Common interface of all baselines: fit on training scenes, select on validation scenes.

A baseline is a generator function. It fits a model on the training scenes for each point of a
hyperparameter grid, or each candidate number of steps, and yields pairs (parameters, score).
`Baseline.fit` evaluates each score on the validation scenes, and sends the value back to the
generator function, which never sees these scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from torch import Tensor

from training.datasets.batches import SceneTensors, has_relations
from training.datasets.cases import some_scenes
from training.evaluation.object_tasks import leave_one_out_at, mean_log_p
from training.evaluation.outlier_tasks import ask_moved, moved_cases
from training.evaluation.parts import validation_score
from training.evaluation.relation_tasks import (
    Candidates,
    complete_scenes,
    r_precision,
    score_scenes,
)
from training.evaluation.setting import (
    MisplacedScore,
    Model,
    ObjectScore,
    Parameters,
    PlacedScore,
    RelationScore,
    Structure,
)

_SCENES = 1000

Score = TypeVar("Score")
Proposals: TypeAlias = Generator[tuple[Parameters, Score], float, None]

TRIALS: Final = 24
"""Number of settings that each baseline tries at least, if its method has so many."""


def drawn_settings(**grid: Sequence[Any]) -> list[dict[str, Any]]:
    """Return `TRIALS` random points of a grid of hyperparameters."""
    points = list(product(*grid.values()))
    order = np.random.default_rng(0).permutation(len(points))[:TRIALS]
    return [dict(zip(grid, points[k], strict=True)) for k in order.tolist()]


def halving(
    settings: Sequence[dict[str, Any]],
    fit: Callable[[dict[str, Any], float], Iterator[tuple[Parameters, Score]]],
    rungs: Sequence[tuple[int, float]],
) -> Proposals[Score]:
    """Yield short fits of all settings, and longer fits of the best settings.

    `fit` yields scores of a setting for a share of the full length. A rung is a number of settings
    and a share. Source: K. Jamieson and A. Talwalkar, "Non-stochastic best arm identification and
    hyperparameter optimization", AISTATS 2016.
    """
    for count, share in rungs:
        best: list[float] = []
        for setting in settings[:count]:
            values = []
            for parameters, score in fit(setting, share):
                values.append((yield {**setting, **parameters}, score))
            best.append(max(values))
        settings = [settings[k] for k in np.argsort(best)[::-1]]


def missing_mrr(scenes: SceneTensors, structure: Structure, score: ObjectScore) -> float:
    """Return the `validation_score` of missing objects; a ValueError if none can be hidden."""
    value = validation_score(lambda v, _: score(v), scenes, structure)
    if math.isnan(value):
        raise ValueError("no scene has two classes, so no class can be hidden")
    return value


def placed_mrr(scenes: SceneTensors, structure: Structure, score: PlacedScore) -> float:
    """Return the mean reciprocal rank (MRR) of T2-at in at most `_SCENES` scenes."""
    return leave_one_out_at(some_scenes(scenes, _SCENES), structure, score)[0].mrr().value


def relation_precision(
    scenes: SceneTensors,
    structure: Structure,
    score: RelationScore,
    ask: Callable[..., list[Candidates]] = score_scenes,
) -> float:
    """Return the R-precision of relations, given the instance counts of classes (task T1a).

    With `ask=complete_scenes`, it is that of half of the relations, given the other half (T1b).
    """
    ratio = r_precision(ask(scenes, structure, score), len(scenes))
    if ratio is None:
        raise ValueError("no scene has an annotated relation between two things")
    return ratio.value


def named_moved(scenes: SceneTensors, structure: Structure, score: MisplacedScore) -> float:
    """Return the share of moved objects that are named first (T3c); 0 if no object can move.

    Raises:
        ValueError: no scene has a relation.
    """
    if not has_relations(scenes):
        raise ValueError("no scene has a relation, so no object can move")
    cases = moved_cases(some_scenes(scenes, _SCENES), structure)
    return float(ask_moved(score, cases)[:, 0].mean()) if cases else 0.0


class Answer(NamedTuple):
    """The fields of `Model` that a score fills, and its validation metric."""

    fields: tuple[str, ...]
    judge: Callable[[SceneTensors, Tensor, Any], float]  # of validation scenes; higher is better
    of_relations: bool = True  # True if the score learns from annotated relations


OBJECTS: Final = Answer(("missing",), missing_mrr, of_relations=False)
ROOMS: Final = Answer(("rooms",), mean_log_p, of_relations=False)
RELATIONS: Final = Answer(("relations", "false_relations"), relation_precision)
COMPLETION: Final = Answer(("completion",), partial(relation_precision, ask=complete_scenes))
AT_PLACE: Final = Answer(("at_place",), placed_mrr)
MISPLACED: Final = Answer(("misplaced",), named_moved)


@dataclass(frozen=True)
class Baseline:
    """One baseline, shown as one row of a result table."""

    name: str
    propose: Callable[[SceneTensors, Tensor, int], Proposals[Any]]  # scenes, structure, seed
    answer: Answer = OBJECTS
    stochastic: bool = False  # True if the fit depends on the seed

    def fit(
        self,
        train: SceneTensors,
        validation: SceneTensors,
        structure: Structure,
        *,
        seed: int = 0,
        progress: Callable[[str], None] = lambda _: None,
    ) -> Model:
        """Fit on training scenes, and select the first best grid point on validation scenes.

        Raises:
            ValueError: scenes needed for fit or metric are missing.
            FloatingPointError: the metric of a grid point is NaN.
        """
        if not train.v.any():
            raise ValueError(
                f"the {len(train)} training scenes contain no objects; a baseline needs objects"
            )
        best, highest = None, -math.inf
        proposals = self.propose(train, structure, seed)
        proposal = next(proposals, None)
        while proposal is not None:
            parameters, score = proposal
            metric = self.answer.judge(validation, structure, score)
            if math.isnan(metric):
                raise FloatingPointError(
                    f"{self.name}: the validation metric with {dict(parameters)} is NaN; leave "
                    "this grid point out"
                )
            if metric > highest:
                best, highest = score, metric
            text = ", ".join(f"{key} {value}" for key, value in parameters.items())
            progress(f"{self.name} {text}: {metric:.4f}")
            try:
                proposal = proposals.send(metric)
            except StopIteration:
                proposal = None
        scores: dict[str, Any] = dict.fromkeys(self.answer.fields, best)
        count = getattr(best, "parameter_count", None) if "missing" in scores else None
        return Model(**scores, parameters=count)
