"""The last phase of training: the machine's own chains are brought to the data.

Conditional likelihoods make a machine that answers well and dreams badly: scenes half as full
again as real ones. Updates of persistent contrastive divergence with many chains, on
the object part alone, mend that and leave the answers as they were; a term

    anchor · sum (θ - θ_before)²

holds the weights where the answers left them. The chains go on with the averaged weights
afterwards, each under the room type of the scene it began at, and are kept as the machine's
fantasies (see `training.machines.fantasies`).

Source: Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from training.batches import SceneTensors
from training.config import PolishConfig
from training.machines import BoltzmannMachine
from training.machines.bernoulli import bernoulli
from training.machines.fantasies import pack_scenes
from training.machines.gibbs import Clamp, State, initial_state, run
from training.machines.mean_field import Evidence, mean_field

_NAMES = ("b", "c1", "c2", "W", "Q")
_AVERAGING = 0.98
# Sweeps between the last update and the fantasies, with the averaged weights.
_SWEEPS = 50


def polish(
    machine: BoltzmannMachine,
    train: SceneTensors,
    config: PolishConfig,
    room_dropout: float,
    seed: int,
) -> None:
    """Change b, c1, c2, W and Q of a local machine in place, and fill the fantasies.

    Args:
        config: how many updates and chains; none of either does nothing.
        room_dropout: share of chains and scenes whose room type is withheld.
    """
    if not config.updates and not machine.spec.N:
        return
    generator = torch.Generator().manual_seed(seed)

    def scenes(count: int) -> tuple[Tensor, Tensor, Tensor]:
        index = torch.randint(len(train), (count,), generator=generator)
        hidden = torch.rand(count, generator=generator) < room_dropout
        rooms = train.room[index]
        return train.v[index], torch.where(hidden, -1, rooms), rooms

    v, room, every_room = scenes(max(config.chains, machine.spec.N))
    state = _settled(machine, v, room, generator)
    before = {name: machine.get_parameter(name).detach().clone() for name in _NAMES}
    average = {name: value.clone() for name, value in before.items()}
    weights = [machine.get_parameter(name) for name in _NAMES]
    optimiser = torch.optim.Adam(weights, lr=config.learning_rate)
    cycle = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(config.updates, 1))
    for _ in range(config.updates):
        state = run(machine, state, generator, config.k, Clamp(room=room), relations=False)
        data_v, data_room, _ = scenes(len(v))
        with torch.no_grad():
            field = mean_field(machine, Evidence(data_v, room=data_room))
            h2 = bernoulli(field.h2, generator)
        loss = machine.free_energy(data_v, h2=h2, room=data_room).mean()
        loss = loss - machine.free_energy(state.v, h2=state.h2, room=room).mean()
        for name, weight in zip(_NAMES, weights, strict=True):
            loss = loss + config.anchor * ((weight - before[name]) ** 2).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        cycle.step()
        for name, weight in zip(_NAMES, weights, strict=True):
            average[name].lerp_(weight.detach(), 1 - _AVERAGING)
    with torch.no_grad():
        for name, weight in zip(_NAMES, weights, strict=True):
            weight.copy_(average[name])
    if machine.spec.N:
        clamp = Clamp(room=every_room)
        state = run(machine, state, generator, _SWEEPS, clamp, relations=False)
        machine.fantasies.copy_(pack_scenes(state.v[: machine.spec.N]))
        machine.fantasy_rooms.copy_(every_room[: machine.spec.N])


@torch.no_grad()
def _settled(
    machine: BoltzmannMachine, v: Tensor, room: Tensor, generator: torch.Generator
) -> State:
    """Chains at scenes, with the context drawn given them."""
    field = mean_field(machine, Evidence(v, room=room))
    return replace(
        initial_state(machine, v, generator, Clamp(room=room)),
        h1=bernoulli(field.y.sigmoid(), generator),
        h2=bernoulli(field.h2, generator),
    )
