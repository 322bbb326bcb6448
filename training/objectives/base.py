"""What every objective offers to the trainer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from training.batches import Batch, SceneTensors
from training.config import ObjectiveConfig
from training.machines import BoltzmannMachine
from training.machines.edges import Edges

if TYPE_CHECKING:
    from training.trainer import TrainingData


class Objective(ABC):
    """A loss over batches, with whatever it carries from one update to the next."""

    def __init__(
        self, config: ObjectiveConfig, machine: BoltzmannMachine, structure: Tensor | None = None
    ) -> None:
        """Args: structure: (V,) bool, classes such as walls; by default no class is structural."""
        self.config = config
        nothing = torch.zeros(machine.spec.V, dtype=torch.bool)
        self.structure = nothing if structure is None else structure

    # The best epoch is the last: a likelihood under a prior has no early optimum.
    keeps_last = False

    @classmethod
    def of(cls, config: ObjectiveConfig, machine: BoltzmannMachine, data: TrainingData) -> Self:
        """The objective over the scenes of a run."""
        return cls(config, machine, data.structure)

    @abstractmethod
    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """A scalar whose gradient is the update direction."""

    def adjust_gradients(self, machine: BoltzmannMachine) -> None:  # noqa: B027
        """Change the gradients before the update (centring); nothing by default."""

    def parameters(self) -> list[nn.Parameter]:
        """What it learns beside the machine's weights, and leaves out of the machine."""
        return []

    def finish(self, machine: BoltzmannMachine, train: SceneTensors) -> BoltzmannMachine:
        """The machine with its best weights, made ready to be stored.

        Args:
            train: the scenes that the objective was trained on.
        """
        del train
        return machine

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint must keep."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:  # noqa: B027
        """Restore `state()`."""


def withhold_rooms(batch: Batch, share: float, generator: torch.Generator) -> Tensor:
    """Room types of the batch with a share of them withheld, (B,)."""
    hidden = torch.rand(len(batch), generator=generator) < share
    return torch.where(hidden, -1, batch.room)


def withhold_counts(batch: Batch, share: float, generator: torch.Generator) -> Batch:
    """The batch with the numbers of instances unknown in a share of its scenes."""
    if not share:
        return batch
    withheld = torch.rand(len(batch), 1, generator=generator) < share
    return replace(batch, counts=batch.counts.masked_fill(withheld, 0))


def relation_nll(
    machine: BoltzmannMachine,
    edges: Edges,
    logits: Tensor,
    r: Tensor,
    observed: Tensor,
    weight: Tensor,
    h1: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """-sum over units of weight_e log p(r_e | v, h1).

    A machine with implications adds the same of the other units where a random share of the
    observed relations, another one for each scene, is given.

    Args:
        logits, r, observed, weight: (B, E) over `edges`.
        h1: (B, H1), means given the objects.
    """
    nll = bernoulli_nll(logits, r, weight).sum()
    if not machine.spec.G:
        return nll
    share = torch.rand(len(r), 1, generator=generator)
    given = r * observed * (torch.rand(r.shape, generator=generator) < share)
    shifted = logits + machine.implied(edges, given, h1)
    return nll + bernoulli_nll(shifted, r, weight * (1 - given)).sum()


def bernoulli_nll(logits: Tensor, r: Tensor, weight: Tensor) -> Tensor:
    """-weight log p(r) of each unit."""
    return (softplus(logits) - r * logits) * weight
