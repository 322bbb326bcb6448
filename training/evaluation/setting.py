"""What is evaluated, what it is asked about, and what comes of it."""

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
    """One row of the tables: a callable for each task; None where it does not take part.

    Attributes:
        objects: T2 and T3.
        relations: T1a.
        completion: T1b; gets the given triples as the batch's relations.
        placed: T2-at.
        placement: T3b; gets the triples, a false one among them, as the batch's relations.
        sampler: T4.
        density: Density; called once, when it is needed.
        alarm: T3, the share of untouched scenes that raise one.
        artifact: Calibration, and all that is asked as a robot asks.
        objects_in_rooms: T2 where the room type is given.
        machine: the seed protocol, which samples.
        parameters: number of trained weights, None where that says nothing.
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
    """What a contender is asked about.

    Attributes:
        scenes: held-out scenes.
        structure: (V,) bool.
        train: training scenes of the same source or sources; tasks that need them are left out
            where there are none.
        seen: (T, 3), the triples that the contender may have learnt from.
        limit: at most so many scenes where a task is slow: all but T1a, T1b and T2; a third of it
            where a scene costs most: T2-at and Calibration.
        seed: of the questions.
        everyday: folder of the everyday facts; they are left out where it is None or absent.
    """

    scenes: SceneTensors
    structure: Tensor
    train: SceneTensors | None = None
    seen: Tensor | None = None
    limit: int | None = 600
    seed: int = 0
    everyday: Path | None = None

    def some(self, related: bool = False, *, share: int = 1) -> SceneTensors:
        """At most `limit` / `share` scenes, only annotated ones if `related`."""
        scenes = self.scenes
        if related:
            kept = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
            scenes = subset(scenes, torch.tensor(kept, dtype=torch.int64))
        most = None if self.limit is None else max(1, self.limit // share)
        return some_scenes(scenes, most, self.seed)

    def at(self, index: Tensor) -> Setting:
        """Of the scenes at the given positions alone."""
        return replace(self, scenes=subset(self.scenes, index))

    @cached_property
    def complete(self) -> Setting:
        """The scenes with complete object lists: in others, unlisted objects may be there."""
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
        metrics: name to metric, the primary one first.
        scenes, skipped: how many were asked about, and how many of them could not be scored.
        notes: what has to be said beside the figures, such as a bandwidth.
    """

    metrics: dict[str, Metric]
    scenes: int
    skipped: int
    notes: dict[str, float] = field(default_factory=dict)
