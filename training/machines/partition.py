"""Estimates of the log-partition function log Z by annealed importance sampling (AIS).

AIS moves chains from independent objects (beta = 0) to the machine (beta = 1). At beta, all weights
of the machine are multiplied by beta, and the log-odds of the independent objects by 1 - beta. At
beta = 0, log Z is exact. The expected log weight is a lower bound: E[log w] ≤ log Z. Relations add
nothing: the sum over the relations of a scene is 1.

Sources: Neal, "Annealed importance sampling" (2001); Salakhutdinov and Murray, "On the quantitative
analysis of deep belief networks" (2008).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import softplus

from training.machines.gibbs import Chains, start_chains, sweep
from training.machines.machine import BoltzmannMachine


@dataclass(frozen=True)
class LogPartition:
    """An estimate of log Z.

    Attributes:
        log_z: log of the mean weight w over chains.
        standard_error: standard error of log_z, by the delta method over chains.
        bound: mean of log w. In expectation, it is a lower bound of log Z.
    """

    log_z: float
    standard_error: float
    bound: float


def base_log_partition(machine: BoltzmannMachine, base: Tensor) -> float:
    """Return the exact log Z at beta = 0, for objects with the log-odds `base`, (classes,)."""
    spec = machine.spec
    hidden = spec.units * math.log(spec.states) + spec.H2 * math.log(2)
    return float(softplus(base).sum()) + hidden


@torch.no_grad()
def ais(
    machine: BoltzmannMachine,
    betas: Sequence[float],
    chains: int,
    generator: torch.Generator,
    base: Tensor,
) -> LogPartition:
    """Run AIS from objects with the log-odds `base`, (classes,).

    The `betas` increase from 0 to 1.
    """
    v = torch.bernoulli(base.sigmoid().expand(chains, -1), generator=generator)
    state = start_chains(machine, v, generator)
    # At beta = 0, the units of the second layer are on with probability 1/2.
    state.h2 = torch.bernoulli(torch.full_like(state.h2, 0.5), generator=generator)
    log_weight = torch.zeros(chains, dtype=torch.float64)
    for warm, cold in pairwise(betas):
        log_weight += _change(machine, state, warm, cold, base)
        sweep(machine, state, generator, beta=cold, base=base)
    mean = float(log_weight.logsumexp(0)) - math.log(chains)
    error = float((log_weight - mean).exp().std()) / math.sqrt(chains)
    exact = base_log_partition(machine, base)
    return LogPartition(exact + mean, error, exact + float(log_weight.mean()))


def _change(
    machine: BoltzmannMachine, state: Chains, before: float, after: float, base: Tensor
) -> Tensor:
    """Return the free energy at beta = `before` minus that at beta = `after`, (chains,)."""

    def free_energy(beta: float) -> Tensor:
        x = machine.c1 + state.v @ machine.W + state.h2 @ machine.J.T
        hidden = machine.log_states(beta * x) + beta * (state.h2 @ machine.c2)
        couplings = machine.couplings
        if couplings is not None:
            hidden = hidden + 0.5 * beta * ((state.v @ couplings) * state.v).sum(-1)
        return -(state.v @ (beta * machine.scene_bias(None)[0] + (1 - beta) * base)) - hidden

    return (free_energy(before) - free_energy(after)).double()
