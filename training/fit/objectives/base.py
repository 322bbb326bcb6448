"""The interface between objectives and the trainer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from training.datasets.batches import Batch, SceneTensors, TrainingData
from training.fit.configuration import ObjectiveConfig
from training.machines import BoltzmannMachine
from training.machines.bernoulli import uniform
from training.machines.edges import Edges


class Objective(ABC):
    """A training loss over batches of scenes. An objective can keep state between updates."""

    def __init__(
        self, config: ObjectiveConfig, machine: BoltzmannMachine, structure: Tensor | None = None
    ) -> None:
        """Store the settings. Without `structure`, no class is a structure class."""
        self.config = config
        nothing = torch.zeros(machine.spec.V, dtype=torch.bool)
        self.structure = nothing if structure is None else structure.to(machine.b.device)

    # If True, training keeps the weights of the last epoch rather than of the best epoch. An
    # objective with a prior on the weights needs no early stopping.
    keeps_last = False

    @classmethod
    def of(cls, config: ObjectiveConfig, machine: BoltzmannMachine, data: TrainingData) -> Self:
        """Return the objective for the data of a training run."""
        return cls(config, machine, data.structure)

    @abstractmethod
    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return a scalar whose gradient is the update direction.

        In several processes, the losses of the shares of a batch add up to the loss of the batch.
        """

    def adjust_gradients(self, machine: BoltzmannMachine) -> None:  # noqa: B027
        """Change the gradients before the update, for example by centring."""

    def parameters(self) -> list[nn.Parameter]:
        """Return the trained parameters of the objective itself, beside the machine's weights."""
        return []

    def finish(self, machine: BoltzmannMachine, train: SceneTensors) -> BoltzmannMachine:
        """Return the trained machine in the form that the model file stores."""
        del train
        return machine

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint, gathered from all processes."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:  # noqa: B027
        """Restore the state of the objective from a checkpoint."""


def withhold_rooms(batch: Batch, share: float, generator: torch.Generator) -> Tensor:
    """Return the room types of the batch, (B,), with a share of them hidden (-1)."""
    return torch.where(uniform((len(batch),), generator) < share, -1, batch.room)


def withhold_counts(batch: Batch, share: float, generator: torch.Generator) -> Batch:
    """Return the batch with unknown instance counts (0) in a random share of its scenes."""
    if not share:
        return batch
    withheld = uniform((len(batch), 1), generator) < share
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
    """Return the negative log-likelihood of relations, -sum_e weight_e log p(r_e | v, h1).

    For a machine with implication weights, the result includes a second term. That term conditions
    on a random share of the observed relations of each scene and sums over the other relations.

    Args:
        logits, r, observed, weight: tensors over the relation units, (scenes, units).
        h1: means of the hidden units given the objects, (scenes, hidden units).
    """
    nll = bernoulli_nll(logits, r, weight).sum()
    if not machine.spec.G:
        return nll
    share = uniform((len(r), 1), generator)
    condition = r * observed * (uniform(r.shape, generator) < share)
    shifted = logits + machine.implied(edges, condition, h1)
    return nll + bernoulli_nll(shifted, r, weight * (1 - condition)).sum()


def bernoulli_nll(logits: Tensor, r: Tensor, weight: Tensor) -> Tensor:
    """Return the weighted loss -weight log p(r) of each relation unit, shaped like `logits`."""
    return (softplus(logits) - r * logits) * weight
