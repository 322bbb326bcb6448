"""A model or baseline that the evaluation compares, and the types of its scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor

from app.model import SceneModel, Sensitivity
from app.scene import Scene
from training.datasets.batches import Batch
from training.evaluation.setting import Setting

# Function that takes presence (scenes, classes) and returns log-odds (scenes, classes).
ObjectScore = Callable[[Tensor], Tensor]

# Function from lists (B, V) and the name of a profile, or "", to log p (B, room types).
RoomScore = Callable[[Tensor, str], Tensor]
# Function that takes lists (B, V) and a sensitivity, and returns the reported outliers (B, V) bool.
Flagged = Callable[[Tensor, Sensitivity], Tensor]


@dataclass(frozen=True, eq=False)
class Places:
    """B scenes with a removed class, and the place of the removed class.

    Attributes:
        v, counts: (B, V) presence and instances of the remaining classes.
        relation, anchor: (B,) int64 canonical relation, and class at its other end.
        outgoing: (B,) bool, the removed class is the subject of the relation.
    """

    v: Tensor
    counts: Tensor
    relation: Tensor
    anchor: Tensor
    outgoing: Tensor

    def rows(self, index: Tensor) -> Places:
        """Select the scenes at the given indices."""
        return Places(*(column[index] for column in vars(self).values()))


# Function that returns scores (B, V): higher means more likely missing from the place.
PlacedScore = Callable[[Places], Tensor]
# Function that returns scores (B, A, n, n) of the relations between the classes of a batch.
RelationScore = Callable[[Batch], Tensor]
# Function from a scene, as a request states it, to the entries of `misplaced` of `/outliers`. The
# first entry has the highest probability.
MisplacedScore = Callable[[Scene], Sequence[Mapping[str, Any]]]


@dataclass(frozen=True, eq=False)
class Drawn:
    """Generated scenes, (scenes, V), and `count_contradictions` of their relations."""

    v: Tensor
    contradictions: Tensor


# Function that generates scenes from the classes that each scene must contain, (scenes, classes)
# bool, the room type of each scene, (scenes,) int64 or -1 for any, and a seed.
Sampler = Callable[[Tensor, Tensor, int], Drawn]
# Function of the setting; None if its scenes allow no answer.
SamplerOf = Callable[[Setting], Sampler | None]

Parameters: TypeAlias = Mapping[str, float | int | str]


@dataclass(frozen=True, eq=False)
class Model:
    """A trained machine, a baseline or a reference, as the tasks of the evaluation ask it.

    Each attribute answers the questions of one task. It is None if the model does not answer them.

    Attributes:
        missing, at_place: scores of T2 and T2-at, missing objects in a scene and at a place.
        suspicion: score of T3, intruders: it takes lists (B, V) and returns the suspicion of each
            listed class (B, V), -inf for other classes. By default `suspicion_of(missing)`.
        flags: outliers that a published model reports.
        relations, completion, false_relations: scores of T1a, T1b and T3b. The batch observes no
            relation, the given triples, or all triples with one false triple.
        misplaced: score of T3c, moved objects.
        lateral: change of the log-odds of left and front in T1 pairs, see `lateral_shift`.
        rooms: log-probabilities of the room types.
        generate: sampler of T4 for a setting.
        scene_model: model for Calibration and for all questions to the service.
        parameters: number of trained weights, or None if this number is not meaningful.
    """

    missing: ObjectScore | None = None
    at_place: PlacedScore | None = None
    suspicion: ObjectScore | None = None
    flags: Flagged | None = None
    relations: RelationScore | None = None
    completion: RelationScore | None = None
    false_relations: RelationScore | None = None
    misplaced: MisplacedScore | None = None
    lateral: float = 0.0
    rooms: RoomScore | None = None
    generate: SamplerOf | None = None
    scene_model: SceneModel | None = None
    parameters: int | None = None

    def __post_init__(self) -> None:
        if self.suspicion is None and self.missing is not None:
            object.__setattr__(self, "suspicion", suspicion_of(self.missing))


def suspicion_of(
    score: ObjectScore, log_popularity: Tensor | None = None, weight: float = 0.0
) -> ObjectScore:
    """Return the suspicion of each listed class: its negated score given the other classes.

    An intruder is often a common class in the wrong room. So the suspicion adds `weight` times the
    log popularity of the class, (V,), as `/outliers` does.
    """

    def suspicion(v: Tensor) -> Tensor:
        row, listed = (v > 0).nonzero(as_tuple=True)
        values = torch.full(v.shape, -torch.inf)
        if len(row):
            others = v[row].scatter(1, listed.unsqueeze(1), 0.0)
            z = score(others).gather(1, listed.unsqueeze(1)).squeeze(1).to(values.dtype)
            prior = 0.0 if log_popularity is None else weight * log_popularity[listed]
            values[row, listed] = prior - z
        return values

    return suspicion
