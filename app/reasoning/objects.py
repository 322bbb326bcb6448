"""Log-odds of objects: closed-form where the model allows it, estimated elsewhere."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

from app.boltzmann import BoltzmannMachine
from app.boltzmann.draws import HiddenDraws
from app.boltzmann.log_odds import object_log_odds
from app.boltzmann.mean_field import Evidence
from app.reasoning.evidence import draw_context
from app.registry.artifact import Artifact


def presence_log_odds(
    machine: BoltzmannMachine,
    evidence: Evidence,
    candidates: Tensor,
    draws: HiddenDraws | None = None,
) -> Tensor:
    """log p(v_i = 1 | rest) - log p(v_i = 0 | rest) for candidates absent in the evidence, (B, N).

    Local form without observed relations: `object_log_odds`, exact with one layer. Otherwise

        log-odds_i = b_i + G_i + log E_w[exp(W_i·h1 + attraction_i)] - log mean exp(W_i·h1)

    over weighted draws of h1, with G_i = log E_q[exp(W_i·h1)] in closed form under the proposal q
    of the draws, unweighted in the last term: a control that takes out what both err in common.

    Args:
        candidates: (B or 1, N) int64.
        draws: of h1 given the evidence; those of `draw_context` by default.
    """
    if machine.spec.form == "local" and evidence.edges is None:
        return object_log_odds(machine, evidence, candidates=candidates)
    draws = draw_context(machine, evidence) if draws is None else draws
    weights = machine.W[candidates]
    y = draws.field.y.unsqueeze(1)
    closed = (softplus(y + weights) - softplus(y)).sum(-1)
    bare = _object_input(machine, draws.h1, candidates)
    proposal_mean = bare.logsumexp(0) - math.log(len(draws.h1))
    gain = bare + _attraction(machine, evidence, draws, candidates)
    return machine.b[candidates] + closed + draws.log_mean_exp(gain) - proposal_mean


def absent_log_odds(
    artifact: Artifact, evidence: Evidence, absent: Tensor, draws: HiddenDraws
) -> Tensor:
    """`presence_log_odds` of many absent classes for one scene, (N,).

    The closed form goes through the artifact's prepared scorer: same values, several times faster.

    Args:
        evidence: one row.
        absent: (N,) int64.
        draws: of h1 given the evidence.
    """
    machine = artifact.machine
    if machine.spec.form == "local" and evidence.edges is None:
        return machine.b[absent] + artifact.scorer.gain(draws.field.y)[0, absent]
    return presence_log_odds(machine, evidence, absent.unsqueeze(0), draws)[0]


def weights_with(
    machine: BoltzmannMachine, evidence: Evidence, draws: HiddenDraws, candidates: Tensor
) -> Tensor:
    """Weights that turn draws of h1 given the evidence into draws given it and one object more.

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
    """What unobserved relations add to the log-odds, (M, B, N)."""
    if evidence.edges is None:
        return draws.h1.new_zeros(())
    return machine.attraction(evidence.v, draws.h1, evidence.edges, candidates)
