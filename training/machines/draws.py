"""Estimate the posterior of the hidden units h1 by self-normalised importance sampling.

The samples serve all answers that have no closed form. The proposal distribution q is the factorial
mean-field approximation of the posterior p(h1 | evidence). A sample h has the importance weight w:

    log w = h·x + sum_e term_e(ℓ_e(h)) - log q(h),   x = c1 + v'W + J h2.

`BoltzmannMachine.relation_term` computes term_e from the logit ℓ_e of relation unit e. The argument
`pull` is an exponent on the likelihood of the observed relations. An exponent below 1 reduces the
influence of these relations. An expectation over p(h1 | evidence) is the weighted mean over the
samples. The uniform numbers are a fixed, scrambled Sobol sequence, so equal evidence always gives
the same answer. With two hidden layers, h2 stays at its mean-field value.

The method is Rao–Blackwellised: only h1 is sampled, and unobserved relations are summed out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from training.machines.edges import Edges
from training.machines.machine import BoltzmannMachine
from training.machines.mean_field import Evidence, MeanField, mean_field


@dataclass(frozen=True)
class HiddenDraws:
    """Weighted samples ("draws") of the first hidden layer h1.

    Attributes:
        h1: binary samples, (draws, scenes, hidden units).
        log_weight: log importance weights, (draws, scenes). The weights of a scene sum to 1.
        field: the mean-field fixed point, from which the draws are sampled.
    """

    h1: Tensor
    log_weight: Tensor
    field: MeanField

    def implied(
        self, machine: BoltzmannMachine, edges: Edges, observed: Tensor, *, apart: bool = False
    ) -> Tensor:
        """Return `machine.implied` for the mean of the hidden units given the objects."""

        return machine.implied(edges, observed, self.field.x.sigmoid(), apart=apart)

    def mean(self, values: Tensor) -> Tensor:
        """Return the weighted mean over the draws of values (draws, scenes, ...)."""
        weight = self.log_weight.exp()
        return torch.einsum("mb,mb...->b...", weight, values)

    def log_mean_exp(self, values: Tensor) -> Tensor:
        """Return log E[exp(values)] over the draws, for values (draws, scenes, ...)."""
        weight = self.log_weight.reshape(*self.log_weight.shape, *[1] * (values.dim() - 2))
        return (values + weight).logsumexp(0)

    def standard_error(self, values: Tensor) -> Tensor:
        """Return an upper bound of the standard error of `mean(values)`, (scenes, ...).

        The delta method assumes independent draws; those of a Sobol sequence have smaller errors.
        """
        deviation = (values - self.mean(values)) ** 2
        return torch.einsum("mb,mb...->b...", (2 * self.log_weight).exp(), deviation).sqrt()


@lru_cache(maxsize=8)
def fixed_uniforms(count: int, units: int) -> Tensor:
    """Return quasi-random numbers in (0, 1), (count, units). Every process gets equal numbers."""
    engine = torch.quasirandom.SobolEngine(units, scramble=True, seed=20180521)
    return engine.draw(count, dtype=torch.float64).clamp(min=1e-9)


def draw_hidden(
    machine: BoltzmannMachine, evidence: Evidence, *, draws: int = 64, pull: float = 1.0
) -> HiddenDraws:
    """Return weighted draws of the hidden units h1 given the evidence.

    Args:
        draws: number of draws. A power of two keeps the Sobol sequence balanced.
        pull: exponent of the likelihood of the observed relations, from 0 to 1.
    """
    field = mean_field(machine, evidence, pull=pull)
    y = field.y
    uniforms = fixed_uniforms(draws, machine.spec.H1).to(y.dtype).unsqueeze(1)
    h1 = (uniforms < y.sigmoid()).to(y.dtype)
    log_q = (h1 * logsigmoid(y) + (1 - h1) * logsigmoid(-y)).sum(-1)
    target = (h1 * field.x).sum(-1)
    relations = evidence.relations(machine)
    if relations is not None:
        edges, r, observed = relations
        gate = machine.gate(edges, evidence.v)
        logits = machine.relation_logits(edges, evidence.v, h1)
        term = machine.relation_term(logits, gate, r, observed)
        if pull < 1:
            unobserved = machine.relation_term(logits, gate, r, torch.zeros_like(observed))
            term = torch.lerp(unobserved, term, pull)
        target = target + term.sum(-1)
    log_weight = target - log_q
    return HiddenDraws(h1, log_weight - log_weight.logsumexp(0), field)
