"""The layout of the relation units r of a machine.

A relation unit e = (a, i, j) is 1 if object class i has the canonical relation a to object class j.
With A relations and V classes there are A·V² units, too many to allocate. Every computation
therefore lists its units in an `Edges` object, which has one row for each scene. Units that the row
of a scene does not list are 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Edges:
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

    def ends_present(self, v: Tensor) -> Tensor:
        """Return 1 where both classes of a unit are present in v, else 0, (..., scenes, units)."""
        lead = v.shape[:-1]
        subject, object_ = (v.gather(-1, i.expand(*lead, -1)) for i in (self.subject, self.object))
        return subject * object_ * self.valid


@dataclass(frozen=True)
class PairEdges(Edges):
    """All A·n² units between the n classes of each scene.

    The units of a scene have the flattened layout (relations, subjects, objects). With this layout,
    shared weights need only small matrix products.

    Attributes:
        classes: class indices, (scenes, n) int64. Padding is 0.
        log_counts: log of the number of instances of each class, (scenes, n).
    """

    classes: Tensor
    log_counts: Tensor

    def unflatten(self, values: Tensor) -> Tensor:
        """Reshape the units of `values` (..., units) to (..., relations, subjects, objects)."""
        n = self.classes.shape[1]
        return values.reshape(*values.shape[:-1], -1, n, n)


def pair_edges(classes: Tensor, relations: int, log_counts: Tensor | None = None) -> PairEdges:
    """Return the relation units between the given classes.

    Args:
        classes: class indices, (scenes, n) int64. Padding is -1.
        relations: number of canonical relations A.
        log_counts: see `PairEdges`. The default is one instance of each class.
    """
    B, n = classes.shape
    exists, classes = classes >= 0, classes.clamp(min=0)
    subject, object_ = classes[:, None, :, None], classes[:, None, None, :]
    valid = (exists.unsqueeze(-1) & exists.unsqueeze(-2)).unsqueeze(1)
    relation = torch.arange(relations)[:, None, None]
    relation, subject, object_, valid = (
        values.expand(B, relations, n, n).flatten(1)
        for values in (relation, subject, object_, valid)
    )
    log_counts = torch.zeros(B, n) if log_counts is None else log_counts
    return PairEdges(relation, subject, object_, valid, classes, log_counts)


def triple_edges(triples: Tensor) -> Edges:
    """Return the units of a table of triples (a, i, j), (triples, 3), which apply to all scenes."""
    relation, subject, object_ = triples.long().T.unsqueeze(1).unbind(0)
    return Edges(relation, subject, object_, torch.ones_like(subject, dtype=torch.bool))


def triple_keys(relation: Tensor, subject: Tensor, object_: Tensor, classes: int) -> Tensor:
    """Return one int64 key for each unit. The keys have the same order as the triples (a, i, j)."""
    return (relation * classes + subject) * classes + object_


def find_triples(table: Tensor, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of each key in a sorted table, and True where the table has the key."""
    if not table.numel():
        return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
    position = torch.searchsorted(table, keys.contiguous()).clamp(max=table.numel() - 1)
    return position, table[position] == keys
