"""The restricted Boltzmann machine (RBM) of the paper: one hidden layer for objects and relations.

    E(v,r,h1) = - b·v - c1·h1 - v'W h1 - sum_t r_t (d_t + U_t·h1)

Only triples t = (a,i,j) seen in training have a relation unit. All other relations are always 0.
The units have no gate, so r_t depends on its two objects only through the hidden units h1. This is
the seed form of the energy. `training.machines.machine` also defines the local form.
"""

from __future__ import annotations

import copy
from typing import Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from app.inference.variants import MachineSpec
from training.machines.edges import (
    Edges,
    PairEdges,
    find_triples,
    pair_edges,
    triple_edges,
    triple_keys,
)
from training.machines.machine import BoltzmannMachine


class RBM(BoltzmannMachine):
    """The RBM, with relation logits ℓ_t = d_t + U_t·h1 for the triples seen in training."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        self.d = nn.Parameter(torch.zeros(spec.T))
        self.U = nn.Parameter(torch.zeros(spec.T, spec.H1))

    @torch.no_grad()
    def start_relations(self, by_relation: Tensor, by_unit: Tensor, usual: Tensor) -> None:
        """Set the bias d_t to the training log-odds of each relation unit t."""
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
        """Return the relations in this machine's layout. Relations without a unit are left out."""
        pairs = pair_edges(classes, holds.shape[1])
        edges, position, found = self.places(pairs)
        row, slot = (found & pairs.valid).nonzero(as_tuple=True)
        unit = position[row, slot]
        r = torch.zeros(len(classes), self.spec.T)
        r[row, unit] = holds.flatten(1)[row, slot]
        annotated = observed.flatten(1).any(1)
        known = annotated.unsqueeze(1).expand(-1, self.spec.T).clone()
        known[row, unit] = observed.flatten(1)[row, slot]
        return edges, r, known

    def open_units(
        self, v: Tensor, given: tuple[Edges, Tensor, Tensor] | None, least: int = 0
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return all relation units, with the values of the given relations."""
        if given is not None:
            return given
        r = v.new_zeros(len(v), self.spec.T)
        return triple_edges(self.triples), r, torch.zeros_like(r, dtype=torch.bool)

    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        """Return 1 for every unit of the table, because units have no gate."""
        return edges.valid.to(v.dtype).expand(*v.shape[:-1], -1)

    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        """Return the logit d_t + U_t·h1 of each relation unit t."""
        return self.d + h1 @ self.U.T

    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        """Return weight @ U, the input of the relations to the hidden units."""
        return weight @ self.U

    def relation_context(self, edges: Edges) -> Tensor:
        """Return the weights U with a leading scene dimension, (1, triples, hidden units)."""
        return self.U.unsqueeze(0)

    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """Return zero, because given h1 the relations have no effect on objects."""
        return h1.new_zeros(*h1.shape[:-1], candidates.shape[-1])

    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        """Return values of relation units as a table over classes; -inf where no unit exists."""
        pairs = pair_edges(classes, self.spec.A)
        _, position, found = self.places(pairs)
        if not self.spec.T:
            return pairs.unflatten(torch.full(found.shape, -torch.inf))
        spread = values.gather(1, position)
        return pairs.unflatten(torch.where(found & pairs.valid, spread, -torch.inf))

    def acting_units(self, v: Tensor) -> Edges | None:
        """Return all relation units in the seed form, and None in the local form."""
        return triple_edges(self.triples) if self.relations_act else None

    @torch.no_grad()
    def begin_independent(self, machine: BoltzmannMachine) -> None:
        """Copy the relation biases d from `machine`."""
        self.d.copy_(machine.get_parameter("d"))

    def relation_log_partition(self) -> float:
        """Return sum_t softplus(d_t) over relation units t in the seed form, else 0."""
        return float(softplus(self.d).sum()) if self.relations_act else 0.0

    @torch.no_grad()
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Multiply every weight by beta.

        If there is a `base`, the biases d and b are interpolated between `base` and this machine.
        """
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
