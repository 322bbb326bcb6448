"""Mean field: the factorial approximation of p(h1, h2 | v, observed r).

The means m1 of h1 and m2 of h2 are updated in turn, with damping. At the start, m2 is the prior
mean of h2.

    m2 = sigmoid(c2 + m1'J),   y = c1 + v'W + J m2 + sum_e slope_e(m1) U_e,   m1 = sigmoid(y)

The energy has two forms, seed and local (`training.machines.machine`). In the seed form, slope_e is
r_e for an observed relation unit e. For other units, slope_e is the derivative of
`BoltzmannMachine.relation_term` with respect to the logit. With one hidden layer, the result is
exact in two cases: a seed form with all relations observed, and a local form with all relations
unobserved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from app.inference.weights import SWEEPS
from training.machines.edges import Edges
from training.machines.machine import BoltzmannMachine


@dataclass(frozen=True)
class Evidence:
    """The evidence of some scenes: their observed objects, relations and room types.

    Attributes:
        v: presence of objects, (scenes, classes).
        edges: layout of the relation units that can be 1.
        r, observed: values, and bool mask, of the observed relations, (scenes, units). Unobserved
            relations are 0.
        room: index of each scene's room type, (scenes,) int64. None or -1 means unknown.
    """

    v: Tensor
    edges: Edges | None = None
    r: Tensor | None = None
    observed: Tensor | None = None
    room: Tensor | None = None

    def relations(self, machine: BoltzmannMachine) -> tuple[Edges, Tensor, Tensor] | None:
        """Return layout, values and observed flags of the relation units.

        The result is None if relations do not affect the hidden units. In the local form, only
        observed relations affect the hidden units.
        """
        if self.edges is None or not self.edges.shape[-1]:
            return None
        shape = (len(self.v), self.edges.shape[-1])
        if self.r is None or self.observed is None:
            if not machine.relations_act:
                return None
            zeros = self.v.new_zeros(shape)
            return self.edges, zeros, torch.zeros_like(zeros, dtype=torch.bool)
        if not machine.relations_act and not bool(self.observed.any()):
            return None
        return self.edges, self.r, self.observed


@dataclass(frozen=True)
class MeanField:
    """The mean-field fixed point: logits y of h1, logits x without relations, and means h2."""

    y: Tensor
    x: Tensor
    h2: Tensor


def mean_field(
    machine: BoltzmannMachine,
    evidence: Evidence,
    *,
    iterations: int = SWEEPS,
    damping: float = 0.8,
    pull: float = 1.0,
) -> MeanField:
    """Return the mean-field fixed point of h1 and h2, differentiable in the weights.

    Args:
        iterations: number of sweeps over both hidden layers.
        damping: share of the previous slope_e that remains after a sweep; see the module.
        pull: weight of the observed relations. Below 1, the result is an interpolation to the fixed
            point without relations.
    """
    if pull < 1 and evidence.observed is not None and evidence.relations(machine) is not None:
        unobserved = torch.zeros_like(evidence.observed)
        without, with_all = (
            mean_field(machine, e, iterations=iterations, damping=damping)
            for e in (replace(evidence, observed=unobserved), evidence)
        )
        pairs = zip(vars(without).values(), vars(with_all).values(), strict=True)
        return MeanField(*(torch.lerp(value, full_value, pull) for value, full_value in pairs))
    base = x = machine.context_bias(evidence.room) + evidence.v @ machine.W
    relations = evidence.relations(machine)
    two_layers = machine.spec.H2 > 0
    h2 = base.new_zeros(len(base), 0)
    if relations is None and not two_layers:
        return MeanField(base, base, h2)
    if two_layers:
        h2 = machine.c2.sigmoid().expand(len(base), -1)
        x = torch.addmm(base, h2, machine.J.T)
    # `added` is the contribution of relations to the hidden logits. In the seed form with all
    # relations observed, it is linear in r.
    added = gate = base.new_zeros(())
    slopes = None
    if relations is not None:
        edges, r, observed = relations
        gate = machine.gate(edges, evidence.v)
        if machine.relations_act and bool((observed | (gate == 0)).all()):
            added, relations = machine.hidden_input(edges, r * gate), None
    for _ in range(iterations if two_layers or relations is not None else 0):
        if relations is not None:
            edges, r, observed = relations
            logits = machine.relation_logits(edges, evidence.v, (x + added).sigmoid())
            slope = machine.relation_slope(logits, gate, r, observed)
            slopes = slope if slopes is None else damping * slopes + (1 - damping) * slope
            added = machine.hidden_input(edges, slopes)
        if two_layers:
            h2 = machine.second_layer_logits((x + added).sigmoid()).sigmoid()
            x = torch.addmm(base, h2, machine.J.T)
    return MeanField(x + added, x, h2)
