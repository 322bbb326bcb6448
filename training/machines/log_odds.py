"""Log-odds of objects and relations, from which all scores are computed.

    object    log p(v_i = 1 | rest) - log p(v_i = 0 | rest)
    relation  log p(r_e = 1 | rest) - log p(r_e = 0 | rest)

In the first formula, all relations of object i are unobserved. In the second formula, relation e is
unobserved. "rest" means all other observed units of the scene (`Evidence`). The energy has two
forms, seed and local, with different formulas (`training.machines.machine`).
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
    """Compute G[b,i] = sum_k [softplus(x_bk + W_ik) - softplus(x_bk)] for scene b and class i.

    A tensor of shape (scenes, classes, hidden units) would be too large, so the function computes
    the sum scene by scene. Each term is log(1 + sigmoid(x)(exp(W) - 1)), which needs only one
    logarithm. All scenes share exp(W). To save memory, the backward pass computes the terms again.
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
            # Posterior mean of h1 with object i present, from s = sigmoid(x):
            # sigmoid(x + W) = s e^W / (1 + s (e^W - 1)).
            posterior = (scale * row).div_(torch.addcmul(torch.ones_like(scale), growth, row))
            weighted = posterior.mul_(gradient[b].unsqueeze(1))
            grad_x[b] = weighted.sum(0) - row * gradient[b].sum()
            grad_W += weighted
        return grad_x, grad_W


def context_gain(x: Tensor, W: Tensor) -> Tensor:
    """Return the log-odds of each object i from the hidden units, (scenes, classes).

    The value is sum_k [softplus(x_k + W_ik) - softplus(x_k)] for the logits x, (scenes, H1), of the
    hidden units and their weights W, (classes, H1).
    """
    gain: Tensor = _ContextGain.apply(x, W)  # type: ignore[no-untyped-call]
    return gain


def object_log_odds(
    machine: BoltzmannMachine,
    evidence: Evidence,
    *,
    candidates: Tensor | None = None,
    pull: float = 1.0,
) -> Tensor:
    """Return mean-field log-odds of absent ("candidate") classes, (scenes, candidates).

    The result is exact in the local form with one hidden layer and without observed relations. With
    a second layer, h2 stays at its mean-field value. In other cases, the result uses a factorial
    approximation of the hidden units. `presence_log_odds` uses weighted draws instead. The result
    is differentiable.

    Args:
        candidates: class indices, (scenes or 1, candidates) int64. The default is all classes.
        pull: weight of the observed relations, from 0 to 1; see `mean_field`.
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
    """Return the log-odds of absent ("candidate") classes, (scenes, candidates).

    In the local form without observed relations, the result is that of `object_log_odds`, which is
    exact with one hidden layer. Otherwise the formula is

        log-odds_i = b_i + G_i + log E_w[exp(W_i·h1 + attraction_i)] - log mean exp(W_i·h1)

    E_w is the weighted mean over `draws` of h1, by default 64. G_i = log E_q[exp(W_i·h1)] has a
    closed form, because the draws come from the factorial distribution q. The last term estimates
    G_i from the unweighted draws. G_i and its estimate are a control variate: their difference
    cancels a part of the sampling error of E_w.
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
    """Return weights, (draws, candidates), that turn draws of h1 into draws given a new object i.

    p(h1 | rest, v_i = 1) ∝ p(h1 | rest) exp(W_i·h1 + attraction_i(h1))

    The weights of a candidate sum to 1.

    The evidence has one scene, and the candidates are class indices, (candidates,) int64.
    """
    row = candidates.unsqueeze(0)
    gain = _object_input(machine, draws.h1, row) + _attraction(machine, evidence, draws, row)
    return torch.softmax(draws.log_weight + gain.squeeze(1), dim=0)


def _object_input(machine: BoltzmannMachine, h1: Tensor, candidates: Tensor) -> Tensor:
    """Return W_i·h1 for each candidate class i, (draws, scenes, candidates)."""
    weights = machine.W[candidates]
    if len(weights) == 1:
        return h1 @ weights[0].T
    return torch.einsum("mbk,bnk->mbn", h1, weights)


def _attraction(
    machine: BoltzmannMachine, evidence: Evidence, draws: HiddenDraws, candidates: Tensor
) -> Tensor:
    """Return what unobserved relations add to the log-odds, (draws, scenes, candidates)."""
    if evidence.edges is None:
        return draws.h1.new_zeros(())
    return machine.attraction(evidence.v, draws.h1, evidence.edges, candidates)


def relation_log_odds(
    machine: BoltzmannMachine, edges: Edges, evidence: Evidence, *, count: int = 64
) -> tuple[Tensor, Tensor]:
    """Return log-odds and standard errors of the unobserved units in `edges`, (scenes, units).

    p(r_e = 1 | rest) = E_{h1 | rest}[ sigmoid(ℓ_e(h1) + x_e) ] in both forms of the energy, from
    `count` draws of h1. x_e is the change of the logit of unit e due to the observed relations. In
    a Triway machine, the log-odds are -inf if an object of the relation is absent.

    Raises:
        ValueError: the machine has implication weights (G > 0), and the observed relations have a
            layout other than `edges`.
    """
    draws = draw_hidden(machine, evidence, draws=count)
    logits = machine.relation_logits(edges, evidence.v, draws.h1)
    relations = evidence.relations(machine)
    if machine.spec.G and relations is not None:
        if relations[0] is not edges:
            raise ValueError(
                "the layout of the observed relations differs from edges; pass evidence.edges"
            )
        logits = logits + draws.implied(machine, edges, relations[1] * relations[2])
    on = logits.sigmoid()
    p = draws.mean(on)
    error = draws.standard_error(on) / (p * (1 - p)).clamp(min=1e-12)
    gate = machine.gate(edges, evidence.v)
    return torch.where(gate > 0, p.logit(eps=1e-12), -torch.inf), error
