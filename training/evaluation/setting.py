"""Inputs and results of an evaluation task: contender, setting and outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from training.batches import SceneTensors, subset
from training.cases import some_scenes
from training.evaluation.metrics import Metric

if TYPE_CHECKING:
    from app.registry import Artifact
    from training.evaluation.density import ObjectDensity
    from training.evaluation.generation import Sampler
    from training.evaluation.missing import ObjectScore, PlacedScore, RoomScore
    from training.evaluation.outliers import Alarm
    from training.evaluation.relations import RelationScore
    from training.machines import BoltzmannMachine


@dataclass(frozen=True, eq=False)
class Contender:
    """A model or baseline that the evaluation compares; it fills one row of the result tables.

    The attribute of a task is None if the model or baseline does not support the task.

    Attributes:
        objects: score of T2 and T3.
        relations: score of T1a.
        completion: score of T1b; the batch observes the given triples.
        placed: score of T2-at.
        placement: score of T3b; the batch observes all triples, one of them false.
        sampler: sampler of T4.
        density: density, computed at its first use.
        alarm: alarm of T3.
        artifact: model for Calibration and for all questions to the service.
        objects_in_rooms: score of T2 with the room type as evidence.
        machine: machine for the seed protocol.
        parameters: number of trained weights, or None if this number is not meaningful.
    """

    objects: ObjectScore | None = None
    relations: RelationScore | None = None
    completion: RelationScore | None = None
    placed: PlacedScore | None = None
    placement: RelationScore | None = None
    sampler: Sampler | None = None
    density: Callable[[], ObjectDensity] | None = None
    alarm: Alarm | None = None
    artifact: Artifact | None = None
    objects_in_rooms: RoomScore | None = None
    machine: BoltzmannMachine | None = None
    parameters: int | None = None


@dataclass(frozen=True, eq=False)
class Setting:
    """The questions of an evaluation.

    Attributes:
        scenes: held-out scenes.
        structure: (V,) bool, True for structure classes.
        train: training scenes of the same sources. If None, tasks that need them are left out.
        seen: (T, 3) triples that the contender may have learnt from.
        limit: maximum number of scenes for slow tasks, which are all but T1a, T1b and T2. The
            slowest tasks, T2-at and Calibration, use a third of the limit.
        seed: random seed of the questions.
        everyday: folder of the everyday facts. None skips the task.
    """

    scenes: SceneTensors
    structure: Tensor
    train: SceneTensors | None = None
    seen: Tensor | None = None
    limit: int | None = 600
    seed: int = 0
    everyday: Path | None = None

    def some(self, related: bool = False, *, share: int = 1) -> SceneTensors:
        """Return at most `limit` / `share` scenes; with `related`, only scenes with relations."""
        scenes = self.scenes
        if related:
            kept = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
            scenes = subset(scenes, torch.tensor(kept, dtype=torch.int64))
        most = None if self.limit is None else max(1, self.limit // share)
        return some_scenes(scenes, most, self.seed)

    def at(self, index: Tensor) -> Setting:
        """Return the setting with only the scenes at the given indices."""
        return replace(self, scenes=subset(self.scenes, index))

    @cached_property
    def complete(self) -> Setting:
        """The scenes with complete object lists; in other scenes unlisted objects may exist."""
        train = None if self.train is None else _complete(self.train)
        return replace(self, scenes=_complete(self.scenes), train=train if train else None)


def _complete(scenes: SceneTensors) -> SceneTensors:
    if bool(scenes.complete.all()):
        return scenes
    return subset(scenes, scenes.complete.nonzero().squeeze(1))


@dataclass(frozen=True, eq=False)
class Outcome:
    """Metrics of one task.

    Attributes:
        metrics: metrics by name; the primary metric comes first.
        skipped: number of scenes that could not be scored.
        notes: additional values, such as a bandwidth.
    """

    metrics: dict[str, Metric]
    scenes: int
    skipped: int
    notes: dict[str, float] = field(default_factory=dict)
