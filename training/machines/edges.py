"""The layout of the relation units r of a machine.

A relation unit e = (a, i, j) is 1 if object class i has the canonical relation a to object class j.
With A relations and V classes there are A·V² units, too many to allocate. Every computation
therefore lists its units in an `Edges` object, which has one row for each scene. Units that the row
of a scene does not list are 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


class Edges(ABC):
    """The relation units of some scenes.

    Attributes:
        relation, subject, object: indices a, i and j of each unit, (scenes or 1, units) int64. A
            single row applies to all scenes.
        valid: bool, (scenes or 1, units). False marks padding. Padded units are 0.
    """

    relation: Tensor
    subject: Tensor
    object: Tensor
    valid: Tensor

    @property
    @abstractmethod
    def shape(self) -> torch.Size:
        """Shape of tensors with one value for each unit, (scenes or 1, units)."""

    @abstractmethod
    def ends_present(self, v: Tensor) -> Tensor:
        """Return 1 where both classes of a unit are present in v, else 0, (..., scenes, units)."""


@dataclass(frozen=True)
class TripleEdges(Edges):
    """A fixed table of relation units for all scenes. Tensors have the shape (1, units)."""

    relation: Tensor
    subject: Tensor
    object: Tensor
    valid: Tensor

    @property
    def shape(self) -> torch.Size:
        return self.valid.shape

    def ends_present(self, v: Tensor) -> Tensor:
        present: Tensor = v[..., self.subject[0]] * v[..., self.object[0]] * self.valid
        return present


@dataclass(frozen=True)
class PairEdges(Edges):
    """All A·n·m units between n subject classes and m object classes of each scene.

    The units of a scene have the flattened layout (relations, subjects, objects). With this layout,
    shared weights need only small matrix products.

    Attributes:
        relations: number of canonical relations A.
        subjects, objects: class indices, (scenes, n) and (scenes, m) int64. Padding is 0.
        valid_subjects, valid_objects: bool, shaped like the classes. False marks padding.
        log_subjects, log_objects: log of the number of instances, shaped like the classes.
    """

    relations: int
    subjects: Tensor
    objects: Tensor
    valid_subjects: Tensor
    valid_objects: Tensor
    log_subjects: Tensor
    log_objects: Tensor

    @property
    def shape(self) -> torch.Size:
        (B, n), m = self.subjects.shape, self.objects.shape[1]
        return torch.Size((B, self.relations * n * m))

    @cached_property
    def relation(self) -> Tensor:  # type: ignore[override]
        axis = torch.arange(self.relations, device=self.subjects.device)
        return self._flat(axis[:, None, None])

    @cached_property
    def subject(self) -> Tensor:  # type: ignore[override]
        return self._flat(self.subjects[:, None, :, None])

    @cached_property
    def object(self) -> Tensor:  # type: ignore[override]
        return self._flat(self.objects[:, None, None, :])

    @cached_property
    def valid(self) -> Tensor:  # type: ignore[override]
        pairs = self.valid_subjects.unsqueeze(-1) & self.valid_objects.unsqueeze(-2)
        return self._flat(pairs.unsqueeze(1))

    def ends_present(self, v: Tensor) -> Tensor:
        lead = v.shape[:-1]
        subject = v.gather(-1, self.subjects.expand(*lead, -1)) * self.valid_subjects
        object_ = v.gather(-1, self.objects.expand(*lead, -1)) * self.valid_objects
        pairs = (subject.unsqueeze(-1) * object_.unsqueeze(-2)).unsqueeze(-3)
        return pairs.expand(*lead, self.relations, -1, -1).flatten(-3)

    def unflatten(self, values: Tensor) -> Tensor:
        """Reshape the units of `values` (..., units) to (..., relations, subjects, objects)."""
        shape = (self.relations, self.subjects.shape[-1], self.objects.shape[-1])
        return values.reshape(*values.shape[:-1], *shape)

    def _flat(self, values: Tensor) -> Tensor:
        (B, n), m = self.subjects.shape, self.objects.shape[1]
        return values.expand(B, self.relations, n, m).flatten(1)


def pair_edges(
    subjects: Tensor,
    relations: int,
    *,
    objects: Tensor | None = None,
    log_subjects: Tensor | None = None,
    log_objects: Tensor | None = None,
) -> PairEdges:
    """Return the relation units between the given classes.

    Args:
        subjects, objects: class indices, (scenes, n) and (scenes, m) int64. Padding is -1. The
            default of the objects is `subjects`.
        relations: number of canonical relations A.
        log_subjects, log_objects: log of the number of instances of each class, shaped like the
            classes. The default is one instance of each class.
    """
    if objects is None:
        objects, log_objects = subjects, log_subjects
    valid_subjects, valid_objects = subjects >= 0, objects >= 0
    subjects, objects = subjects.clamp(min=0), objects.clamp(min=0)
    if log_subjects is None:
        log_subjects = torch.zeros(subjects.shape, device=subjects.device)
    if log_objects is None:
        log_objects = torch.zeros(objects.shape, device=objects.device)
    ends = subjects, objects, valid_subjects, valid_objects, log_subjects, log_objects
    return PairEdges(relations, *ends)


def triple_edges(triples: Tensor) -> TripleEdges:
    """Return the units of a table of triples (a, i, j), (triples, 3), which apply to all scenes."""
    relation, subject, object_ = triples.long().T.unsqueeze(1).unbind(0)
    return TripleEdges(relation, subject, object_, torch.ones_like(subject, dtype=torch.bool))


def triple_keys(relation: Tensor, subject: Tensor, object_: Tensor, classes: int) -> Tensor:
    """Return one int64 key for each unit. The keys have the same order as the triples (a, i, j)."""
    return (relation * classes + subject) * classes + object_


def find_triples(table: Tensor, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of each key in a sorted table, and True where the table has the key."""
    if not table.numel():
        return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
    position = torch.searchsorted(table, keys.contiguous()).clamp(max=table.numel() - 1)
    return position, table[position] == keys
