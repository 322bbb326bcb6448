"""Estimates of the log-partition function log Z by annealed importance sampling (AIS).

AIS moves chains through machines between a base (beta = 0) and the machine (beta = 1), as returned
by `BoltzmannMachine.scaled`. The objects of the base are independent, so its log Z is exact. For
forward runs, the expected log weight is a lower bound: E[log w] ≤ log Z. Reverse runs start from
samples of the machine and give an upper bound.

Sources: Neal, "Annealed importance sampling" (2001); Salakhutdinov and Murray, "On the quantitative
analysis of deep belief networks" (2008); Burda, Grosse and Salakhutdinov, "Accurate and
conservative estimates of MRF log-likelihood using reverse annealing" (2015).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import softplus

from training.machines import build
from training.machines.bernoulli import bernoulli
from training.machines.gibbs import gibbs_step, initial_state
from training.machines.machine import BoltzmannMachine, State


@dataclass(frozen=True)
class LogPartition:
    """An estimate of log Z.

    Attributes:
        log_z: log of the mean weight w over chains in forward runs, and minus the log of the mean
            inverse weight in reverse runs.
        standard_error: standard error of log_z, by the delta method over chains.
        bound: mean of log w. In expectation, it is a lower bound of log Z for forward runs, and an
            upper bound for reverse runs.
    """

    log_z: float
    standard_error: float
    bound: float

    @classmethod
    def of_weights(cls, base: float, log_weight: Tensor, *, reverse: bool = False) -> LogPartition:
        """Return the estimate from the log weights of forward or reverse runs.

        Args:
            base: exact log Z of the base machine (beta = 0).
            log_weight: accumulated log weight of each run, (chains,).
            reverse: True if the runs end at the base machine, False if the runs start there.
        """
        sign, count = (-1 if reverse else 1), len(log_weight)
        mean = float(log_weight.logsumexp(0)) - math.log(count)
        ratio = (log_weight - mean).exp()
        error = float(ratio.std()) / math.sqrt(count) if count > 1 else math.inf
        return cls(base + sign * mean, error, base + sign * float(log_weight.mean()))


def independent_base(machine: BoltzmannMachine, b: Tensor | None = None) -> BoltzmannMachine:
    """Return the base machine at beta = 0, with independent objects of log-odds b, (classes,).

    The relation units of an RBM or GBM keep their bias d. The relation units of a Triway contribute
    a factor of one to Z.
    """
    base = build(machine.spec).to(machine.b.dtype).requires_grad_(False)
    with torch.no_grad():
        base.set_triples(machine.triples)
        base.b.copy_(machine.b if b is None else b)
        base.begin_independent(machine)
    return base


def base_log_partition(machine: BoltzmannMachine, base: BoltzmannMachine) -> float:
    """Return the exact log Z of `base`."""
    log_z = float(softplus(base.b).sum()) + (machine.spec.H1 + machine.spec.H2) * math.log(2)
    return log_z + base.relation_log_partition()


@torch.no_grad()
def ais(
    machine: BoltzmannMachine,
    betas: Sequence[float],
    chains: int,
    generator: torch.Generator,
    base: BoltzmannMachine | None = None,
) -> LogPartition:
    """Run forward AIS through the machines at `betas`, which increase from 0 to 1."""
    _check(betas)
    base = independent_base(machine) if base is None else base
    start = machine.scaled(0.0, base)
    v = bernoulli(base.b.sigmoid().expand(chains, -1), generator)
    state = initial_state(start, v, generator)
    log_weight = torch.zeros(chains, dtype=torch.float64)
    for previous, beta in pairwise(betas):
        cold = machine.scaled(beta, base)
        warm = machine.scaled(previous, base)
        log_weight += (_free_energy(warm, state) - _free_energy(cold, state)).double()
        state = gibbs_step(cold, state, generator)
    return LogPartition.of_weights(base_log_partition(machine, base), log_weight)


@torch.no_grad()
def reverse_ais(
    machine: BoltzmannMachine,
    betas: Sequence[float],
    state: State,
    generator: torch.Generator,
    base: BoltzmannMachine | None = None,
) -> LogPartition:
    """Run reverse AIS from samples of the machine, with `betas` in increasing order as in `ais`."""
    _check(betas)
    base = independent_base(machine) if base is None else base
    log_weight = torch.zeros(len(state.v), dtype=torch.float64)
    for previous, beta in zip(betas[-2::-1], betas[:0:-1], strict=True):
        cold = machine.scaled(beta, base)
        warm = machine.scaled(previous, base)
        state = gibbs_step(cold, state, generator)
        log_weight += (_free_energy(cold, state) - _free_energy(warm, state)).double()
    log_base = base_log_partition(machine, base)
    return LogPartition.of_weights(log_base, log_weight, reverse=True)


def _free_energy(machine: BoltzmannMachine, state: State) -> Tensor:
    h2 = state.h2 if machine.spec.H2 else None
    if not machine.relations_act:
        return machine.free_energy(state.v, h2=h2)
    return machine.free_energy(state.v, state.r, state.edges, h2)


def _check(betas: Sequence[float]) -> None:
    rising = all(x < y for x, y in pairwise(betas))
    if len(betas) < 2 or betas[0] != 0 or betas[-1] != 1 or not rising:
        raise ValueError("betas do not increase strictly from 0 to 1; pass such a sequence")
