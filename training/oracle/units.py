"""Relation units between classes, independent of the layout of the machine.

A Triway machine has a unit for every pair of classes. The RBM and the GBM have units only for the
triples seen in training; all other relations are always off.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from app.inference import relations
from training.machines import BoltzmannMachine
from training.machines.edges import Edges, pair_edges

# A Python float, because tensors do not accept numpy scalars.
NO_UNIT = float(relations.NO_UNIT)


@dataclass(frozen=True)
class Units:
    """The units between n subject classes and m object classes.

    Attributes:
        edges: (1, E) units in the machine's layout.
        place: (A, n, m) int64, the index in `edges` of each unit; or (A, P), see `of_pairs`.
        exists: (A, n, m) bool; where False, `place` is arbitrary.
    """

    edges: Edges
    place: Tensor
    exists: Tensor

    def grid(self, values: Tensor, missing: float) -> Tensor:
        """Return values (..., E) of the units as (..., A, n, m); `missing` if there is no unit."""
        if not values.shape[-1]:
            return values.new_full((*values.shape[:-1], *self.place.shape), missing)
        return torch.where(self.exists, values[..., self.place], missing)

    def of_pairs(self, subjects: Tensor, objects: Tensor) -> Units:
        """Return the units of P pairs of class indices (P,); `grid` then gives (..., A, P)."""
        place, exists = (grid[:, subjects, objects] for grid in (self.place, self.exists))
        return Units(self.edges, place, exists)

    def flat(self, grid: Tensor) -> Tensor:
        """Return values (..., A, n, m) as (..., E).

        Values without a unit are dropped. Units without a value are 0.
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
    """Return the units from subject classes (n,) to object classes (m,).

    Args:
        subject_counts, object_counts: instances of each class; default: one each.
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
    """Return log E[sigmoid(ℓ)] and log E[sigmoid(-ℓ)] over draws.

    Both tails are summed separately, because 1 - p loses precision for p near one.

    Args:
        weight: (M, ...) normalised over M, broadcastable to the logits.
        logits: (M, ...).
    """
    tiny = torch.finfo(logits.dtype).tiny
    on = (weight * logits.sigmoid()).sum(0).clamp(min=tiny).log()
    off = (weight * logits.neg().sigmoid()).sum(0).clamp(min=tiny).log()
    return on, off
