"""The general Boltzmann machine of the seed paper: two layers and two-way object–relation edges.

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2
                   - sum_t r_t (d_t + g_t v_i + g'_t v_j + U_t·h1)

The sum runs over the triples t = (relation a, subject class i, object class j) seen in training.
This is the seed form of the energy. `training.machines.machine` also defines the local form.
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from app.inference.variants import MachineSpec
from training.machines.bernoulli import bernoulli
from training.machines.edges import Edges
from training.machines.machine import BoltzmannMachine
from training.machines.rbm import RBM, scale


class GBM(RBM):
    """The GBM: an RBM with relation logits ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        self.g = nn.Parameter(torch.zeros(spec.T, 2))

    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        """Return the logit d_t + g_t v_i + g'_t v_j + U_t·h1 of each relation unit t."""
        subject = v[..., edges.subject[0]]
        object_ = v[..., edges.object[0]]
        two_way = subject * self.g[:, 0] + object_ * self.g[:, 1]
        return super().relation_logits(edges, v, h1) + two_way

    def relation_input(self, edges: Edges, r: Tensor) -> Tensor:
        """Return the sum that active relations add to each object logit, (..., scenes, classes).

        Class i receives sum_t r_t (g_t [i is the subject of t] + g'_t [i is the object of t]).
        """
        result = r.new_zeros(*r.shape[:-1], self.spec.V)
        result = result.index_add(-1, edges.subject[0], r * self.g[:, 0])
        return result.index_add(-1, edges.object[0], r * self.g[:, 1])

    def sample_objects(
        self,
        v: Tensor,
        h1: Tensor,
        r: Tensor,
        edges: Edges,
        generator: torch.Generator,
        *,
        held: Tensor | None = None,
        collapsed: bool = True,
    ) -> Tensor:
        """Sample the objects v given h1. In the seed form, v also depends on the relations r."""
        logits = self._object_input(h1)
        if self.relations_act:
            logits = logits + self.relation_input(edges, r)
        return bernoulli(logits.sigmoid_(), generator)

    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """Return the part of each candidate's log-odds that comes from its unobserved relations.

        The result has the shape (..., scenes, candidates). In the seed form, the part of candidate
        i is the sum of softplus(ℓ at v_i = 1) - softplus(ℓ at v_i = 0) over the relations of i. In
        the local form, the part is 0.
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
