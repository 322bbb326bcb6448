"""The fantasies that a trained machine keeps: states of its own chains, after the last update."""

from __future__ import annotations

from dataclasses import replace

import torch

from app.boltzmann import BoltzmannMachine
from app.boltzmann.bernoulli import bernoulli
from app.boltzmann.fantasies import pack_scenes
from app.boltzmann.gibbs import gibbs_step, initial_state
from app.boltzmann.mean_field import Evidence, mean_field
from training.batches import SceneTensors

# Chains begin at training scenes, so that every kind of room is among them, and leave them.
_SWEEPS = 100


@torch.no_grad()
def dream(machine: BoltzmannMachine, train: SceneTensors, seed: int) -> None:
    """Fill `machine.fantasies` by `_SWEEPS` Gibbs sweeps of as many chains.

    Raises:
        ValueError: in the seed form, where chains cannot leave relations out.
    """
    count = machine.spec.N
    if not count:
        return
    if machine.spec.form != "local":
        raise ValueError("fantasies are kept by machines of the local form")
    generator = torch.Generator().manual_seed(seed)
    begin = torch.randint(len(train), (count,), generator=generator)
    v = train.v[begin].to(machine.b.dtype)
    field = mean_field(machine, Evidence(v))
    state = replace(
        initial_state(machine, v, generator),
        h1=bernoulli(field.y.sigmoid(), generator),
        h2=bernoulli(field.h2, generator),
    )
    for _ in range(_SWEEPS):
        state = gibbs_step(machine, state, generator, relations=False)
    machine.fantasies.copy_(pack_scenes(state.v))
