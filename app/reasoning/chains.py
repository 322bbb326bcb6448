"""Blocks of Gibbs chains with a scene clamped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from app.boltzmann import BoltzmannMachine
from app.boltzmann.fantasies import Fantasies
from app.boltzmann.gibbs import Clamp, State, gibbs_step, run
from app.reasoning.evidence import Observation

CHAINS = 8
"""Chains of a block: one random stream and one matrix product for all of them."""


def held_units(
    machine: BoltzmannMachine, context: Mapping[str, Sequence[int]]
) -> tuple[Tensor, Tensor]:
    """Masks (H1,) and (H2,) of the hidden units that are held on.

    Raises:
        ValueError: a layer or a unit that the machine does not have.
    """
    masks = {
        "h1": torch.zeros(machine.spec.H1, dtype=torch.bool),
        "h2": torch.zeros(machine.spec.H2, dtype=torch.bool),
    }
    for layer, units in context.items():
        if layer not in masks or not len(masks[layer]):
            raise ValueError(f"the model has no layer {layer!r}")
        for unit in units:
            if not 0 <= unit < len(masks[layer]):
                raise ValueError(f"unit {unit} of {layer} must be below {len(masks[layer])}")
            masks[layer][unit] = True
    return masks["h1"], masks["h2"]


def clamped(observation: Observation, held: tuple[Tensor, Tensor]) -> Clamp:
    """What stays as it is in a block of chains: present classes, observed relations, held units."""
    evidence, machine = observation.evidence, observation.machine
    clamp = Clamp(
        v=observation.present,
        h1=held[0],
        h2=held[1],
        room=None if evidence.room is None else evidence.room.expand(CHAINS),
    )
    if observation.units is None:
        return clamp
    shape = (CHAINS, int(observation.touched.sum()))
    classes = observation.classes[observation.touched].expand(shape)
    counts = observation.counts[observation.touched].expand(shape)
    edges = machine.edges(classes, counts)
    return replace(clamp, edges=edges, r=evidence.r, observed=evidence.observed)


def run_block(
    fantasies: Fantasies,
    observation: Observation,
    clamp: Clamp,
    machine: BoltzmannMachine,
    steps: int,
    seed: int,
) -> State:
    """The state of a block of chains after some sweeps, started where the evidence is at home.

    Args:
        fantasies: of the observation's machine.
        machine: the same, or the same at another temperature.
    """
    generator = torch.Generator().manual_seed(seed)
    given = observation.present.to(machine.b.dtype).repeat(CHAINS, 1)
    return sweep(machine, fantasies.start(given, generator, clamp), generator, clamp, steps)


def sweep(
    machine: BoltzmannMachine, state: State, generator: torch.Generator, clamp: Clamp, steps: int
) -> State:
    """Gibbs sweeps. In the local form relations do not act on the rest: the last one draws them."""
    always = machine.spec.form == "seed"
    state = run(machine, state, generator, steps - 1, clamp, relations=always)
    return gibbs_step(machine, state, generator, clamp)
