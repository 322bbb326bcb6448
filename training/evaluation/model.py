"""A model or baseline that the evaluation compares, and the types of its scores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from torch import Tensor

from app.registry import Artifact
from training.datasets.array_types import Flags, Floats
from training.datasets.batches import Batch
from training.evaluation.contradictions import Contradictions
from training.evaluation.intruders import IntruderScores
from training.machines import BoltzmannMachine

# Function that takes presence (scenes, classes) and returns log-odds (scenes, classes).
ObjectScore = Callable[[Tensor], Tensor]


# Function that takes presence (scenes, classes) and room types (scenes,), with -1 for an unknown
# room type. It returns log-odds (scenes, classes).
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
        contradictions: contradictions of the generated relations. None if the sampler generates no
            relations.
    """

    v: Tensor
    contradictions: Contradictions | None = None


class Sampler(Protocol):
    """Function that generates scenes, one for each row of `given`.

    Args:
        given: (scenes, classes) bool, the classes that each scene must contain.
        room: (scenes,) int64 room type of each scene; -1 if the room type is free.
    """

    def __call__(self, given: Tensor, room: Tensor, seed: int) -> Drawn: ...


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
