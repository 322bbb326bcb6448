"""The layout of relation units r.

A relation unit e = (a, i, j) states that object class i has the canonical relation a to class j.
There are A·V² units, which is too many to allocate. Every computation therefore lists the units it
uses. A row of `Edges` belongs to a scene; units outside the row are off.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from torch import Tensor


class Edges(ABC):
    """Relation units, with one row for each scene or one row for all scenes.

    Attributes:
        relation, subject, object: (B or 1, E) int64, the a, i, j of each unit.
        valid: (B or 1, E) bool; False marks padding, and such a unit is off.
    """

    relation: Tensor
    subject: Tensor
    object: Tensor
    valid: Tensor

    @property
    @abstractmethod
    def shape(self) -> torch.Size:
        """Shape of the tensors of units, (B or 1, E)."""

    @property
    @abstractmethod
    def classes(self) -> Tensor:
        """Classes (B or 1, n) int64 from which `BoltzmannMachine.edges` builds these units."""

    @abstractmethod
    def expand(self, rows: int) -> Edges:
        """Return the units of one scene, repeated for `rows` scenes."""

    @abstractmethod
    def ends_present(self, v: Tensor) -> Tensor:
        """Return (..., B, E) floats: 1 where both ends of a unit are present in v (..., B, V)."""


@dataclass(frozen=True)
class TripleEdges(Edges):
    """A table of units that all scenes share; attributes as in `Edges`, (1, E)."""

    relation: Tensor
    subject: Tensor
    object: Tensor
    valid: Tensor

    @property
    def shape(self) -> torch.Size:
        """Shape of the tensors of units, (1, E)."""
        return self.valid.shape

    @property
    def classes(self) -> Tensor:
        """An empty tensor (1, 0), because the table does not depend on the classes of a scene."""
        return self.subject.new_zeros(1, 0)

    def expand(self, rows: int) -> TripleEdges:
        """Return this object, because all scenes share the row."""
        return self

    def ends_present(self, v: Tensor) -> Tensor:
        """Return (..., B, E) floats: 1 where both ends of a unit are present."""
        present: Tensor = v[..., self.subject[0]] * v[..., self.object[0]] * self.valid
        return present


@dataclass(frozen=True)
class PairEdges(Edges):
    """All A·n·m units between n subject classes and m object classes of each scene.

    Units have the layout (A, n, m), flattened, so that shared weights act by small matrix products.
    The indices of single units are computed on first use.

    Attributes:
        relations: number of canonical relations A.
        subjects, objects: (B, n) and (B, m) int64 class indices, 0 where padded.
        valid_subjects, valid_objects: (B, n) and (B, m) bool, False where padded.
        log_subjects, log_objects: (B, n) and (B, m), log of the number of instances of each class.
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
        """Shape of the tensors of units, (B, A·n·m)."""
        (B, n), m = self.subjects.shape, self.objects.shape[1]
        return torch.Size((B, self.relations * n * m))

    @property
    def classes(self) -> Tensor:
        """The subject classes, (B, n), -1 where padded."""
        return torch.where(self.valid_subjects, self.subjects, -1)

    def expand(self, rows: int) -> PairEdges:
        """Return the units of one scene, repeated for `rows` scenes."""
        ends = [getattr(self, field.name) for field in fields(self) if field.name != "relations"]
        return PairEdges(self.relations, *(end.expand(rows, -1) for end in ends))

    @cached_property
    def relation(self) -> Tensor:  # type: ignore[override]
        """The relation a of each unit, (B, E) int64."""
        axis = torch.arange(self.relations, device=self.subjects.device)
        return self._flat(axis[:, None, None])

    @cached_property
    def subject(self) -> Tensor:  # type: ignore[override]
        """The subject class i of each unit, (B, E) int64."""
        return self._flat(self.subjects[:, None, :, None])

    @cached_property
    def object(self) -> Tensor:  # type: ignore[override]
        """The object class j of each unit, (B, E) int64."""
        return self._flat(self.objects[:, None, None, :])

    @cached_property
    def valid(self) -> Tensor:  # type: ignore[override]
        """False where a unit is padding, (B, E) bool."""
        pairs = self.valid_subjects.unsqueeze(-1) & self.valid_objects.unsqueeze(-2)
        return self._flat(pairs.unsqueeze(1))

    def ends_present(self, v: Tensor) -> Tensor:
        """Return (..., B, E) floats: 1 where both ends of a unit are present in v (..., B, V)."""
        lead = v.shape[:-1]
        subject = v.gather(-1, self.subjects.expand(*lead, -1)) * self.valid_subjects
        object_ = v.gather(-1, self.objects.expand(*lead, -1)) * self.valid_objects
        pairs = (subject.unsqueeze(-1) * object_.unsqueeze(-2)).unsqueeze(-3)
        return pairs.expand(*lead, self.relations, -1, -1).flatten(-3)

    def unflatten(self, values: Tensor) -> Tensor:
        """Reshape (..., E) to (..., A, n, m)."""
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
        subjects: (B, n) int64, -1 where padded.
        relations: number of canonical relations A.
        objects: (B, m) int64, -1 where padded; default: the subjects.
        log_subjects, log_objects: log of the instances of each class, shaped like the classes;
            default: one instance each.
    """
    if objects is None:
        objects, log_objects = subjects, log_subjects
    valid_subjects, valid_objects = subjects >= 0, objects >= 0
    subjects, objects = subjects.clamp(min=0), objects.clamp(min=0)
    if log_subjects is None:
        log_subjects = torch.zeros(subjects.shape, device=subjects.device)
    if log_objects is None:
        log_objects = torch.zeros(objects.shape, device=objects.device)
    return PairEdges(
        relations=relations,
        subjects=subjects,
        objects=objects,
        valid_subjects=valid_subjects,
        valid_objects=valid_objects,
        log_subjects=log_subjects,
        log_objects=log_objects,
    )


def triple_edges(triples: Tensor) -> TripleEdges:
    """Return one shared row of units from a (T, 3) table of (a, i, j)."""
    relation, subject, object_ = triples.long().T.unsqueeze(1).unbind(0)
    return TripleEdges(relation, subject, object_, torch.ones_like(subject, dtype=torch.bool))


def triple_keys(relation: Tensor, subject: Tensor, object_: Tensor, classes: int) -> Tensor:
    """Return one int64 key for each unit, ordered as (a, i, j)."""
    return (relation * classes + subject) * classes + object_


def find_triples(table: Tensor, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of each key in a sorted table, and whether the table contains the key."""
    if not table.numel():
        return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
    position = torch.searchsorted(table, keys.contiguous()).clamp(max=table.numel() - 1)
    return position, table[position] == keys


def present_classes(v: Tensor, leading: Tensor | None = None, least: int = 0) -> Tensor:
    """Return the classes present in each row of v, (B, n) int64, padded with -1.

    Args:
        leading: (B, k) present classes that come first, in the given order.
        least: least number of columns n.
    """
    # numpy lists the active units several times faster than torch.
    present = v.detach().cpu().numpy() > 0
    lead = np.zeros((len(v), 0), np.int64) if leading is None else leading.cpu().numpy()
    rows = np.arange(len(v))[:, None]
    if lead.size:
        present[rows, lead] = False
    row, column = present.nonzero()
    counts = present.sum(1)
    width = lead.shape[1] + int(counts.max(initial=0))
    width = max(width, least)
    classes = np.full((len(v), width), -1, dtype=np.int64)
    classes[:, : lead.shape[1]] = lead
    place = np.arange(len(row)) - np.repeat(counts.cumsum() - counts, counts)
    classes[row, lead.shape[1] + place] = column
    return torch.from_numpy(classes).to(v.device)
