"""Block Gibbs sampling with any units clamped and any unobserved.

One step draws, in turn,

    h1 | v, r, h2   factorial in the seed form. In the local form unobserved relations drop out and
                    observed ones are met by Metropolis–Hastings, proposing blocks of h1 from
                    p(h1 | v, h2)
    h2 | h1         factorial
    v  | h1         RBM, GBM: given r, factorial. Triway: with every unobserved relation summed out,
                    factorial in the local form and object after object in the seed form
    r  | v, h1      factorial; where relations imply each other, group after group given those
                    before, by the chain rule

A plain block sampler freezes the gated seed form: while a relation of i is on, p(v_i = 1) = 1.
Hence v is drawn with R_i summed out (`collapsed`, the default); the plain kernel stays for
contrastive divergence, whose one step need not mix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from training.machines.bernoulli import bernoulli
from training.machines.edges import Edges
from training.machines.gbm import GBM
from training.machines.machine import BoltzmannMachine
from training.machines.mean_field import Evidence, mean_field
from training.machines.presence import presence_product
from training.machines.triway import Triway

_PROPOSAL_BLOCKS = 8
# Relations that imply each other are drawn in twice so many groups, each given those before it.
_RELATION_GROUPS = 4


@dataclass(frozen=True)
class State:
    """One configuration per chain: v (B, V), r (B, E) over `edges`, h1 (B, H1), h2 (B, H2)."""

    v: Tensor
    h1: Tensor
    h2: Tensor
    r: Tensor
    edges: Edges


@dataclass(frozen=True)
class Clamp:
    """Units that keep their value, and relations that are observed.

    Attributes:
        v, h1, h2: bool masks broadcastable to the blocks; None clamps nothing.
        edges, r, observed: observed relations, as in `Evidence`. In a Triway machine both ends of
            an observed unit must be clamped present: an absent object has no relations to observe.
        room: (B,) int64 room types.
    """

    v: Tensor | None = None
    h1: Tensor | None = None
    h2: Tensor | None = None
    edges: Edges | None = None
    r: Tensor | None = None
    observed: Tensor | None = None
    room: Tensor | None = None


FREE = Clamp()


def initial_state(
    machine: BoltzmannMachine, v: Tensor, generator: torch.Generator, clamp: Clamp = FREE
) -> State:
    """A state at v with the context drawn from its prior and relations drawn given both."""
    rows = len(v)
    h1 = bernoulli(machine.context_bias(clamp.room).sigmoid().expand(rows, -1), generator)
    h2 = bernoulli(machine.c2.sigmoid().expand(rows, -1), generator)
    edges, r = sample_relations(machine, v, h1, generator, clamp)
    return State(v, h1, h2, r, edges)


@torch.no_grad()
def gibbs_step(
    machine: BoltzmannMachine,
    state: State,
    generator: torch.Generator,
    clamp: Clamp = FREE,
    *,
    collapsed: bool = True,
    relations: bool = True,
) -> State:
    """One sweep over h1, h2, v and r.

    Args:
        collapsed: draw v with its unobserved relations summed out (Triway, seed form).
        relations: draw r at the end; False keeps the old r where only v matters (local form).
    """
    h1 = sample_h1(machine, state, generator, clamp)
    state = replace(state, h1=h1)
    return reconstruct(machine, state, generator, clamp, collapsed=collapsed, relations=relations)


@torch.no_grad()
def reconstruct(
    machine: BoltzmannMachine,
    state: State,
    generator: torch.Generator,
    clamp: Clamp = FREE,
    *,
    collapsed: bool = True,
    relations: bool = True,
) -> State:
    """The second half of a Gibbs step: h2, v and r drawn anew given h1."""
    h1, h2 = state.h1, state.h2
    if machine.spec.H2:
        drawn = bernoulli(machine.second_layer_logits(h1).sigmoid(), generator)
        h2 = _keep(clamp.h2, h2, drawn)
    state = replace(state, h2=h2)
    v = sample_v(machine, state, generator, clamp, collapsed=collapsed)
    if not relations:
        return replace(state, v=v)
    edges, r = sample_relations(machine, v, h1, generator, clamp)
    return State(v, h1, h2, r, edges)


def run(
    machine: BoltzmannMachine,
    state: State,
    generator: torch.Generator,
    sweeps: int,
    clamp: Clamp = FREE,
    *,
    relations: bool = True,
) -> State:
    """So many Gibbs steps; see `gibbs_step`."""
    for _ in range(sweeps):
        state = gibbs_step(machine, state, generator, clamp, relations=relations)
    return state


def sample_h1(
    machine: BoltzmannMachine, state: State, generator: torch.Generator, clamp: Clamp = FREE
) -> Tensor:
    """h1 | v, r, h2, (B, H1)."""
    v, h2 = state.v, state.h2
    second = h2 if machine.spec.H2 else None
    x = presence_product(v, machine.W).add_(machine.context_bias(clamp.room))
    if second is not None:
        x = torch.addmm(x, second, machine.J.T)
    if machine.spec.form == "seed" and state.r.shape[-1]:
        x = x + machine.hidden_input(state.edges, state.r)
    prior = x.sigmoid_()
    if machine.spec.form == "seed" or clamp.edges is None:
        return _keep(clamp.h1, state.h1, bernoulli(prior, generator))
    h1 = state.h1
    weight = _observed_weight(machine, v, h1, clamp)
    block = torch.randint(_PROPOSAL_BLOCKS, h1.shape, generator=generator)
    for k in range(_PROPOSAL_BLOCKS):
        proposal = torch.where(block == k, bernoulli(prior, generator), h1)
        proposal = _keep(clamp.h1, h1, proposal)
        new = _observed_weight(machine, v, proposal, clamp)
        accept = torch.rand(new.shape, generator=generator, dtype=new.dtype).log() < new - weight
        h1 = torch.where(accept.unsqueeze(-1), proposal, h1)
        weight = torch.where(accept, new, weight)
    return h1


def sample_v(
    machine: BoltzmannMachine,
    state: State,
    generator: torch.Generator,
    clamp: Clamp = FREE,
    *,
    collapsed: bool = True,
) -> Tensor:
    """v | h1, with unobserved relations summed out where `collapsed`, else v | h1, r; (B, V)."""
    # addmm: the bias enters with the product; memory is what a sweep waits for.
    logits = torch.addmm(machine.b, state.h1, machine.W.T)
    if isinstance(machine, GBM) and machine.spec.form == "seed":
        logits = logits + machine.relation_input(state.edges, state.r)
    elif isinstance(machine, Triway) and machine.spec.form == "seed":
        if collapsed:
            return _collapsed_sweep(machine, state, generator, clamp)
        if bool(machine.kappa.any()):
            raise ValueError("the plain kernel needs κ = 0: κ ties objects even given h1 and r")
        held = machine.held_objects(state.edges, state.r)
        return _keep(clamp.v, state.v, bernoulli(logits.sigmoid(), generator).maximum(held))
    return _keep(clamp.v, state.v, bernoulli(logits.sigmoid_(), generator))


def _collapsed_sweep(
    machine: Triway, state: State, generator: torch.Generator, clamp: Clamp
) -> Tensor:
    v, h1 = state.v.clone(), state.h1
    logits = machine.object_logits(h1)
    for i in range(machine.spec.V):
        candidate = torch.tensor([[i]])
        gain = machine.attraction_to_all(v, h1, candidate)[:, 0]
        drawn = bernoulli((logits[:, i] + gain).sigmoid(), generator)
        held = None if clamp.v is None else clamp.v.expand_as(v)[:, i]
        v[:, i] = _keep(held, v[:, i], drawn)
    return v


def sample_relations(
    machine: BoltzmannMachine,
    v: Tensor,
    h1: Tensor,
    generator: torch.Generator,
    clamp: Clamp = FREE,
) -> tuple[Edges, Tensor]:
    """r | v, h1 over the units that v leaves open; observed units keep their value.

    Returns:
        The units and r (B, E). In a Triway machine the classes of `clamp.edges` come first.
    """
    if not isinstance(machine, Triway):
        edges = machine.edges(torch.zeros(1, 0, dtype=torch.int64))
        p = machine.relation_logits(edges, v, h1).sigmoid() * machine.gate(edges, v)
        r = bernoulli(p, generator)
        if clamp.edges is None or clamp.r is None or clamp.observed is None:
            return edges, r
        return edges, torch.where(clamp.observed, clamp.r, r)
    pairs = machine.evidence_pairs(clamp.edges, len(v))
    classes = present_classes(v, pairs.subjects if pairs is not None else None)
    edges = machine.edges(classes)
    logits, gate = machine.relation_logits(edges, v, h1), machine.gate(edges, v)
    r, known = torch.zeros_like(logits), torch.zeros_like(logits, dtype=torch.bool)
    if pairs is not None and clamp.r is not None and clamp.observed is not None:
        # Both are copied into views of r and known.
        n = pairs.subjects.shape[1]
        edges.unflatten(known)[..., :n, :n] = pairs.unflatten(clamp.observed)
        edges.unflatten(r)[..., :n, :n] = pairs.unflatten(clamp.r * clamp.observed)
    if not machine.spec.G:
        return edges, torch.where(known, r, bernoulli(logits.sigmoid() * gate, generator))
    context = mean_field(machine, Evidence(v, room=clamp.room)).y.sigmoid()
    group = _drawing_order(edges.unflatten(logits), generator).flatten(-3)
    for k in range(2 * _RELATION_GROUPS):
        p = (logits + machine.implied(edges, r, context)).sigmoid() * gate
        r = torch.where((group == k) & ~known, bernoulli(p, generator), r)
    return edges, r


def _drawing_order(like: Tensor, generator: torch.Generator) -> Tensor:
    """A random group for each unit (..., n, n), never the same for a(i, j) and a(j, i)."""
    group = torch.randint(_RELATION_GROUPS, like.shape, generator=generator)
    later = torch.randint(2, like.shape, generator=generator).triu(1)
    later = later + (1 - later.mT).tril(-1)
    return group + _RELATION_GROUPS * later


def present_classes(v: Tensor, leading: Tensor | None = None) -> Tensor:
    """The classes present in each row of v, (B, n) int64 padded with -1; `leading` ones first.

    Args:
        leading: (B, k) classes that are present and keep their order.
    """
    # numpy lists the units that are on several times faster than torch does.
    present = v.detach().numpy() > 0
    lead = np.zeros((len(v), 0), np.int64) if leading is None else leading.numpy()
    rows = np.arange(len(v))[:, None]
    if lead.size:
        present[rows, lead] = False
    row, column = present.nonzero()
    counts = present.sum(1)
    width = lead.shape[1] + int(counts.max(initial=0))
    classes = np.full((len(v), width), -1, dtype=np.int64)
    classes[:, : lead.shape[1]] = lead
    place = np.arange(len(row)) - np.repeat(counts.cumsum() - counts, counts)
    classes[row, lead.shape[1] + place] = column
    return torch.from_numpy(classes)


def _observed_weight(machine: BoltzmannMachine, v: Tensor, h1: Tensor, clamp: Clamp) -> Tensor:
    """log p(observed r | v, h1), (B,)."""
    if clamp.edges is None or clamp.r is None or clamp.observed is None:
        raise ValueError("observed relations need edges, r and observed")
    gate = machine.gate(clamp.edges, v)
    logits = machine.relation_logits(clamp.edges, v, h1)
    return machine.relation_term(logits, gate, clamp.r, clamp.observed).sum(-1)


def _keep(mask: Tensor | None, old: Tensor, new: Tensor) -> Tensor:
    return new if mask is None else torch.where(mask, old, new)
