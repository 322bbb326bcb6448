"""Scores of a machine in training, for the selection of epochs and settings."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from training.datasets.batches import Batch
from training.evaluation.model import RelationScore
from training.machines import BoltzmannMachine
from training.machines.log_odds import object_log_odds, relation_log_odds
from training.machines.mean_field import Evidence


@dataclass(frozen=True, eq=False)
class MachineScore:
    """The score of a machine: log-odds of each class with all relations unobserved.

    In a seed-form machine, relations affect objects. Such a machine sums the relations out at the
    mean-field fixed point.
    """

    machine: BoltzmannMachine

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return self.machine.parameter_count

    def __call__(self, v: Tensor, room: Tensor | None = None) -> Tensor:
        """Return scores (B, V) for presence (B, V) and optional room types (B,)."""
        evidence = Evidence(v, self.machine.acting_units(v), room=room)
        return object_log_odds(self.machine, evidence)


def relation_score(machine: BoltzmannMachine, *, draws: int = 64) -> RelationScore:
    """Return a score: log-odds of every relation, with all relations unobserved."""

    def score(batch: Batch) -> Tensor:
        edges = machine.edges(batch.classes, batch.counts)
        values, _ = relation_log_odds(machine, edges, Evidence(batch.v, edges), count=draws)
        return machine.between(edges, values, batch.classes)

    return score
