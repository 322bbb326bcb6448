"""Scenes drawn from a machine, many chains at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from app.questions.generate import STEPS
from training.evaluation.generation import Contradictions, Drawn, Sampler
from training.machines import BoltzmannMachine
from training.machines.chain_samples import ChainSamples
from training.machines.edges import present_classes
from training.machines.gibbs import Clamp, State, gibbs_step, run

_CHAINS = 256


def machine_sampler(machine: BoltzmannMachine, *, steps: int = STEPS) -> Sampler:
    """Gibbs chains as the service runs them, but with relations as the machine draws them.

    The service keeps one of a(x, y) and a(y, x); here both may be on.

    Args:
        steps: sweeps of a chain.
    """
    samples = ChainSamples(machine)

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:
        generator = torch.Generator().manual_seed(seed)
        parts = []
        for index in torch.arange(len(given)).split(_CHAINS):
            clamp = Clamp(v=given[index], room=room[index] if machine.spec.C else None)
            state = samples.start(given[index].to(machine.b.dtype), generator, clamp)
            state = _sweep(machine, state, generator, clamp, steps)
            parts.append((state.v, Contradictions.of(_grid(machine, state))))
        objects, found = zip(*parts, strict=True)
        return Drawn(torch.cat(objects), Contradictions.joined(found))

    return sample


def _sweep(
    machine: BoltzmannMachine, state: State, generator: torch.Generator, clamp: Clamp, steps: int
) -> State:
    """Gibbs sweeps. In the local form relations do not act on the rest: the last one draws them."""
    always = machine.relations_act
    state = run(machine, state, generator, steps - 1, clamp, relations=always)
    return gibbs_step(machine, state, generator, clamp)


def _grid(machine: BoltzmannMachine, state: State) -> Tensor:
    """Relations between present classes, (B, A, n, n)."""
    r = state.r * state.edges.ends_present(state.v)
    return machine.between(state.edges, r, present_classes(state.v)).clamp(min=0)
