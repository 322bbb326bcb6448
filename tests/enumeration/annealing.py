"""Estimates of the log-partition function log Z by annealed importance sampling (AIS).

AIS moves chains from independent objects (beta = 0) to the machine (beta = 1). At beta, all weights
of the machine are multiplied by beta, and the log-odds of the independent objects by 1 - beta. At
beta = 0, log Z is exact. The expected log weight is a lower bound: E[log w] ≤ log Z. Relations add
nothing: the sum over the relations of a scene is 1.

Sources: Neal, "Annealed importance sampling" (2001); Salakhutdinov and Murray, "On the quantitative
analysis of deep belief networks" (2008).
"""

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch.nn.functional import softplus

from training.machines.gibbs import start_chains, sweep


class LogPartition(NamedTuple):
    """An estimate: log of the mean weight, its standard error over chains, and mean of log w."""

    log_z: float
    standard_error: float
    bound: float


def base_log_partition(machine, base):
    """The exact log Z at beta = 0, for objects with the log-odds `base`, (classes,)."""
    spec = machine.spec
    hidden = spec.units * math.log(spec.states) + spec.H2 * math.log(2)
    return float(softplus(base).sum()) + hidden


@torch.no_grad()
def ais(machine, betas, chains, generator, base):
    """Run AIS from objects with the log-odds `base`. The `betas` increase from 0 to 1."""
    v = torch.bernoulli(base.sigmoid().expand(chains, -1), generator=generator)
    state = start_chains(machine, v, generator)
    # At beta = 0, the units of the second layer are on with probability 1/2.
    state.h2 = torch.bernoulli(torch.full_like(state.h2, 0.5), generator=generator)
    log_weight = torch.zeros(chains, dtype=torch.float64)
    for warm, cold in pairwise(betas):
        change = free_energy(machine, state, warm, base) - free_energy(machine, state, cold, base)
        log_weight += change.double()
        sweep(machine, state, generator, beta=cold, base=base)
    mean = float(log_weight.logsumexp(0)) - math.log(chains)
    error = float((log_weight - mean).exp().std()) / math.sqrt(chains)
    exact = base_log_partition(machine, base)
    return LogPartition(exact + mean, error, exact + float(log_weight.mean()))


def free_energy(machine, state, beta, base):
    """The free energy of each chain at beta, (chains,)."""
    x = machine.c1 + state.v @ machine.W + state.h2 @ machine.J.T
    hidden = machine.log_states(beta * x) + beta * (state.h2 @ machine.c2)
    if machine.couplings is not None:
        hidden = hidden + 0.5 * beta * ((state.v @ machine.couplings) * state.v).sum(-1)
    return -(state.v @ (beta * machine.scene_bias(None)[0] + (1 - beta) * base)) - hidden
