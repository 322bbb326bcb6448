"""Scenes drawn from a machine, many chains at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from app.boltzmann import BoltzmannMachine, Triway
from app.boltzmann.edges import PairEdges
from app.boltzmann.fantasies import start_chains
from app.boltzmann.gibbs import Clamp, State, gibbs_step, present_classes
from app.reasoning.generate import STEPS
from training.evaluation.generation import Drawn, Sampler, mirrored_pairs
from training.evaluation.relations import spread_units

_CHAINS = 256


def machine_sampler(machine: BoltzmannMachine, *, steps: int = STEPS) -> Sampler:
    """Gibbs chains as the service runs them, but with relations as the machine draws them.

    The service keeps one of a(x, y) and a(y, x); here both may be on.

    Args:
        steps: sweeps of a chain.
    """
    # In the local form relations do not act on the rest: the last sweep alone draws them.
    always = machine.spec.form == "seed"

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:
        generator = torch.Generator().manual_seed(seed)
        parts = []
        for index in torch.arange(len(given)).split(_CHAINS):
            clamp = Clamp(v=given[index], room=room[index] if machine.spec.C else None)
            state = start_chains(machine, given[index].to(machine.b.dtype), generator, clamp)
            for last in range(1, steps + 1):
                relations = always or last == steps
                state = gibbs_step(machine, state, generator, clamp, relations=relations)
            parts.append((state.v, *mirrored_pairs(_grid(machine, state))))
        v, related, mirrored = (torch.cat(column) for column in zip(*parts, strict=True))
        return Drawn(v, related, mirrored)

    return sample


def _grid(machine: BoltzmannMachine, state: State) -> Tensor:
    """Relations between present classes, (B, A, n, n)."""
    if isinstance(machine, Triway) and isinstance(state.edges, PairEdges):
        return state.edges.unflatten(state.r * state.edges.ends_present(state.v))
    return spread_units(machine, present_classes(state.v), state.r).clamp(min=0)
