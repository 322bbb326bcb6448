"""Scenes drawn from a machine, many chains at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from app.boltzmann import BoltzmannMachine, Triway
from app.boltzmann.edges import PairEdges
from app.boltzmann.fantasies import Fantasies
from app.boltzmann.gibbs import Clamp, State, present_classes
from app.reasoning.chains import sweep
from app.reasoning.generate import STEPS
from training.evaluation.generation import Contradictions, Drawn, Sampler
from training.evaluation.relations import spread_units

_CHAINS = 256


def machine_sampler(machine: BoltzmannMachine, *, steps: int = STEPS) -> Sampler:
    """Gibbs chains as the service runs them, but with relations as the machine draws them.

    The service keeps one of a(x, y) and a(y, x); here both may be on.

    Args:
        steps: sweeps of a chain.
    """
    fantasies = Fantasies(machine)

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:
        generator = torch.Generator().manual_seed(seed)
        parts = []
        for index in torch.arange(len(given)).split(_CHAINS):
            clamp = Clamp(v=given[index], room=room[index] if machine.spec.C else None)
            state = fantasies.start(given[index].to(machine.b.dtype), generator, clamp)
            state = sweep(machine, state, generator, clamp, steps)
            parts.append((state.v, Contradictions.of(_grid(machine, state))))
        objects, found = zip(*parts, strict=True)
        return Drawn(torch.cat(objects), Contradictions.joined(found))

    return sample


def _grid(machine: BoltzmannMachine, state: State) -> Tensor:
    """Relations between present classes, (B, A, n, n)."""
    if isinstance(machine, Triway) and isinstance(state.edges, PairEdges):
        return state.edges.unflatten(state.r * state.edges.ends_present(state.v))
    return spread_units(machine, present_classes(state.v), state.r).clamp(min=0)
