"""The machines of the paper with a relation unit for each triple seen in training: RBM and GBM.

The restricted Boltzmann machine (RBM) has one hidden layer for objects and relations:

    E(v,r,h1) = - b·v - c1·h1 - v'W h1 - sum_t r_t (d_t + U_t·h1)

The sum runs over the triples t = (relation a, subject class i, object class j) seen in training.
All other relations are always 0. The units have no gate, so r_t depends on its two objects only
through the hidden units h1. The general Boltzmann machine (GBM) has two layers and two-way
object–relation edges:

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2
                   - sum_t r_t (d_t + g_t v_i + g'_t v_j + U_t·h1)

These are the seed forms of the energy. `training.machines.machine` also defines the local form.
"""

from __future__ import annotations

import copy
from typing import Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from app.inference.variants import MachineSpec
from training.machines.bernoulli import bernoulli
from training.machines.edges import (
    Edges,
    PairEdges,
    find_triples,
    pair_edges,
    triple_edges,
    triple_keys,
)
from training.machines.machine import BoltzmannMachine, State


class RBM(BoltzmannMachine):
    """The RBM, with relation logits ℓ_t = d_t + U_t·h1 for the triples seen in training."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        self.d = nn.Parameter(torch.zeros(spec.T))
        self.U = nn.Parameter(torch.zeros(spec.T, spec.H1))

    @torch.no_grad()
    def start_relations(self, by_relation: Tensor, by_unit: Tensor, usual: Tensor) -> None:
        self.d.copy_(by_unit)

    def edges(self, classes: Tensor, counts: Tensor | None = None) -> Edges:
        """Return all relation units of the machine, whatever the classes are."""
        return triple_edges(self.triples)

    def places(self, pairs: PairEdges) -> tuple[Edges, Tensor, Tensor]:
        """Find the relations of `pairs` in the table of triples."""
        keys = triple_keys(pairs.relation, pairs.subject, pairs.object, self.spec.V)
        return triple_edges(self.triples), *find_triples(self.triple_keys, keys)

    def lay_out(
        self, classes: Tensor, counts: Tensor, holds: Tensor, observed: Tensor
    ) -> tuple[Edges, Tensor, Tensor]:
        # Relations without a unit are left out.
        pairs = pair_edges(classes, holds.shape[1])
        edges, position, exists = self.places(pairs)
        row, slot = (exists & pairs.valid).nonzero(as_tuple=True)
        unit = position[row, slot]
        r = torch.zeros(len(classes), self.spec.T)
        r[row, unit] = holds.flatten(1)[row, slot]
        annotated = observed.flatten(1).any(1)
        unit_observed = annotated.unsqueeze(1).expand(-1, self.spec.T).clone()
        unit_observed[row, unit] = observed.flatten(1)[row, slot]
        return edges, r, unit_observed

    def open_units(
        self, v: Tensor, observed: tuple[Edges, Tensor, Tensor] | None, least: int = 0
    ) -> tuple[Edges, Tensor, Tensor]:
        if observed is not None:
            return observed
        r = v.new_zeros(len(v), self.spec.T)
        return triple_edges(self.triples), r, torch.zeros_like(r, dtype=torch.bool)

    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        # The units have no gate.
        return edges.valid.to(v.dtype).expand(*v.shape[:-1], -1)

    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        return self.d + h1 @ self.U.T

    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        return weight @ self.U

    def relation_context(self, edges: Edges) -> Tensor:
        return self.U.unsqueeze(0)

    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        # Given h1, the relations have no effect on objects.
        return h1.new_zeros(*h1.shape[:-1], candidates.shape[-1])

    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        pairs = pair_edges(classes, self.spec.A)
        _, position, exists = self.places(pairs)
        if not self.spec.T:
            return pairs.unflatten(torch.full(exists.shape, -torch.inf))
        spread = values.gather(1, position)
        return pairs.unflatten(torch.where(exists & pairs.valid, spread, -torch.inf))

    def acting_units(self, v: Tensor) -> Edges | None:
        return triple_edges(self.triples) if self.relations_act else None

    @torch.no_grad()
    def begin_independent(self, machine: BoltzmannMachine) -> None:
        self.d.copy_(machine.get_parameter("d"))

    def relation_log_partition(self) -> float:
        return float(softplus(self.d).sum()) if self.relations_act else 0.0

    @torch.no_grad()
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        # With a base, the biases d and b are interpolated between `base` and this machine.
        return scale(self, beta, base, keep=("b", "d"))


class GBM(RBM):
    """The GBM: an RBM with relation logits ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        self.g = nn.Parameter(torch.zeros(spec.T, 2))

    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        subject, object_ = v[..., edges.subject[0]], v[..., edges.object[0]]
        two_way = subject * self.g[:, 0] + object_ * self.g[:, 1]
        return super().relation_logits(edges, v, h1) + two_way

    def sample_objects(
        self, state: State, generator: torch.Generator, *, held: Tensor | None, collapsed: bool
    ) -> Tensor:
        logits, r, edges = self._object_input(state.h1), state.r, state.edges
        if self.relations_act:
            # Class i receives sum_t r_t (g_t [i = subject of t] + g'_t [i = object of t]).
            active = r.new_zeros(*r.shape[:-1], self.spec.V)
            active = active.index_add(-1, edges.subject[0], r * self.g[:, 0])
            logits = logits + active.index_add(-1, edges.object[0], r * self.g[:, 1])
        return bernoulli(logits.sigmoid_(), generator)

    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """Return the sum of softplus(ℓ at v_i = 1) - softplus(ℓ at v_i = 0) over relations of i.

        In the local form, the part of each candidate i is 0.
        """
        if not self.relations_act:
            return super().attraction(v, h1, edges, candidates)
        subject, object_ = edges.subject[0], edges.object[0]
        bare = RBM.relation_logits(self, edges, v, h1)
        g, g2 = self.g.unbind(1)
        loop = (subject == object_).to(v.dtype)
        off = bare + v[..., object_] * g2 * (1 - loop)
        as_subject = softplus(off + g + g2 * loop) - softplus(off)
        off = bare + v[..., subject] * g
        as_object = (softplus(off + g2) - softplus(off)) * (1 - loop)
        shape = torch.broadcast_shapes(as_subject.shape, as_object.shape)
        total = bare.new_zeros(*shape[:-1], self.spec.V)
        total = total.index_add(-1, subject, as_subject.expand(shape))
        total = total.index_add(-1, object_, as_object.expand(shape))
        return total.gather(-1, candidates.expand(*total.shape[:-1], candidates.shape[-1]))

    @torch.no_grad()
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Scale the weights as in the RBM, and multiply the two-way weights g by beta."""
        return scale(self, beta, base, keep=("b", "d"))


Machine = TypeVar("Machine", bound=BoltzmannMachine)


def scale(
    machine: Machine,
    beta: float,
    base: BoltzmannMachine | None,
    keep: tuple[str, ...],
    fixed: tuple[str, ...] = (),
) -> Machine:
    """Return a copy of the machine whose parameters θ are multiplied by beta.

    Args:
        base: machine at beta = 0, or None.
        keep: names of parameters that become beta·θ + (1 - beta)·θ_base if there is a base.
        fixed: names of parameters that stay unchanged. Each is a factor of a product, and beta may
            multiply only one factor of a product.
    """
    result = copy.copy(machine)
    result._parameters = {}
    for name, parameter in machine.named_parameters():
        value = parameter.detach()
        if name not in fixed:
            value = value * beta
        if base is not None and name in keep:
            value = value + (1 - beta) * base.get_parameter(name).detach()
        result._parameters[name] = nn.Parameter(value, requires_grad=False)
    return result
