"""Adapt a model to a home, and admit the result only if folds of the recordings show a gain.

- With at least `FEWEST` recorded scenes, the weights adapt (`training.fit.adapt`). Five folds of
  the groups of scenes measure the gain on scenes that the fit did not see. The gate refuses the new
  weights if the log loss of hidden objects is not certainly lower (t > 2), if they raise more
  alarms, or if rooms that the home never showed change.
- With fewer scenes, or if the gate refuses, the weights stay.
- Classes of confirmed scenes that the model still reports as outliers become exceptions: the new
  version never reports them.
- A home may become quieter about its habits, and never blind. The gate also refuses weights and
  exceptions with which the model misses more than a tenth of the true intruders
  (`training.domain.true_intruders`).
- Confirmed relations that the model reports as misplaced count as usual ones. Repeated relations
  and numbers change the statistics (`training.fit.adapt_statistics`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.inference import Weights
from app.model import SceneModel
from app.scene import CANONICAL
from training.domain.home import MAX_EXCEPTIONS, Home, alarms_of, with_exceptions
from training.domain.true_intruders import LARGEST_LOSS, Case, lost, true_intruders
from training.fit.adapt import adapt, part_loss
from training.fit.adapt_statistics import with_numbers, with_places
from training.fit.objects import random_parts
from training.machines import machine_of

FEWEST = 20  # number of distinct recorded scenes from which the weights adapt

_FOLDS = 5
_LEAST_T = 2.0
_LARGEST_CHANGE = 0.02
_PARTS = 8  # random parts of each scene in a measurement
_LEAVE_ONE_OUT = 0.0


@dataclass(frozen=True)
class Measured:
    """The parent (column 0) and the adapted weights (1) on N scenes that their fit did not see."""

    loss: Float[NDArray, "N 2"]  # log loss of hidden objects
    rank: Float[NDArray, "M 2"]  # reciprocal rank of a hidden object
    alarms: Bool[NDArray, "N 2"]  # True if the scene has an alarm about an object
    change: float  # mean change of the probability of unrecorded classes in rooms of the parent

    @property
    def t(self) -> float:
        """t statistic of the decrease of the log loss; inf if it is equal in all scenes."""
        decrease = self.loss[:, 0] - self.loss[:, 1]
        mean, error = decrease.mean(), float(decrease.std(ddof=1)) / math.sqrt(len(decrease))
        return float(mean) / error if error else math.copysign(math.inf, mean)

    def objections(self) -> Iterator[str]:
        """Yield the reasons against the adapted weights."""
        before, after = self.alarms.sum(0).astype(int).tolist()
        if not self.t > _LEAST_T:
            yield f"hidden objects are not certainly predicted better (t = {self.t:.1f})"
        if after > before:
            yield f"alarms rise from {before} to {after} of {len(self.alarms)} scenes"
        if self.change > _LARGEST_CHANGE:
            yield f"rooms that were never recorded change (by {self.change:.3f} on average)"


@dataclass(frozen=True)
class Adapted:
    """The result of an adaptation."""

    model: SceneModel | None  # the new model in memory, or None if it would equal the parent
    measured: Measured | None  # comparison in folds; None with fewer than `FEWEST` scenes
    objections: tuple[str, ...]  # reasons of the gate against new weights
    # Classes that the new model never reports, and in how many confirmed scenes it would.
    exceptions: Counter[str]
    refused: tuple[str, ...] = ()  # reasons of the gate against exceptions
    relations: tuple[str, ...] = ()  # confirmed relations that the parent reports, in words
    places: int = 0  # number of repeated relations
    numbers: tuple[str, ...] = ()  # labels of the classes with numbers of the home


def adapted(
    home: Home, *, seed: int = 0, progress: Callable[[str], None] = lambda _: None
) -> Adapted:
    """Adapt a model to a home."""
    progress("asking about true intruders")
    cases = true_intruders(home.parent, seed)
    model, measured, objections = _weights(home, cases, seed, progress)
    exceptions, refused = _exceptions(home, model, cases)
    model, numbers = with_numbers(with_exceptions(model, exceptions), home.numbers)
    model = with_places(model, home.relations, home.places)
    is_new = model.weights is not home.parent.weights
    news = (exceptions, home.relations, home.places, numbers, home.new_classes, home.new_rooms)
    labels = model.vocabulary.labels
    relations = [f"{labels[i]} {CANONICAL[a]} {labels[j]}" for a, i, j in sorted(home.relations)]
    return Adapted(
        model if is_new or any(news) else None,
        measured,
        objections,
        exceptions,
        refused,
        tuple(relations),
        len(home.places),
        tuple(numbers),
    )


def _weights(
    home: Home, cases: list[Case], seed: int, progress: Callable[[str], None]
) -> tuple[SceneModel, Measured | None, tuple[str, ...]]:
    """Return the model with adapted weights, or the parent and the reasons against the weights."""
    if len(home.measurable) < FEWEST:
        return home.parent, None, ()
    measured = measure(home, seed, progress)
    objections = [*measured.objections()]
    if objections:
        return home.parent, measured, tuple(objections)
    progress("adapting to all scenes")
    weights = adapt(home.parent.weights, home.tensors, trained_on=home.trained_on, seed=seed)
    model = replace(home.parent, weights=weights)
    objections += _blindness(model, cases)
    return (home.parent if objections else model), measured, tuple(objections)


def _exceptions(
    home: Home, model: SceneModel, cases: list[Case]
) -> tuple[Counter[str], tuple[str, ...]]:
    """Return the exceptions of a home, and the reasons against more or against all of them."""
    found = home.confirmed_alarms(model)
    exceptions, reasons = Counter(dict(found.most_common(MAX_EXCEPTIONS))), []
    if more := len(found) - len(exceptions):
        reasons.append(f"{more} more classes are beyond the {MAX_EXCEPTIONS} of a home")
    if exceptions and (blind := [*_blindness(with_exceptions(model, exceptions), cases)]):
        return Counter(), (*blind, *reasons)
    return exceptions, tuple(reasons)


def _blindness(model: SceneModel, cases: list[Case]) -> Iterator[str]:
    """Yield the reason against a model that misses too many true intruders."""
    missed = lost(model, cases)
    if missed > LARGEST_LOSS * len(cases):
        yield f"{missed} of {len(cases)} true intruders would raise no alarm any more"


def measure(home: Home, seed: int, progress: Callable[[str], None]) -> Measured:
    """Compare the parent with adapted weights in folds of groups, or of scenes if groups are few.

    Scenes need two classes. Written places take part in each fit, and never in a fold.
    """
    index = home.measurable
    names, group = np.unique([home.scenes[k].group for k in index], return_inverse=True)
    rng = np.random.default_rng(seed)
    fold_of = rng.permutation(len(names))[group] % _FOLDS
    if len(np.unique(fold_of)) < _FOLDS:
        fold_of = rng.permutation(len(index)) % _FOLDS
    rows = []
    for fold in range(_FOLDS):
        progress(f"comparing in folds: {fold + 1} of {_FOLDS}")
        test, seen = index[fold_of == fold], index[fold_of != fold]
        scenes = home.tensors.rows(torch.from_numpy(np.concatenate([seen, home.written])))
        weights = adapt(home.parent.weights, scenes, trained_on=home.trained_on, seed=seed)
        sides = home.parent, replace(home.parent, weights=weights)
        losses, ranks = _losses(home, test, sides, seed), _ranks(home, test, sides, seed)
        change = _change(home, weights, scenes.v.sum(0) > 0, seed)
        rows.append((losses, ranks, _alarms(home, test, sides), change))
    *tables, changes = zip(*rows, strict=True)
    loss, rank, alarms = map(np.concatenate, tables)
    return Measured(loss, rank, alarms, float(np.mean(changes)))


Sides = tuple[SceneModel, SceneModel]  # the parent, and the model with adapted weights


@torch.no_grad()
def _losses(home: Home, index: Int[NDArray, "N"], sides: Sides, seed: int) -> Float[NDArray, "N 2"]:
    """Return the mean log loss of random parts of each scene."""
    scenes = home.tensors.rows(torch.from_numpy(index))
    generator = torch.Generator().manual_seed(seed)
    table = torch.zeros(len(scenes), 2)
    for _ in range(_PARTS):
        parts = random_parts(scenes.v, _LEAVE_ONE_OUT, generator)
        for column, side in enumerate(sides):
            machine = machine_of(side.weights)
            log_odds = machine.object_log_odds(parts.listed, room=scenes.room, share=parts.share)
            table[:, column] += part_loss(log_odds, scenes.v, scenes, parts) / _PARTS
    return table.numpy()


@torch.no_grad()
def _ranks(home: Home, index: Int[NDArray, "N"], sides: Sides, seed: int) -> Float[NDArray, "N 2"]:
    """Return the reciprocal rank of one hidden class of each scene."""
    scenes = home.tensors.rows(torch.from_numpy(index))
    parts = random_parts(scenes.v, 1.0, torch.Generator().manual_seed(seed))
    hidden = (scenes.v - parts.listed).argmax(1, keepdim=True)
    table = torch.zeros(len(scenes), 2)
    for column, side in enumerate(sides):
        machine = machine_of(side.weights)
        log_odds = machine.object_log_odds(parts.listed, room=scenes.room, share=parts.share)
        log_odds[(parts.listed > 0) | ~scenes.observed] = -torch.inf
        table[:, column] = 1 / (1 + (log_odds > log_odds.gather(1, hidden)).sum(1))
    return table.numpy()


def _alarms(home: Home, index: Int[NDArray, "N"], sides: Sides) -> Bool[NDArray, "N 2"]:
    """Return whether each scene has an alarm about an object."""
    questions = (home.scenes[k].question for k in index.tolist())
    return np.array([[len(alarms_of(side, x)) > 0 for side in sides] for x in questions])


@torch.no_grad()
def _change(home: Home, weights: Weights, recorded: torch.Tensor, seed: int) -> float:
    """Return the mean change of the probability of unrecorded classes in stored samples."""
    samples = torch.from_numpy(home.parent.weights.chain_samples)
    samples = samples[samples.sum(1) >= 2][:256]  # a part needs two classes
    parts = random_parts(samples, _LEAVE_ONE_OUT, torch.Generator().manual_seed(seed))
    before, after = (
        machine_of(side).object_log_odds(parts.listed, share=parts.share).sigmoid()
        for side in (home.parent.weights, weights)
    )
    other = ~recorded & torch.from_numpy(~home.parent.vocabulary.structure)
    other[home.parent_classes :] = False
    # Most classes are improbable in a room. They would hide the changes of the others.
    counted = (other & (parts.listed == 0) & (torch.maximum(before, after) > 0.01)).float()
    return float(((after - before).abs() * counted).sum() / counted.sum().clamp(min=1))
