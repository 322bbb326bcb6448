"""What every objective offers to the trainer."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from training.batches import Batch
from training.config import ObjectiveConfig
from training.machines import BoltzmannMachine


class Objective(ABC):
    """A loss over batches, with whatever it carries from one update to the next."""

    def __init__(self, config: ObjectiveConfig, machine: BoltzmannMachine) -> None:
        self.config = config

    @abstractmethod
    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """A scalar whose gradient is the update direction."""

    def adjust_gradients(self, machine: BoltzmannMachine) -> None:  # noqa: B027
        """Change the gradients before the update (centring); nothing by default."""

    def parameters(self) -> list[nn.Parameter]:
        """What it learns beside the machine's weights, and leaves out of the machine."""
        return []

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint must keep."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:  # noqa: B027
        """Restore `state()`."""


def withhold_rooms(batch: Batch, share: float, generator: torch.Generator) -> Tensor:
    """Room types of the batch with a share of them withheld, (B,)."""
    hidden = torch.rand(len(batch), generator=generator) < share
    return torch.where(hidden, -1, batch.room)
