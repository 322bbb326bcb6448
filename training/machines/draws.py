"""Weighted draws of h1 from p(h1 | evidence): the estimator behind every answer without a closed
form.

Given h1, unobserved relations sum out and observed ones multiply, unit by unit. So with a factorial
proposal q (the mean-field fixed point) each draw h carries the weight

    log w = h·x + sum_e term_e(ℓ_e(h)) - log q(h),   x = c1 + v'W + J h2,

with the likelihood of observed relations raised to a power (`pull`) where they must count for
less. Any expectation over p(h1 | evidence) is a weighted mean. The uniforms behind the draws are
fixed (a scrambled Sobol sequence), so the same evidence always gives the same answer. With two
layers h2 is held at its mean-field value.

Source: self-normalised importance sampling; Rao–Blackwellised, since only h1 is ever drawn.
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
    """Draws of the first hidden layer.

    Attributes:
        h1: (M, B, H1) binary.
        log_weight: (M, B), normalised over M.
        log_evidence: (B,) estimate of log sum_{h1, unobserved r} exp(-E) without the object biases.
        field: the mean-field fixed point behind the proposal.
    """

    h1: Tensor
    log_weight: Tensor
    log_evidence: Tensor
    field: MeanField

    @property
    def effective_size(self) -> Tensor:
        """(B,) effective number of draws, 1 / sum w²."""
        return (-(2 * self.log_weight).logsumexp(0)).exp()

    def implied(
        self, machine: BoltzmannMachine, edges: Edges, given: Tensor, *, apart: bool = False
    ) -> Tensor:
        """What the given relations (B, E), 1 where on, imply for the others, (B, E).

        How strictly is for the objects to say: the context is taken at its mean without relations.
        """
        return machine.implied(edges, given, self.field.x.sigmoid(), apart=apart)

    def mean(self, values: Tensor) -> Tensor:
        """Expectation of values (M, B, ...) over the draws, (B, ...)."""
        weight = self.log_weight.exp()
        return torch.einsum("mb,mb...->b...", weight, values)

    def log_mean_exp(self, values: Tensor) -> Tensor:
        """log E[exp(values)], (B, ...)."""
        weight = self.log_weight.reshape(*self.log_weight.shape, *[1] * (values.dim() - 2))
        return (values + weight).logsumexp(0)

    def standard_error(self, values: Tensor) -> Tensor:
        """Standard error of `mean(values)` by the delta method, (B, ...).

        An upper bound in practice: the Sobol sequence does better than independent draws.
        """
        deviation = (values - self.mean(values)) ** 2
        return torch.einsum("mb,mb...->b...", (2 * self.log_weight).exp(), deviation).sqrt()


@lru_cache(maxsize=8)
def fixed_uniforms(count: int, units: int) -> Tensor:
    """(count, units) quasi-random numbers in (0, 1), the same in every process."""
    engine = torch.quasirandom.SobolEngine(units, scramble=True, seed=20180521)
    return engine.draw(count, dtype=torch.float64).clamp(1e-9, 1 - 1e-9)


def draw_hidden(
    machine: BoltzmannMachine,
    evidence: Evidence,
    *,
    draws: int = 64,
    pull: float = 1.0,
) -> HiddenDraws:
    """Weighted draws of h1 given the evidence.

    Args:
        draws: M; a power of two keeps the Sobol sequence balanced.
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
