"""Log-odds of objects and relations, from which all scores are computed.

    object    log p(v_i = 1 | rest) - log p(v_i = 0 | rest), with all relations R_i of i unobserved
    relation  log p(r_e = 1 | rest) - log p(r_e = 0 | rest), with e unobserved

The rest may contain observed and unobserved units. See `Evidence`.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from training.machines.draws import HiddenDraws, draw_hidden
from training.machines.edges import Edges
from training.machines.machine import BoltzmannMachine
from training.machines.mean_field import Evidence, mean_field


class _ContextGain(torch.autograd.Function):
    """Compute G[b,i] = sum_k [softplus(x_bk + W_ik) - softplus(x_bk)] without a (B, V, H1) tensor.

    The form log(1 + sigmoid(x)(exp(W) - 1)) needs one logarithm for each term; all rows share
    exp(W). The backward pass recomputes the terms row by row, so it stores one (V, H1) block only.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, W: Tensor) -> Tensor:
        growth = torch.expm1(W)
        mean = x.sigmoid()
        ctx.save_for_backward(mean, growth)
        rows = [torch.log1p(growth * row).sum(1) for row in mean]
        return torch.stack(rows) if rows else mean.new_zeros(0, len(W))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        mean, growth = ctx.saved_tensors
        (gradient,) = gradients
        grad_x = torch.empty_like(mean)
        grad_W = torch.zeros_like(growth)
        scale = growth + 1
        for b, row in enumerate(mean):
            # Posterior of h1 with i present: sigmoid(x + W) = s e^W / (1 + s (e^W - 1)).
            posterior = (scale * row).div_(torch.addcmul(torch.ones_like(scale), growth, row))
            weighted = posterior.mul_(gradient[b].unsqueeze(1))
            grad_x[b] = weighted.sum(0) - row * gradient[b].sum()
            grad_W += weighted
        return grad_x, grad_W


def context_gain(x: Tensor, W: Tensor) -> Tensor:
    """Return sum_k [softplus(x + W_ik) - softplus(x)], (B, V), for hidden logits x (B, H1)."""
    gain: Tensor = _ContextGain.apply(x, W)  # type: ignore[no-untyped-call]
    return gain


def object_log_odds(
    machine: BoltzmannMachine,
    evidence: Evidence,
    *,
    candidates: Tensor | None = None,
    pull: float = 1.0,
) -> Tensor:
    """Return the log-odds of candidate objects at the mean-field fixed point, (B, N).

    The result is exact for one layer in the local form without observed relations. A second layer
    h2 stays at its mean-field value. In the seed form, and with observed relations, the result uses
    a factorial approximation of the context; `presence_log_odds` uses weighted draws instead.
    Candidates must be absent in `evidence.v`. The result is differentiable.

    Args:
        candidates: (B or 1, N) int64; default: all V classes.
        pull: weight of the observed relations, see `mean_field`.
    """
    field = mean_field(machine, evidence, pull=pull)
    if candidates is None:
        gain = machine.b + context_gain(field.y, machine.W)
        candidates = torch.arange(machine.spec.V).unsqueeze(0)
    else:
        rows = machine.W[candidates]
        y = field.y.unsqueeze(1)
        gain = machine.b[candidates] + (softplus(y + rows) - softplus(y)).sum(-1)
    if evidence.edges is None or not machine.relations_act:
        return gain
    return gain + machine.attraction(evidence.v, field.y.sigmoid(), evidence.edges, candidates)


def presence_log_odds(
    machine: BoltzmannMachine,
    evidence: Evidence,
    candidates: Tensor,
    draws: HiddenDraws | None = None,
) -> Tensor:
    """Return log p(v_i = 1 | rest) - log p(v_i = 0 | rest) of absent candidates, (B, N).

    In the local form without observed relations, this is `object_log_odds`, exact with one layer.
    Otherwise the formula is

        log-odds_i = b_i + G_i + log E_w[exp(W_i·h1 + attraction_i)] - log mean exp(W_i·h1)

    over weighted draws of h1. G_i = log E_q[exp(W_i·h1)] has a closed form under the proposal q of
    the draws. The last term estimates G_i from the unweighted draws. It is a control variate that
    cancels the error that both estimates share.

    Args:
        candidates: (B or 1, N) int64.
        draws: draws of h1 given the evidence; default: 64 draws.
    """
    if not machine.relations_act and evidence.edges is None:
        return object_log_odds(machine, evidence, candidates=candidates)
    draws = draw_hidden(machine, evidence) if draws is None else draws
    weights = machine.W[candidates]
    y = draws.field.y.unsqueeze(1)
    closed = (softplus(y + weights) - softplus(y)).sum(-1)
    bare = _object_input(machine, draws.h1, candidates)
    proposal_mean = bare.logsumexp(0) - math.log(len(draws.h1))
    gain = bare + _attraction(machine, evidence, draws, candidates)
    return machine.b[candidates] + closed + draws.log_mean_exp(gain) - proposal_mean


def weights_with(
    machine: BoltzmannMachine, evidence: Evidence, draws: HiddenDraws, candidates: Tensor
) -> Tensor:
    """Return weights that turn draws of h1 into draws given one more object.

    p(h1 | rest, v_i = 1) ∝ p(h1 | rest) exp(W_i·h1 + attraction_i(h1)), for one row of evidence.

    Args:
        candidates: (N,) int64.

    Returns:
        (M, N), normalised over M.
    """
    row = candidates.unsqueeze(0)
    gain = _object_input(machine, draws.h1, row) + _attraction(machine, evidence, draws, row)
    return torch.softmax(draws.log_weight + gain.squeeze(1), dim=0)


def _object_input(machine: BoltzmannMachine, h1: Tensor, candidates: Tensor) -> Tensor:
    """W_i·h1, (M, B, N)."""
    weights = machine.W[candidates]
    if len(weights) == 1:
        return h1 @ weights[0].T
    return torch.einsum("mbk,bnk->mbn", h1, weights)


def _attraction(
    machine: BoltzmannMachine, evidence: Evidence, draws: HiddenDraws, candidates: Tensor
) -> Tensor:
    """Return the contribution of unobserved relations to the log-odds, (M, B, N)."""
    if evidence.edges is None:
        return draws.h1.new_zeros(())
    return machine.attraction(evidence.v, draws.h1, evidence.edges, candidates)


def relation_log_odds(
    machine: BoltzmannMachine,
    edges: Edges,
    evidence: Evidence,
    *,
    count: int = 64,
) -> tuple[Tensor, Tensor]:
    """Return the log-odds of the unobserved units in `edges`, with standard errors.

    p(r_e = 1 | rest) = E_{h1 | rest}[ sigmoid(ℓ_e(h1) + x_e) ] in both forms. x_e is the shift
    implied by the observed relations. The log-odds are -inf where the gate is off.

    Raises:
        ValueError: the machine has implications (G > 0), and the layout of the observed relations
            differs from `edges`.

    Returns:
        (B, E) log-odds and (B, E) standard errors of the log-odds.
    """
    draws = draw_hidden(machine, evidence, draws=count)
    logits = machine.relation_logits(edges, evidence.v, draws.h1)
    relations = evidence.relations(machine)
    if machine.spec.G and relations is not None:
        if relations[0] is not edges:
            raise ValueError("the observed relations must have the same layout as edges")
        logits = logits + draws.implied(machine, edges, relations[1] * relations[2])
    on = logits.sigmoid()
    p = draws.mean(on)
    error = draws.standard_error(on) / (p * (1 - p)).clamp(min=1e-12)
    gate = machine.gate(edges, evidence.v)
    return torch.where(gate > 0, p.logit(eps=1e-12), -torch.inf), error


def relation_log_odds_observed(machine: BoltzmannMachine, evidence: Evidence) -> Tensor:
    """Return log-odds of every unit given all other units, in closed form (seed form), (B, E).

        ℓ⁰_e + sum_k [softplus(x_k + U_ek) - softplus(x_k)],   x without e

    The result is exact for one layer. With two layers, h2 stays at its mean-field value given all
    relations.

    Raises:
        ValueError: the machine has the local form, or a unit is unobserved.
    """
    if not machine.relations_act:
        raise ValueError("relation log-odds have a closed form only in a machine of the seed form")
    relations = evidence.relations(machine)
    if relations is None or not bool(relations[2].all()):
        raise ValueError("the closed form of relation log-odds needs every relation unit observed")
    edges, r, _ = relations
    field = mean_field(machine, evidence)
    context = machine.relation_context(edges)
    x = field.y.unsqueeze(1) - r.unsqueeze(-1) * context
    bare = machine.relation_logits(edges, evidence.v, field.y.new_zeros(field.y.shape))
    log_odds = bare + (softplus(x + context) - softplus(x)).sum(-1)
    return torch.where(machine.gate(edges, evidence.v) > 0, log_odds, -torch.inf)
