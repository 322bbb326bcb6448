"""A model or baseline that the evaluation compares, and the types of its scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np
from torch import Tensor

from app.registry import Artifact
from training.datasets.array_types import Flags, Floats
from training.datasets.batches import Batch
from training.evaluation.intruders import IntruderScores
from training.evaluation.setting import Setting

# Function that takes presence (scenes, classes) and returns log-odds (scenes, classes).
ObjectScore = Callable[[Tensor], Tensor]
# Function that also takes room types (scenes,), with -1 for an unknown room type.
RoomScore = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Places:
    """B scenes with a removed class, and the place of the removed class.

    Attributes:
        v: (B, V) presence of the remaining classes.
        counts: (B, V) instances of the remaining classes, 0 elsewhere.
        relation: (B,) int64 canonical relation.
        anchor: (B,) int64 class at the other end of the relation.
        outgoing: (B,) bool, the removed class is the subject of the relation.
    """

    v: Tensor
    counts: Tensor
    relation: Tensor
    anchor: Tensor
    outgoing: Tensor

    def rows(self, index: Tensor) -> Places:
        """Select the scenes at the given indices."""
        return Places(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


# Function that returns scores (B, V): higher means more likely missing from the place.
PlacedScore = Callable[[Places], Tensor]
# Function that returns scores (B, A, n, n) of the relations between the classes of a batch.
RelationScore = Callable[[Batch], Tensor]


@dataclass(frozen=True, eq=False)
class Alarm:
    """Alarm rule for objects.

    Attributes:
        suspicion: function that returns a score (N,) per object, higher = more likely an intruder.
        threshold: suspicion from which an object raises the alarm.
        short: thresholds for lists of 1, 2, ... classes; structure classes do not count.
    """

    suspicion: Callable[[IntruderScores], Floats]
    threshold: float
    short: tuple[float, ...] = ()

    def raised(self, scores: IntruderScores) -> Flags:
        """Return whether each scored object raises the alarm, (N,)."""
        limits = np.array([*self.short, self.threshold])
        limit = limits[np.minimum(scores.listed - 1, len(self.short))]
        loud: Flags = self.suspicion(scores) >= limit
        return loud


@dataclass(frozen=True, eq=False)
class ObjectDensity:
    """A probability distribution over presence vectors, which list the classes of a scene.

    Attributes:
        log_unnormalised: function that takes presence vectors (B, V) and returns their
            log-likelihood + log Z, (B,).
        upper: upper estimate of log Z. It equals `lower` if log Z is exact.
        notes: estimates of log Z and their standard errors, by name.
    """

    log_unnormalised: Callable[[Tensor], Tensor]
    lower: float
    upper: float
    notes: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Generated scenes.

    Attributes:
        contradictions: (scenes, 4) from `count_contradictions`. None if the sampler generates no
            relations.
    """

    v: Tensor
    contradictions: Tensor | None = None


class Sampler(Protocol):
    """Function that generates scenes, one for each row of `given`.

    Args:
        given: (scenes, classes) bool, the classes that each scene must contain.
        room: (scenes,) int64 room type of each scene; -1 if the room type is free.
    """

    def __call__(self, given: Tensor, room: Tensor, seed: int) -> Drawn: ...


Parameters: TypeAlias = Mapping[str, float | int | str]


@dataclass(frozen=True)
class Trial:
    """The result of one point of a hyperparameter grid.

    Attributes:
        seconds: wall time of fit and evaluation in seconds. Work that was already done for earlier
            grid points is not included.
    """

    parameters: Parameters
    validation: float
    seconds: float


@dataclass(frozen=True, eq=False)
class Model:
    """A trained machine, a baseline or a reference, as the tasks of the evaluation ask it.

    Each attribute answers the questions of one task. It is None if the model does not answer them.

    Attributes:
        missing: score of T2, missing objects.
        missing_in_room: score of T2 with the room type as evidence.
        at_place: score of T2-at, missing objects at a place.
        outliers: score of T3, intruders. By default it is `missing`.
        relations: score of T1a, relations of a scene.
        completion: score of T1b; the batch observes the given triples.
        false_relations: score of T3b; the batch observes all triples, one of them false.
        generate: function that takes the setting and returns the sampler of T4, or None.
        density: function that takes the setting and returns the density of objects, or None.
        alarm: alarm of T3.
        artifact: model for Calibration and for all questions to the service.
        parameters: number of trained weights, or None if this number is not meaningful.
        trials: all settings that the tuning of a baseline tried, in order.
    """

    missing: ObjectScore | None = None
    missing_in_room: RoomScore | None = None
    at_place: PlacedScore | None = None
    outliers: ObjectScore | None = None
    relations: RelationScore | None = None
    completion: RelationScore | None = None
    false_relations: RelationScore | None = None
    generate: Callable[[Setting], Sampler | None] | None = None
    density: Callable[[Setting], ObjectDensity | None] | None = None
    alarm: Alarm | None = None
    artifact: Artifact | None = None
    parameters: int | None = None
    trials: tuple[Trial, ...] = ()

    def __post_init__(self) -> None:
        if self.outliers is None:
            object.__setattr__(self, "outliers", self.missing)
