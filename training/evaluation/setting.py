"""What a contender is asked about, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from pathlib import Path

import torch
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.cases import some_scenes
from training.evaluation.contenders import Contender
from training.evaluation.generation import halves
from training.evaluation.intervals import Metric
from training.trainer import subset


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

    @cached_property
    def complete(self) -> Setting:
        """The scenes with complete object lists: in others, unlisted objects may be there."""
        train = None if self.train is None else _complete(self.train)
        return replace(
            self,
            scenes=_complete(self.scenes),
            train=train if train is not None and len(train) else None,
        )

    def halves(self) -> tuple[SceneTensors, SceneTensors]:
        """Scenes to compare drawn ones with, and a second half, each within the limit."""
        first, second = halves(self.scenes)
        return (
            some_scenes(first, self.limit, self.seed),
            some_scenes(second, self.limit, self.seed),
        )


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


Task = Callable[[Contender, Setting], Outcome | None]


def about_objects(task: Task) -> Task:
    """A task about the objects of a scene: it sees scenes with complete object lists alone."""

    @wraps(task)
    def asked(contender: Contender, setting: Setting) -> Outcome | None:
        setting = setting.complete
        return task(contender, setting) if len(setting.scenes) else None

    return asked


def _complete(scenes: SceneTensors) -> SceneTensors:
    if bool(scenes.complete.all()):
        return scenes
    return subset(scenes, scenes.complete.nonzero().squeeze(1))
