"""Which relation units are in play: the layout of r.

A relation unit e = (a, i, j) says that object class i stands in canonical relation a to class j.
There are A·V² of them, far too many to allocate, so every computation names the ones it speaks of.
A row of `Edges` belongs to a scene; a unit outside the row is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Edges:
    """Relation units, one row a scene (a single row is shared by all scenes).

    Attributes:
        relation, subject, object: (B or 1, E) int64, the a, i, j of each unit.
        valid: (B or 1, E) bool; padding is False and such a unit is off.
    """

    relation: Tensor
    subject: Tensor
    object: Tensor
    valid: Tensor

    @property
    def shape(self) -> torch.Size:
        """(B or 1, E)."""
        return self.valid.shape

    def ends_present(self, v: Tensor) -> Tensor:
        """(..., B, E) float: 1 where both ends of a unit are present in v (..., B, V)."""
        shape = (*v.shape[:-1], self.valid.shape[-1])
        subject = v.gather(-1, self.subject.expand(shape))
        object_ = v.gather(-1, self.object.expand(shape))
        present: Tensor = subject * object_ * self.valid
        return present


@dataclass(frozen=True)
class PairEdges(Edges):
    """All A·n·m units between n subject classes and m object classes of each scene.

    Units are laid out as (A, n, m), flattened, so that shared weights act by small matrix products.

    Attributes:
        subjects, objects: (B, n) and (B, m) int64, class indices (0 where padded).
        valid_subjects: (B, n) bool, False where padded.
        log_subjects, log_objects: (B, n) and (B, m), log of the number of instances of each class.
    """

    subjects: Tensor
    objects: Tensor
    valid_subjects: Tensor
    log_subjects: Tensor
    log_objects: Tensor
    relations: int

    def unflatten(self, values: Tensor) -> Tensor:
        """(..., E) to (..., A, n, m)."""
        shape = (self.relations, self.subjects.shape[-1], self.objects.shape[-1])
        return values.reshape(*values.shape[:-1], *shape)


def pair_edges(
    subjects: Tensor,
    relations: int,
    *,
    objects: Tensor | None = None,
    log_subjects: Tensor | None = None,
    log_objects: Tensor | None = None,
) -> PairEdges:
    """The relation units between given classes.

    Args:
        subjects: (B, n) int64, -1 where padded.
        relations: A.
        objects: (B, m) int64, -1 where padded; the subjects unless given.
        log_subjects, log_objects: log of the instances per class, shaped as the classes; omitted
            means one instance each.
    """
    if objects is None:
        objects, log_objects = subjects, log_subjects
    valid = (subjects >= 0)[:, :, None] & (objects >= 0)[:, None, :]
    shape = (len(subjects), relations, *valid.shape[1:])
    axis = torch.arange(relations, device=subjects.device)[:, None, None]
    present = subjects >= 0
    subjects, objects = subjects.clamp(min=0), objects.clamp(min=0)
    if log_subjects is None:
        log_subjects = torch.zeros(subjects.shape, device=subjects.device)
    if log_objects is None:
        log_objects = torch.zeros(objects.shape, device=objects.device)
    return PairEdges(
        relation=axis.expand(shape).flatten(1),
        subject=subjects[:, None, :, None].expand(shape).flatten(1),
        object=objects[:, None, None, :].expand(shape).flatten(1),
        valid=valid[:, None].expand(shape).flatten(1),
        subjects=subjects,
        objects=objects,
        valid_subjects=present,
        log_subjects=log_subjects,
        log_objects=log_objects,
        relations=relations,
    )


def triple_edges(triples: Tensor) -> Edges:
    """One shared row of units from a (T, 3) table of (a, i, j)."""
    relation, subject, object_ = triples.long().T.unsqueeze(1).unbind(0)
    return Edges(relation, subject, object_, torch.ones_like(subject, dtype=torch.bool))


def triple_keys(relation: Tensor, subject: Tensor, object_: Tensor, classes: int) -> Tensor:
    """One int64 key per unit, ordered as (a, i, j)."""
    return (relation * classes + subject) * classes + object_


def find_triples(table: Tensor, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Positions of keys in a sorted table of keys, and whether each is there."""
    if not table.numel():
        return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
    position = torch.searchsorted(table, keys.contiguous()).clamp(max=table.numel() - 1)
    return position, table[position] == keys
