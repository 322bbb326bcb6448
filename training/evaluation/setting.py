"""What an evaluation task gets and returns: setting, model and outcome."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from app.model import SceneModel, Sensitivity
from app.scene import Scene
from training.datasets.array_types import Table
from training.datasets.batches import Batch, SceneTensors, subset
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

    def by_source(self) -> Iterator[tuple[str, Setting]]:
        """Iterate over the data sources, by name, and their scenes and training scenes."""
        training = {} if self.train is None else dict(by_source(self.train))
        for source, scenes in by_source(self.scenes):
            yield source, replace(self, scenes=scenes, train=training.get(source))

    @cached_property
    def complete(self) -> Setting:
        """The scenes with complete object lists; in other scenes unlisted objects may exist."""
        train = None if self.train is None else _complete(self.train)
        return replace(self, scenes=_complete(self.scenes), train=train if train else None)


def with_relations(scenes: SceneTensors) -> SceneTensors:
    """Return the scenes with a relation that holds."""
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
    return subset(scenes, torch.tensor(related, dtype=torch.int64))


def with_room_type(scenes: SceneTensors) -> SceneTensors:
    """Return the scenes with a room type."""
    return subset(scenes, scenes.room >= 0)


def by_source(scenes: SceneTensors) -> Iterator[tuple[str, SceneTensors]]:
    """Iterate over the data sources, by name, and their scenes."""
    names = np.array([scene.source for scene in scenes.scenes], dtype=np.str_)
    for name in np.unique(names).tolist():
        yield name, subset(scenes, torch.from_numpy(names == name))


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


ObjectScore: TypeAlias = Callable[[Float[Tensor, "B V"]], Float[Tensor, "B V"]]
"""Function from lists of classes to the log-odds of all classes."""

RoomScore: TypeAlias = Callable[[Float[Tensor, "B V"], str], Float[Tensor, "B C"]]
"""Function from lists and the name of a profile, or "", to log p of the room types."""

Flagged: TypeAlias = Callable[[Float[Tensor, "B V"], Sensitivity], Bool[Tensor, "B V"]]
"""Function from lists and a sensitivity to the reported outliers."""


@dataclass(frozen=True, eq=False)
class Places(Table):
    """B scenes with a removed class, and the place of the removed class."""

    v: Float[Tensor, "B V"]  # presence of the remaining classes
    counts: Float[Tensor, "B V"]  # their instances
    relation: Int[Tensor, " B"]  # canonical
    anchor: Int[Tensor, " B"]  # class at the other end of the relation
    outgoing: Bool[Tensor, " B"]  # True if the removed class is the subject


PlacedScore: TypeAlias = Callable[[Places], Float[Tensor, "B V"]]
"""Function that returns higher scores for classes that are likelier missing from the place."""

RelationScore: TypeAlias = Callable[[Batch], Float[Tensor, "B A n n"]]
"""Function that returns scores of the relations between the classes of a batch."""

MisplacedScore: TypeAlias = Callable[[Scene], Sequence[Mapping[str, Any]]]
"""Function from a scene of a request to the entries of `misplaced` of `/outliers`, likeliest first.
"""


@dataclass(frozen=True, eq=False)
class Drawn:
    """Generated scenes, and `count_contradictions` of their relations."""

    v: Float[Tensor, "B V"]
    contradictions: Int[Tensor, "B 4"]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of B scenes to generate, and the scenes from which a reference draws."""

    given: Bool[Tensor, "B V"]  # required classes
    room: Int[Tensor, " B"]  # room type; -1: any
    seed: int
    train: SceneTensors
    held_out: SceneTensors


Sampler: TypeAlias = Callable[[Evidence], Drawn]
"""Function that generates scenes."""

Parameters: TypeAlias = Mapping[str, float | int | str]


@dataclass(frozen=True, eq=False)
class Model:
    """A trained machine, a baseline or a reference, as the tasks of the evaluation ask it.

    Each attribute answers the questions of one task. It is None if the model does not answer them.
    """

    missing: ObjectScore | None = None  # T2: missing objects in a scene
    at_place: PlacedScore | None = None  # T2-at: missing objects at a place
    suspicion: ObjectScore | None = None  # T3; -inf if unlisted; default `suspicion_of(missing)`
    flags: Flagged | None = None  # outliers that a published model reports
    relations: RelationScore | None = None  # T1a: no relation is observed
    completion: RelationScore | None = None  # T1b: the given triples are observed
    false_relations: RelationScore | None = None  # T3b: all triples are observed, one is false
    misplaced: MisplacedScore | None = None  # T3c: moved objects
    lateral: float = 0.0  # T1 pairs: change of the log-odds of left and front, `lateral_shift`
    rooms: RoomScore | None = None
    generate: Sampler | None = None  # T4
    scene_model: SceneModel | None = None  # for Calibration and all questions to the service
    parameters: int | None = None  # number of trained weights; None if it has no meaning

    def __post_init__(self) -> None:
        if self.suspicion is None and self.missing is not None:
            object.__setattr__(self, "suspicion", suspicion_of(self.missing))


def suspicion_of(
    score: ObjectScore, log_popularity: Float[Tensor, " V"] | None = None, weight: float = 0.0
) -> ObjectScore:
    """Return the suspicion of each listed class: its negated score given the other classes.

    An intruder is often a common class in the wrong room. So the suspicion adds `weight` times the
    log popularity of the class, as `/outliers` does.
    """

    def suspicion(v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
        row, listed = (v > 0).nonzero(as_tuple=True)
        values = torch.full(v.shape, -torch.inf)
        if len(row):
            others = v[row].scatter(1, listed.unsqueeze(1), 0.0)  # one list for each listed class
            own = score(others).gather(1, listed.unsqueeze(1)).squeeze(1).to(values.dtype)
            prior = 0.0 if log_popularity is None else weight * log_popularity[listed]
            values[row, listed] = prior - own
        return values

    return suspicion
