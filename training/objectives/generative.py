"""Persistent chains over objects and context: a generative gradient for the local form.

Relations sum to one there, so the chains run over (v, h1, h2), with h1 summed out of the energy:

    mean F(data, h2) - mean F(chains, h2),   F = -b·v - c2·h2 - sum softplus(c1 + v'W + J h2)

Each chain keeps a room type (or none) drawn from the training scenes, so that both means run over
the same mixture of conditions.

Source: Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008).
"""

from __future__ import annotations

import torch
from torch import Tensor

from training.machines import BoltzmannMachine
from training.machines.bernoulli import bernoulli
from training.machines.gibbs import Clamp, bare_state, initial_state, run
from training.machines.mean_field import Evidence, mean_field


class ObjectChains:
    """Chains that go on between updates.

    Args:
        count: number of chains.
        steps: Gibbs steps an update.
    """

    def __init__(self, count: int, steps: int) -> None:
        self.count, self.steps = count, steps
        self.blocks: dict[str, Tensor] = {}

    def loss(
        self, machine: BoltzmannMachine, v: Tensor, room: Tensor, generator: torch.Generator
    ) -> Tensor:
        """mean F(data) - mean F(chains), after moving the chains.

        Args:
            v, room: (B, V) and (B,), the data.
        """
        with torch.no_grad():
            h2 = bernoulli(mean_field(machine, Evidence(v, room=room)).h2, generator)
            self._advance(machine, v, room, generator)
        chains = self.blocks
        data = machine.free_energy(v, h2=h2, room=room).mean()
        return data - machine.free_energy(chains["v"], h2=chains["h2"], room=chains["room"]).mean()

    def _advance(
        self, machine: BoltzmannMachine, v: Tensor, room: Tensor, generator: torch.Generator
    ) -> None:
        if not self.blocks:
            pick = torch.randint(len(v), (self.count,), generator=generator)
            state = initial_state(machine, v[pick], generator, Clamp(room=room[pick]))
            self.blocks = {"v": state.v, "h1": state.h1, "h2": state.h2, "room": room[pick]}
        clamp = Clamp(room=self.blocks["room"])
        state = bare_state(machine, self.blocks["v"], self.blocks["h1"], self.blocks["h2"])
        state = run(machine, state, generator, self.steps, clamp, relations=False)
        self.blocks |= {"v": state.v, "h1": state.h1, "h2": state.h2}
