"""Block Gibbs sampling, in which any units can be clamped or unobserved.

One step samples the blocks in this order:

    h1 | v, r, h2   factorial in the seed form. In the local form unobserved relations drop out.
                    Observed relations are handled by Metropolis–Hastings, which proposes blocks of
                    h1 from p(h1 | v, h2)
    h2 | h1         factorial
    v  | h1         RBM and GBM: factorial, given r. Triway: with every unobserved relation summed
                    out; factorial in the local form, object after object in the seed form
    r  | v, h1      factorial. If relations imply each other, they are sampled in groups, each group
                    given the earlier groups (chain rule)

A plain block sampler cannot leave its state in the gated seed form: while a relation of object i is
on, p(v_i = 1) = 1. Hence v is sampled with the relations R_i of object i summed out (`collapsed`,
the default). Contrastive divergence can use the plain kernel, because its single step need not mix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from training.distributed import widest
from training.machines.bernoulli import bernoulli, integers, uniform
from training.machines.edges import Edges
from training.machines.machine import BoltzmannMachine
from training.machines.mean_field import Evidence, mean_field

_PROPOSAL_BLOCKS = 8
# Relations that imply each other are sampled in twice this number of groups.
_RELATION_GROUPS = 4
# With fewer chains, or with a larger share of present objects, the dense product is faster.
_CHAINS = 16
_PRESENT = 0.12


@dataclass(frozen=True)
class State:
    """One state of each chain: v (B, V), r (B, E) over `edges`, h1 (B, H1), h2 (B, H2)."""

    v: Tensor
    h1: Tensor
    h2: Tensor
    r: Tensor
    edges: Edges


@dataclass(frozen=True)
class Clamp:
    """Clamped units and observed relations.

    Attributes:
        v, h1, h2: bool masks broadcastable to the blocks; None clamps no unit.
        edges, r, observed: observed relations, as in `Evidence`. In a Triway machine both ends of
            an observed unit must be clamped as present.
        room: (B,) int64 room types.
    """

    v: Tensor | None = None
    h1: Tensor | None = None
    h2: Tensor | None = None
    edges: Edges | None = None
    r: Tensor | None = None
    observed: Tensor | None = None
    room: Tensor | None = None

    def __post_init__(self) -> None:
        if len({self.edges is None, self.r is None, self.observed is None}) > 1:
            raise ValueError("a clamp with observed relations needs all of edges, r and observed")

    @property
    def relations(self) -> tuple[Edges, Tensor, Tensor] | None:
        """(edges, r, observed), or None without observed relations."""
        if self.edges is None or self.r is None or self.observed is None:
            return None
        return self.edges, self.r, self.observed


FREE = Clamp()


def initial_state(
    machine: BoltzmannMachine, v: Tensor, generator: torch.Generator, clamp: Clamp = FREE
) -> State:
    """Return a state at v, with h1 and h2 sampled from their biases and r given v and h1."""
    rows = len(v)
    h1 = bernoulli(machine.context_bias(clamp.room).sigmoid().expand(rows, -1), generator)
    h2 = bernoulli(machine.c2.sigmoid().expand(rows, -1), generator)
    edges, r = sample_relations(machine, v, h1, generator, clamp)
    return State(v, h1, h2, r, edges)


def bare_state(machine: BoltzmannMachine, v: Tensor, h1: Tensor, h2: Tensor) -> State:
    """Return a state without relations, for the local form, where unobserved relations drop out."""
    edges = machine.edges(torch.zeros(len(v), 0, dtype=torch.int64))
    return State(v, h1, h2, v.new_zeros(len(v), edges.shape[-1]), edges)


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
    """Run one sweep over h1, h2, v and r.

    Args:
        collapsed: sample v with its unobserved relations summed out (Triway, seed form).
        relations: sample r at the end; False keeps the old r if only v matters (local form).
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
    """Run the second half of a Gibbs step: sample h2, v and r given h1."""
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
    """Run `sweeps` Gibbs steps; see `gibbs_step`."""
    for _ in range(sweeps):
        state = gibbs_step(machine, state, generator, clamp, relations=relations)
    return state


def sample_h1(
    machine: BoltzmannMachine, state: State, generator: torch.Generator, clamp: Clamp = FREE
) -> Tensor:
    """Sample h1 | v, r, h2, (B, H1)."""
    v, h2 = state.v, state.h2
    second = h2 if machine.spec.H2 else None
    x = presence_product(v, machine.W).add_(machine.context_bias(clamp.room))
    if second is not None:
        x = torch.addmm(x, second, machine.J.T)
    if machine.relations_act and state.r.shape[-1]:
        x = x + machine.hidden_input(state.edges, state.r)
    prior = x.sigmoid_()
    given = clamp.relations
    if machine.relations_act or given is None:
        return _keep(clamp.h1, state.h1, bernoulli(prior, generator))
    h1 = state.h1
    weight = _observed_weight(machine, v, h1, given)
    block = integers(_PROPOSAL_BLOCKS, h1.shape, generator)
    for k in range(_PROPOSAL_BLOCKS):
        proposal = torch.where(block == k, bernoulli(prior, generator), h1)
        proposal = _keep(clamp.h1, h1, proposal)
        new = _observed_weight(machine, v, proposal, given)
        accept = uniform(new.shape, generator, new.dtype).log() < new - weight
        h1 = torch.where(accept.unsqueeze(-1), proposal, h1)
        weight = torch.where(accept, new, weight)
    return h1


def presence_product(v: Tensor, W: Tensor) -> Tensor:
    """Return v @ W, (B, H), for binary v (B, V) and W (V, H), as a sum of rows of W.

    A scene has about a dozen of some hundred classes, so a dense product mostly multiplies by zero.
    """
    if len(v) < _CHAINS:
        return v @ W
    # numpy lists the active units several times faster than torch.
    on = np.flatnonzero(v.detach().cpu().numpy() != 0)
    if on.size > _PRESENT * v.numel():
        return v @ W
    chains, classes = v.shape
    starts = on.searchsorted(np.arange(chains + 1) * classes)
    return embedding_bag(
        torch.from_numpy(on % classes),
        W,
        torch.from_numpy(starts),
        mode="sum",
        include_last_offset=True,
    )


def sample_v(
    machine: BoltzmannMachine,
    state: State,
    generator: torch.Generator,
    clamp: Clamp = FREE,
    *,
    collapsed: bool = True,
) -> Tensor:
    """Sample v | h1 with unobserved relations summed out (`collapsed`), else v | h1, r; (B, V)."""
    drawn = machine.sample_objects(
        *(state.v, state.h1, state.r, state.edges, generator), held=clamp.v, collapsed=collapsed
    )
    return _keep(clamp.v, state.v, drawn)


def sample_relations(
    machine: BoltzmannMachine,
    v: Tensor,
    h1: Tensor,
    generator: torch.Generator,
    clamp: Clamp = FREE,
) -> tuple[Edges, Tensor]:
    """Sample r | v, h1 over the units that may be on given v; observed units keep their value.

    Returns:
        The units and r (B, E). In a Triway machine the classes of `clamp.edges` come first.
    """
    edges, r, known = machine.open_units(v, clamp.relations, widest(v, generator))
    logits, gate = machine.relation_logits(edges, v, h1), machine.gate(edges, v)
    if not machine.spec.G:
        return edges, torch.where(known, r, bernoulli(logits.sigmoid() * gate, generator))
    context = mean_field(machine, Evidence(v, room=clamp.room)).y.sigmoid()
    group = _drawing_order(machine.between(edges, logits, edges.classes), generator).flatten(-3)
    for k in range(2 * _RELATION_GROUPS):
        p = (logits + machine.implied(edges, r, context)).sigmoid() * gate
        r = torch.where((group == k) & ~known, bernoulli(p, generator), r)
    return edges, r


def _drawing_order(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return a random group for each unit (..., n, n).

    The units a(i, j) and a(j, i) are always in different groups.
    """
    group = integers(_RELATION_GROUPS, like.shape, generator)
    later = integers(2, like.shape, generator).triu(1)
    later = later + (1 - later.mT).tril(-1)
    return group + _RELATION_GROUPS * later


def _observed_weight(
    machine: BoltzmannMachine, v: Tensor, h1: Tensor, relations: tuple[Edges, Tensor, Tensor]
) -> Tensor:
    """Return log p(observed r | v, h1), (B,)."""
    edges, r, observed = relations
    logits = machine.relation_logits(edges, v, h1)
    return machine.relation_term(logits, machine.gate(edges, v), r, observed).sum(-1)


def _keep(mask: Tensor | None, old: Tensor, new: Tensor) -> Tensor:
    return new if mask is None else torch.where(mask, old, new)
