"""Blocks of Gibbs chains with a scene clamped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from app.boltzmann import BoltzmannMachine
from app.boltzmann.gibbs import Clamp, State, initial_state, linear_schedule, run
from app.reasoning.evidence import Observation

CHAINS = 8
"""Chains of a block: one random stream and one matrix product for all of them."""

# The first half of the sweeps cools down from so many times the temperature, in so many stairs: a
# machine of its own for every sweep would cost as much as the sweep.
_HOTTEST = 2.0
_STAIRS = 10

Stairs = list[tuple[BoltzmannMachine, int]]


def cooling(machine: BoltzmannMachine, steps: int, temperature: float) -> Stairs:
    """(tempered machine, sweeps) of each stair, the last one at the temperature itself."""
    annealed = steps // 2
    stairs = min(_STAIRS, annealed)
    heats = linear_schedule(stairs + 1, _HOTTEST * temperature, temperature)[:-1]
    sweeps = [annealed * (k + 1) // stairs - annealed * k // stairs for k in range(stairs)]
    return [
        (machine if heat == 1 else machine.scaled(1 / heat), count)
        for heat, count in zip([*heats, temperature], [*sweeps, steps - annealed], strict=True)
    ]


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


def run_block(observation: Observation, clamp: Clamp, stairs: Stairs, seed: int) -> State:
    """The state of a block of chains at the foot of the stairs, from nothing but the evidence."""
    generator = torch.Generator().manual_seed(seed)
    machine, _ = stairs[0]
    v = observation.present.to(machine.b.dtype).repeat(CHAINS, 1)
    state = initial_state(machine, v, generator, clamp)
    if clamp.h1 is not None and clamp.h2 is not None:
        h1, h2 = torch.where(clamp.h1, 1.0, state.h1), torch.where(clamp.h2, 1.0, state.h2)
        state = replace(state, h1=h1, h2=h2)
    # In the local form relations do not act on the rest: the last sweep alone draws them.
    always = machine.spec.form == "seed"
    for machine, sweeps in stairs[:-1]:
        state = run(machine, state, generator, [1.0] * sweeps, clamp, relations=always)
    machine, sweeps = stairs[-1]
    state = run(machine, state, generator, [1.0] * (sweeps - 1), clamp, relations=always)
    return run(machine, state, generator, [1.0], clamp)
