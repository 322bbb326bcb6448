"""A table of the relation units between classes, in one layout for all machines.

A Triway machine has a relation unit for every relation and pair of classes. The RBM and the GBM
have units only for the triples (relation, subject, object) seen in training. Their other relations
are always 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from app.inference import relations
from training.machines import BoltzmannMachine
from training.machines.edges import Edges, pair_edges

# Tensors accept a Python float but no numpy scalar.
NO_UNIT = float(relations.NO_UNIT)


@dataclass(frozen=True)
class Units:
    """The relation units between n subject classes and m object classes.

    Attributes:
        edges: the relation units in the machine's layout, (1, units).
        place: index in `edges` of each relation, (relations, n, m) int64. After `of_pairs`, the
            shape is (relations, pairs).
        exists: True where the machine has a unit for the relation, shaped like `place`. Where
            False, `place` is arbitrary.
    """

    edges: Edges
    place: Tensor
    exists: Tensor

    def grid(self, values: Tensor, missing: float) -> Tensor:
        """Return values of units, (..., units), as a table (..., relations, n, m).

        Relations without a unit have the value `missing`.
        """
        if not values.shape[-1]:
            return values.new_full((*values.shape[:-1], *self.place.shape), missing)
        return torch.where(self.exists, values[..., self.place], missing)

    def of_pairs(self, subjects: Tensor, objects: Tensor) -> Units:
        """Return only the relation units of some pairs of classes.

        The method `grid` of the result returns tables of shape (..., relations, pairs).

        Args:
            subjects, objects: indices into the subject and object classes, (pairs,).
        """
        place, exists = (grid[:, subjects, objects] for grid in (self.place, self.exists))
        return Units(self.edges, place, exists)

    def flat(self, grid: Tensor) -> Tensor:
        """Return a table of values, (..., relations, n, m), as values of units, (..., units).

        Values of relations without a unit are left out. Units outside the table have the value 0.
        """
        values = grid.new_zeros(*grid.shape[:-3], self.edges.shape[-1])
        values[..., self.place[self.exists]] = grid[..., self.exists]
        return values


def units_between(
    machine: BoltzmannMachine,
    subjects: Tensor,
    objects: Tensor,
    subject_counts: Tensor | None = None,
    object_counts: Tensor | None = None,
) -> Units:
    """Return the relation units from subject classes, (n,), to object classes, (m,).

    Args:
        subject_counts, object_counts: number of instances of each class. The default is one
            instance of each class.
    """
    A = machine.spec.A
    pairs = pair_edges(
        subjects.unsqueeze(0),
        A,
        objects=objects.unsqueeze(0),
        log_subjects=_logs(machine, subjects, subject_counts),
        log_objects=_logs(machine, objects, object_counts),
    )
    edges, place, exists = machine.places(pairs)
    shape = (A, len(subjects), len(objects))
    return Units(edges, place.view(shape), exists.view(shape))


def _logs(machine: BoltzmannMachine, classes: Tensor, counts: Tensor | None) -> Tensor:
    if counts is None:
        return torch.zeros(1, len(classes), dtype=machine.b.dtype)
    return counts.to(machine.b.dtype).log().unsqueeze(0)


def mean_log_p(weight: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
    """Return log E[sigmoid(ℓ)] and log E[sigmoid(-ℓ)], where E is the weighted mean over draws.

    The two means are computed separately, because 1 - p loses precision for p near 1.

    Args:
        weight: log-weights of the draws, (draws, ...), broadcastable to `logits`.
        logits: logits ℓ of relations, (draws, ...).
    """
    tiny = torch.finfo(logits.dtype).tiny
    on = (weight * logits.sigmoid()).sum(0).clamp(min=tiny).log()
    off = (weight * logits.neg().sigmoid()).sum(0).clamp(min=tiny).log()
    return on, off
