"""An RBM for comparisons, with the factorised weights of the Triway but without tri-way edges.

    E(v,r,h1) = - b·v - c1·h1 - v'W h1 - sum_t r_t (d_t + U_t·h1)
    U_t = P[a] + sum_k S[i,k] M[a,k] O[j,k]

The sum runs over the triples t = (a,i,j) seen in training. As in the RBM, relation units have no
gate. As in the Triway, the weights U between relations and h1 are products of S, O, M and P.
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn

from app.inference.variants import MachineSpec
from training.machines.machine import BoltzmannMachine
from training.machines.rbm import RBM, scale


class ProductRBM(RBM):
    """An RBM whose relation logits ℓ_t = d_t + U_t·h1 have factorised weights U."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        del self.U
        self.S = nn.Parameter(torch.zeros(spec.V, spec.K))
        self.O = nn.Parameter(torch.zeros(spec.V, spec.K))
        self.M = nn.Parameter(torch.zeros(spec.A, spec.K, spec.H1))
        self.P = nn.Parameter(torch.zeros(spec.A, spec.H1))

    def context_weights(self) -> Tensor:
        """Return the weights U, (triples, hidden units), computed from the factors."""
        relation, subject, object_ = self.triples.long().unbind(1)
        product = self.S[subject] * self.O[object_]
        # The triples are sorted by relation, so one matrix product for each relation is enough.
        sizes = torch.bincount(relation, minlength=self.spec.A).tolist()
        rows = [
            part @ M + P for part, M, P in zip(product.split(sizes), self.M, self.P, strict=True)
        ]
        return torch.cat(rows)

    @torch.no_grad()
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Scale the weights as in the RBM. Scaling M and P also scales U."""
        return scale(self, beta, base, keep=("b", "d"), fixed=("S", "O"))
