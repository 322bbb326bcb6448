"""Encoded scenes as tensors. A training objective reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app.model import Possibility
from app.scene import CANONICAL, RoleCounts, Vocabulary
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask, Table
from training.datasets.encoding import ClassEvidence
from training.machines.edges import SceneRelations

_BLOCK = 1024


@dataclass(frozen=True)
class Batch(SceneRelations, Table):
    """A batch of scenes as tensors. n is the largest number of classes of a scene."""

    v: Float[Tensor, "B V"]  # presence of each class
    room: Int[Tensor, "B"]  # room type; -1 means unknown
    source: Int[Tensor, "B"]  # index in `SceneTensors.source_names`


@dataclass(frozen=True)
class SceneTensors:
    """A set of B scenes as tensors. `batch` returns some of the scenes."""

    scenes: Sequence[EncodedScene]
    v: Float[Tensor, "B V"]  # presence of each class
    room: Int[Tensor, "B"]  # room type; -1 means unknown
    source: Int[Tensor, "B"]  # index in annotated_classes and source_names
    annotated_classes: Bool[Tensor, "sources V"]  # classes that a data source mentions
    related: Float[Tensor, "V V"]  # classes of one family; see `Vocabulary.related`
    source_names: tuple[str, ...] = ()  # sorted

    def relatives_of(self, v: Float[Tensor, "N V"]) -> Bool[Tensor, "N V"]:
        """Return the classes that are in one family with a class of v."""
        return torch.cat([rows @ self.related > 0 for rows in v.split(_BLOCK)])

    @cached_property
    def weight(self) -> Float[Tensor, "B"]:
        """Weight of each scene in the training of objects."""
        return torch.tensor([scene.weight for scene in self.scenes], dtype=torch.float32)

    @cached_property
    def complete(self) -> Bool[Tensor, "B"]:
        """True if the object list of the scene is nearly complete."""
        return torch.tensor([scene.complete for scene in self.scenes], dtype=torch.bool)

    @property
    def group_ids(self) -> Int[NDArray, "B"]:
        """Id of the group of each scene. Data sources can share a group."""
        return np.array([crc32(scene.group.encode()) for scene in self.scenes], dtype=np.int64)

    def __len__(self) -> int:
        return len(self.scenes)

    def batch(
        self,
        index: Int[Tensor, "N"],
        part: Callable[[ClassEvidence], ClassEvidence] = lambda whole: whole,
    ) -> Batch:
        """Return the scenes at the indices, with `part` of their evidence. v has all classes."""
        evidence = [part(self.scenes[k].evidence) for k in index.tolist()]
        n = max((len(e.classes) for e in evidence), default=0)
        relations = self.scenes[0].evidence.holds.shape[0] if self.scenes else 0
        shape = (len(evidence), relations, n, n)
        classes, counts = np.full(shape[::3], -1), np.ones(shape[::3], dtype=np.int64)
        holds, observed = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.bool_)
        for row, e in enumerate(evidence):
            m = len(e.classes)  # the rest of the row is padding
            classes[row, :m], counts[row, :m] = e.classes, e.counts
            holds[row, :, :m, :m], observed[row, :, :m, :m] = e.holds, e.observed
        tables = map(torch.from_numpy, (classes, counts, holds, observed))
        return Batch(*(*tables, self.v[index], self.room[index], self.source[index]))


def scene_tensors(
    scenes: Sequence[EncodedScene], annotated: dict[str, ClassMask], vocabulary: Vocabulary
) -> SceneTensors:
    """Return encoded scenes as tensors. `annotated` has the classes of each source."""
    names = sorted(annotated)
    v = torch.zeros(len(scenes), len(vocabulary))
    for row, scene in enumerate(scenes):
        v[row, torch.from_numpy(scene.evidence.classes)] = 1.0
    return SceneTensors(
        scenes=scenes,
        v=v,
        room=torch.tensor([scene.room_type for scene in scenes], dtype=torch.int64),
        source=torch.tensor([names.index(scene.source) for scene in scenes], dtype=torch.int64),
        annotated_classes=torch.from_numpy(np.stack([annotated[name] for name in names])),
        related=torch.from_numpy(vocabulary.related.astype(np.float32)),
        source_names=tuple(names),
    )


def subset(scenes: SceneTensors, index: Tensor) -> SceneTensors:
    """Return the scenes at the given indices, or the scenes where a mask is True."""
    if index.dtype == torch.bool:
        index = index.nonzero().squeeze(1)
    return replace(
        scenes,
        scenes=[scenes.scenes[k] for k in index.tolist()],
        v=scenes.v[index],
        room=scenes.room[index],
        source=scenes.source[index],
    )


def seen_triples(scenes: Sequence[EncodedScene], V: int, minimum: int = 1) -> Int[Tensor, "T 3"]:
    """Return the sorted triples (relation, subject, object) of `minimum` or more scenes."""
    shape, keys = (len(CANONICAL), V, V), [np.zeros(0, dtype=np.int64)]
    for evidence in (scene.evidence for scene in scenes):
        relation, subject, other = evidence.holds.nonzero()
        triples = relation, evidence.classes[subject], evidence.classes[other]
        keys.append(np.ravel_multi_index(triples, shape))
    values, counts = np.unique(np.concatenate(keys), return_counts=True)
    table = np.stack(np.unravel_index(values[counts >= minimum], shape), axis=1)
    return torch.from_numpy(table).to(torch.int32)


@dataclass(frozen=True)
class TrainingData:
    """Scenes of the train, validation and test part, with their classes and room types."""

    train: SceneTensors
    validation: SceneTensors
    test: SceneTensors
    structure: Bool[Tensor, "V"]  # True for structural classes
    vocabulary: Vocabulary
    digest: str = ""  # of the scenes, their vocabulary and split
    words: Float[Tensor, "V D"] | None = None  # unit word vectors of the classes, 0 where unknown
    roles: RoleCounts | None = None  # of the classes in the training scenes
    possibility: Possibility | None = None  # of the classes

    @property
    def parents(self) -> Int[Tensor, "V"]:
        """Index of the parent of each class, -1 without a parent."""
        return torch.from_numpy(self.vocabulary.parents.copy())

    @property
    def related(self) -> bool:
        """True if training and validation scenes contain annotated relations."""
        return has_relations(self.train) and has_relations(self.validation)


def has_relations(scenes: SceneTensors) -> bool:
    """Return True if any of the scenes has an annotated relation."""
    return any(scene.evidence.holds.any() for scene in scenes.scenes)
