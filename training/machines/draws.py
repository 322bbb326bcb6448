"""Weighted draws of h1 from p(h1 | evidence), used for every answer without a closed form.

Given h1, unobserved relations sum out, and the likelihood of observed relations is a product over
units. The proposal q is the factorial mean-field fixed point. Each draw h then has the weight

    log w = h·x + sum_e term_e(ℓ_e(h)) - log q(h),   x = c1 + v'W + J h2,

where term_e is `BoltzmannMachine.relation_term`. The likelihood of observed relations can be raised
to a power (`pull`) to reduce their influence. An expectation over p(h1 | evidence) is the weighted
mean over the draws. The uniform numbers are fixed (a scrambled Sobol sequence), so equal evidence
always gives the same answer. With two layers, h2 stays at its mean-field value.

The method is self-normalised importance sampling. It is Rao–Blackwellised: only h1 is sampled, and
unobserved relations are summed out.
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
    """Weighted draws of the first hidden layer.

    Attributes:
        h1: (M, B, H1) binary.
        log_weight: (M, B), normalised over M.
        log_evidence: (B,) estimate of log sum_{h1, unobserved r} exp(-E) without the object biases.
        field: the mean-field fixed point of the proposal.
    """

    h1: Tensor
    log_weight: Tensor
    log_evidence: Tensor
    field: MeanField

    @property
    def effective_size(self) -> Tensor:
        """Effective number of draws, 1 / sum w², (B,)."""
        return (-(2 * self.log_weight).logsumexp(0)).exp()

    def implied(
        self, machine: BoltzmannMachine, edges: Edges, given: Tensor, *, apart: bool = False
    ) -> Tensor:
        """Return the logit shifts (B, E) that given relations imply for other relations.

        The shifts depend on the context h1. Here h1 is its mean given the objects only.

        Args:
            given: (B, E), 1 where a relation is given as holding.
            apart: leave out the implications between relations of the same two classes.
        """
        return machine.implied(edges, given, self.field.x.sigmoid(), apart=apart)

    def mean(self, values: Tensor) -> Tensor:
        """Return the expectation of values (M, B, ...) over the draws, (B, ...)."""
        weight = self.log_weight.exp()
        return torch.einsum("mb,mb...->b...", weight, values)

    def log_mean_exp(self, values: Tensor) -> Tensor:
        """Return log E[exp(values)], (B, ...)."""
        weight = self.log_weight.reshape(*self.log_weight.shape, *[1] * (values.dim() - 2))
        return (values + weight).logsumexp(0)

    def standard_error(self, values: Tensor) -> Tensor:
        """Return the standard error of `mean(values)` by the delta method, (B, ...).

        In practice it is an upper bound, because a Sobol sequence has smaller errors than
        independent draws.
        """
        deviation = (values - self.mean(values)) ** 2
        return torch.einsum("mb,mb...->b...", (2 * self.log_weight).exp(), deviation).sqrt()


@lru_cache(maxsize=8)
def fixed_uniforms(count: int, units: int) -> Tensor:
    """Return (count, units) quasi-random numbers in (0, 1), the same in every process."""
    engine = torch.quasirandom.SobolEngine(units, scramble=True, seed=20180521)
    return engine.draw(count, dtype=torch.float64).clamp(min=1e-9)


def draw_hidden(
    machine: BoltzmannMachine,
    evidence: Evidence,
    *,
    draws: int = 64,
    pull: float = 1.0,
) -> HiddenDraws:
    """Return weighted draws of h1 given the evidence.

    Args:
        draws: number of draws M; a power of two keeps the Sobol sequence balanced.
        pull: weight of the observed relations' likelihood, from 0 to 1.
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
            unseen = machine.relation_term(logits, gate, r, torch.zeros_like(observed))
            term = torch.lerp(unseen, term, pull)
        target = target + term.sum(-1)
    log_weight = target - log_q
    total = log_weight.logsumexp(0)
    count = torch.tensor(float(len(h1)), dtype=y.dtype).log()
    return HiddenDraws(h1, log_weight - total, total - count, field)
