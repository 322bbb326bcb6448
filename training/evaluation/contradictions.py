"""Contradictions between the relations of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from app.scene import CANONICAL
from training.evaluation.metrics import Metric, Ratio

_ON_TOP = CANONICAL.index("on-top")


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Counts of contradictory relations between different classes.

    Attributes:
        related: (scenes,) number of pairs of classes with a relation in at least one direction,
            summed over the canonical relations.
        mirrored: (scenes,) number of pairs of classes with a relation in both directions, summed
            over the canonical relations.
        stacked: (scenes,) bool, True if the scene has an on-top relation.
        cyclic: (scenes,) bool, True if the on-top relations of the scene form a cycle.
    """

    related: Tensor
    mirrored: Tensor
    stacked: Tensor
    cyclic: Tensor

    @classmethod
    def of(cls, holds: Tensor) -> Contradictions:
        """Count the contradictions of relations (scenes, relations, classes, classes)."""
        n = holds.shape[-1]
        on = (holds > 0) & ~torch.eye(n, dtype=torch.bool)
        upper = torch.ones(n, n, dtype=torch.bool).triu(1)
        both, either = on & on.mT & upper, (on | on.mT) & upper
        if holds.shape[1] > _ON_TOP and n:
            stacks = on[:, _ON_TOP]
        else:
            stacks = torch.zeros(len(holds), 1, 1, dtype=torch.bool)
        return cls(
            either.flatten(1).sum(1),
            both.flatten(1).sum(1),
            stacks.flatten(1).any(1),
            transitive_closure(stacks).diagonal(dim1=-2, dim2=-1).any(1),
        )

    @classmethod
    def joined(cls, parts: Sequence[Contradictions]) -> Contradictions:
        """Concatenate the scenes of all parts."""
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def at(self, index: Tensor) -> Contradictions:
        """Select the scenes at the given indices."""
        return Contradictions(*(getattr(self, f.name)[index] for f in fields(self)))

    def metrics(self) -> dict[str, Metric]:
        """Return the share of mirrored relations and the share of scenes with an on-top cycle.

        A share is left out if no scene has a relation for it.
        """
        shares = {
            "mirrored relations": (self.mirrored, self.related),
            "on-top cycles": (self.cyclic, self.stacked),
        }
        return {
            name: Ratio(some.double().numpy(), whole.double().numpy())
            for name, (some, whole) in shares.items()
            if whole.any()
        }


def transitive_closure(given: Tensor) -> Tensor:
    """Return all pairs that a chain of given pairs connects, (..., n, n) bool."""
    reach = given.float()
    while True:
        further = ((reach + reach @ reach) > 0).float()
        if torch.equal(further, reach):
            return reach > 0
        reach = further
