"""Hidden units given random parts of scenes, for the fit of relations."""

from __future__ import annotations

import torch
from torch import Tensor

from training.datasets.batches import Batch
from training.machines import BoltzmannMachine


@torch.no_grad()
def means_of_parts(machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
    """Return the means of h1 given a random subset of the objects, (scenes, H1).

    A class is listed with a chance that is drawn uniformly for each scene. Half of the scenes list
    their room type.
    """
    chance = torch.rand(len(batch), 1, generator=generator)
    listed = batch.v * (torch.rand(batch.v.shape, generator=generator) < chance)
    has_room = torch.rand(len(batch), generator=generator) < 0.5
    x, _ = machine.context(listed, torch.where(has_room, batch.room, -1))
    return machine.state_means(x)
