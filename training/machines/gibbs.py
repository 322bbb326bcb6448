"""Block Gibbs sampling. Any units can be clamped (fixed to their value) or unobserved.

One step samples four blocks: the hidden units h1, the hidden units h2, the objects v and the
relations r. `local` and `seed` are the two forms of the energy (`training.machines.machine`).

    h1 | v, r, h2   Seed form: all units are independent. Local form: unobserved relations have no
                    effect. For observed relations, a Metropolis–Hastings step proposes blocks of h1
                    from p(h1 | v, h2).
    h2 | h1         All units are independent.
    v  | h1         RBM and GBM: all units are independent, given r. Triway: unobserved relations
                    are summed out. The objects are independent in the local form and are sampled
                    one after another in the seed form.
    r  | v, h1      All units are independent. If relations imply each other, they are sampled in
                    groups. Each group is conditioned on the earlier groups (chain rule).

In the seed form of a Triway, ordinary block sampling cannot remove an object i while one of its
relations is on, because then p(v_i = 1) = 1. By default (`collapsed`), v is therefore sampled with
the relations of object i summed out. Contrastive divergence can sample v without this sum, because
its chains run for a single step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from training.machines.bernoulli import bernoulli, integers, uniform
from training.machines.distributed import widest
from training.machines.edges import Edges
from training.machines.machine import BoltzmannMachine, State
from training.machines.mean_field import Evidence, mean_field

_PROPOSAL_BLOCKS = 8
# Relations that imply each other are sampled in 2 · _RELATION_GROUPS groups.
_RELATION_GROUPS = 4
# A dense matrix product is faster with fewer chains than _CHAINS, or if the share of present
# objects exceeds _PRESENT.
_CHAINS = 16
_PRESENT = 0.12


@dataclass(frozen=True)
class Clamp:
    """Units that a Gibbs chain keeps at their value, and observed relations.

    Attributes:
        v, h1, h2: bool masks of the clamped units, broadcastable to `State`; None clamps no unit.
        edges, r, observed: observed relations, as in `Evidence`. In a Triway machine, both objects
            of an observed relation must be clamped as present.
        room: index of the room type of each chain, (chains,) int64.
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
            raise ValueError(
                "Clamp has only some of edges, r and observed; pass all three, or none of them"
            )

    @property
    def relations(self) -> tuple[Edges, Tensor, Tensor] | None:
        """Layout, values and observed flags of the observed relations, or None without them."""
        if self.edges is None or self.r is None or self.observed is None:
            return None
        return self.edges, self.r, self.observed


FREE = Clamp()


def initial_state(
    machine: BoltzmannMachine, v: Tensor, generator: torch.Generator, clamp: Clamp = FREE
) -> State:
    """Return the objects v, h1 and h2 sampled from their biases, and relations given v and h1."""
    rows = len(v)
    h1 = bernoulli(machine.context_bias(clamp.room).sigmoid().expand(rows, -1), generator)
    h2 = bernoulli(machine.c2.sigmoid().expand(rows, -1), generator)
    edges, r = sample_relations(machine, v, h1, generator, clamp)
    return State(v, h1, h2, r, edges)


def bare_state(machine: BoltzmannMachine, v: Tensor, h1: Tensor, h2: Tensor) -> State:
    """Return a state with all relations 0, for the local form.

    In the local form, unobserved relations have no effect on the other units.
    """
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
    """Run one sweep: sample the hidden units h1 and h2, the objects v and the relations r.

    Args:
        collapsed: True sums out the unobserved relations when v is sampled (Triway, seed form).
        relations: True samples r at the end of the sweep. In the local form, False keeps the old r
            and saves time if only v is needed.
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
    """Run the second half of a `gibbs_step`: given h1, sample h2, v and r."""
    h1, h2 = state.h1, state.h2
    if machine.spec.H2:
        sample = bernoulli(machine.second_layer_logits(h1).sigmoid(), generator)
        h2 = _keep(clamp.h2, h2, sample)
    v = machine.sample_objects(state, generator, held=clamp.v, collapsed=collapsed)
    v = _keep(clamp.v, state.v, v)
    if not relations:
        return replace(state, v=v, h2=h2)
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
    """Run `sweeps` Gibbs steps, and return the last state."""
    for _ in range(sweeps):
        state = gibbs_step(machine, state, generator, clamp, relations=relations)
    return state


def sample_h1(
    machine: BoltzmannMachine, state: State, generator: torch.Generator, clamp: Clamp = FREE
) -> Tensor:
    """Sample the hidden units h1 given v, r and h2, (chains, hidden units)."""
    x = presence_product(state.v, machine.W).add_(machine.context_bias(clamp.room))
    if machine.spec.H2:
        x = torch.addmm(x, state.h2, machine.J.T)
    if machine.relations_act and state.r.shape[-1]:
        x = x + machine.hidden_input(state.edges, state.r)
    prior = x.sigmoid_()
    if machine.relations_act or clamp.relations is None:
        return _keep(clamp.h1, state.h1, bernoulli(prior, generator))
    h1 = state.h1
    weight = _observed_weight(machine, state.v, h1, clamp.relations)
    block = integers(_PROPOSAL_BLOCKS, h1.shape, generator)
    for k in range(_PROPOSAL_BLOCKS):
        proposal = torch.where(block == k, bernoulli(prior, generator), h1)
        proposal = _keep(clamp.h1, h1, proposal)
        new = _observed_weight(machine, state.v, proposal, clamp.relations)
        accept = uniform(new.shape, generator, new.dtype).log() < new - weight
        h1 = torch.where(accept.unsqueeze(-1), proposal, h1)
        weight = torch.where(accept, new, weight)
    return h1


def presence_product(v: Tensor, W: Tensor) -> Tensor:
    """Return v @ W, (chains, hidden units), for binary v, as a sum of rows of W.

    A scene contains about a dozen of several hundred classes. A dense product therefore consists
    mostly of multiplications by zero.
    """
    if len(v) < _CHAINS:
        return v @ W
    # numpy lists the active units several times faster than torch.
    on = np.flatnonzero(v.detach().cpu().numpy() != 0)
    if on.size > _PRESENT * v.numel():
        return v @ W
    chains, classes = v.shape
    starts = on.searchsorted(np.arange(chains + 1) * classes)
    index, offsets = torch.from_numpy(on % classes), torch.from_numpy(starts)
    return embedding_bag(index, W, offsets, mode="sum", include_last_offset=True)


def sample_relations(
    machine: BoltzmannMachine,
    v: Tensor,
    h1: Tensor,
    generator: torch.Generator,
    clamp: Clamp = FREE,
) -> tuple[Edges, Tensor]:
    """Sample the relations r given v and h1. Observed relations keep their value.

    Returns:
        The units that can be 1 given v, and their values r, (chains, units). In a Triway machine,
        the units between the classes of `clamp.edges` come first.
    """
    edges, r, observed = machine.open_units(v, clamp.relations, widest(v, generator))
    logits, gate = machine.relation_logits(edges, v, h1), machine.gate(edges, v)
    if not machine.spec.G:
        return edges, torch.where(observed, r, bernoulli(logits.sigmoid() * gate, generator))
    context = mean_field(machine, Evidence(v, room=clamp.room)).y.sigmoid()
    group = _drawing_order(machine.between(edges, logits, edges.classes), generator).flatten(-3)
    for k in range(2 * _RELATION_GROUPS):
        p = (logits + machine.implied(edges, r, context)).sigmoid() * gate
        r = torch.where((group == k) & ~observed, bernoulli(p, generator), r)
    return edges, r


def _drawing_order(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return a random group number for each relation unit, (..., n, n) over pairs of classes.

    The units of relation a from i to j and from j to i are always in different groups.
    """
    group = integers(_RELATION_GROUPS, like.shape, generator)
    is_second = integers(2, like.shape, generator).triu(1)
    is_second = is_second + (1 - is_second.mT).tril(-1)
    return group + _RELATION_GROUPS * is_second


def _observed_weight(
    machine: BoltzmannMachine, v: Tensor, h1: Tensor, relations: tuple[Edges, Tensor, Tensor]
) -> Tensor:
    """Return the log-probability of the observed relations given v and h1, (chains,)."""
    edges, r, observed = relations
    logits = machine.relation_logits(edges, v, h1)
    return machine.relation_term(logits, machine.gate(edges, v), r, observed).sum(-1)


def _keep(mask: Tensor | None, old: Tensor, new: Tensor) -> Tensor:
    return new if mask is None else torch.where(mask, old, new)
