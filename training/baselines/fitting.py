"""What every baseline has in common: it proposes, validation chooses, every trial is kept.

A model is a generator: it fits on the training part alone and proposes (parameters, score) for
every point of its declared grid, an epoch of one run being a point too. It never sees the
validation part, by which `Baseline.fit` judges each proposal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

from torch import Tensor

from training.batches import SceneTensors

Score = TypeVar("Score")
Parameters: TypeAlias = Mapping[str, float | int | str]
Proposals: TypeAlias = Iterator[tuple[Parameters, Score]]
Progress: TypeAlias = Callable[[str], None]


def silent(_: str) -> None:
    """Report nothing."""


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
    """A tuned baseline.

    Attributes:
        name: the row of the table.
        score: of the best trial.
        trials: every trial, in the order tried.
    """

    name: str
    score: Score
    trials: tuple[Trial, ...]

    @property
    def best(self) -> Trial:
        """The chosen trial: the first of the highest validation figure."""
        return max(self.trials, key=lambda trial: trial.validation)

    @property
    def seconds(self) -> float:
        """Wall time of all trials."""
        return sum(trial.seconds for trial in self.trials)


@dataclass(frozen=True)
class Baseline(Generic[Score]):
    """A row of a table.

    Attributes:
        name: the row.
        propose: training scenes, structure classes (V,) bool and a seed -> what to choose from.
        judge: validation scenes, structure classes and a score -> figure, higher is better.
        stochastic: the seed changes the fit.
    """

    name: str
    propose: Callable[[SceneTensors, Tensor, int], Proposals[Score]]
    judge: Callable[[SceneTensors, Tensor, Score], float]
    stochastic: bool = False

    def fit(
        self,
        train: SceneTensors,
        validation: SceneTensors,
        structure: Tensor,
        *,
        seed: int = 0,
        progress: Progress = silent,
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
        return Fitted(self.name, chosen[0], tuple(trials))
