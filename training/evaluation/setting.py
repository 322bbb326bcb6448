"""Inputs and results of an evaluation task: setting and outcome."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import some_scenes
from training.evaluation.metrics import Metric

Structure: TypeAlias = Bool[Tensor, " V"]
"""Mask of structure classes, such as walls. They are evidence, but never questions."""


@dataclass(frozen=True, eq=False)
class Setting:
    """The questions of an evaluation."""

    scenes: SceneTensors  # held out
    structure: Structure
    train: SceneTensors | None = None  # of the same sources; None skips tasks that need it
    seen: Int[Tensor, "triples 3"] | None = None  # triples that the model may have learnt from
    # Maximum scenes of slow tasks: all but T1a and T1b. T2-at and Calibration use a third of it.
    limit: int | None = 600
    seed: int = 0
    everyday: Path | None = None  # folder of the everyday facts; None skips the task

    def some(self, related: bool = False, *, share: int = 1) -> SceneTensors:
        """Return at most `limit` / `share` scenes; with `related`, only scenes with relations."""
        scenes = with_relations(self.scenes) if related else self.scenes
        limit = None if self.limit is None else max(1, self.limit // share)
        return some_scenes(scenes, limit, self.seed)

    def at(self, index: Int[Tensor, " N"]) -> Setting:
        """Return the setting with only the scenes at the given indices."""
        return replace(self, scenes=subset(self.scenes, index))

    @cached_property
    def complete(self) -> Setting:
        """The scenes with complete object lists; in other scenes unlisted objects may exist."""
        train = None if self.train is None else _complete(self.train)
        return replace(self, scenes=_complete(self.scenes), train=train if train else None)


def with_relations(scenes: SceneTensors) -> SceneTensors:
    """Return the scenes with a relation that holds."""
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
    return subset(scenes, torch.tensor(related, dtype=torch.int64))


def _complete(scenes: SceneTensors) -> SceneTensors:
    return scenes if bool(scenes.complete.all()) else subset(scenes, scenes.complete)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Metrics of one task."""

    metrics: dict[str, Metric]  # the primary metric comes first
    scenes: int
    skipped: int  # scenes that could not be scored
    notes: dict[str, float] = field(default_factory=dict)  # further values, such as a bandwidth

    @classmethod
    def over(
        cls, scenes: SceneTensors, metrics: Mapping[str, Metric], skipped: int
    ) -> Outcome | None:
        """Return the metrics per scene, summed by group of near-duplicates; None without any."""
        if not metrics:
            return None
        by_group = {name: metric.by(scenes.group_ids) for name, metric in metrics.items()}
        return cls(by_group, len(scenes), skipped)
