"""The machines of the paper with a relation unit for each triple seen in training: RBM and GBM.

The RBM has the relation logits ℓ_t = d_t + U_t·h1 of triples t = (relation a, classes i, j), and
no gate. All other relations are 0. The general Boltzmann machine (GBM) adds two-way weights between
relations and objects: ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1. The GBM of the paper has a second
hidden layer, which `training.seed` keeps.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from app.inference.variants import MachineSpec
from training.machines.edges import (
    Edges,
    LaidOut,
    SceneRelations,
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
    def start_relations(
        self,
        by_relation: Float[Tensor, "A"],
        by_unit: Float[Tensor, "T"],
        mean_log_counts: Float[Tensor, "V"],
    ) -> None:
        """Set the bias d of each triple to its log-odds in a scene; other statistics are unused."""
        self.d.copy_(by_unit)

    def edges(self, classes: Int[Tensor, "B n"], counts: Int[Tensor, "B n"] | None = None) -> Edges:
        """Return all relation units of the machine, whatever the classes are."""
        return triple_edges(self.triples)

    def lay_out(self, scenes: SceneRelations) -> LaidOut:
        """Return the units of all triples, their values (B, T), and which are observed.

        Relations without a unit are left out. Units of absent classes are 0, and observed if any
        relation of the scene is.
        """
        pairs = pair_edges(scenes.classes, scenes.holds.shape[1])
        keys = triple_keys(pairs.relation, pairs.subject, pairs.object, self.spec.V)
        position, exists = find_triples(self.triple_keys, keys)
        row, slot = (exists & pairs.valid).nonzero(as_tuple=True)
        unit = position[row, slot]
        holds, annotated = scenes.holds.flatten(1), scenes.observed.flatten(1)
        r = torch.zeros(len(holds), self.spec.T)
        r[row, unit] = holds[row, slot]
        observed = annotated.any(1, keepdim=True).repeat(1, self.spec.T)
        observed[row, unit] = annotated[row, slot]
        return triple_edges(self.triples), r, observed

    def gate(self, edges: Edges, v: Float[Tensor, "... B V"]) -> Float[Tensor, "... B E"]:
        # The units have no gate.
        return edges.valid.to(v.dtype).expand(*v.shape[:-1], -1)

    def relation_logits(
        self, edges: Edges, v: Float[Tensor, "... B V"], h1: Float[Tensor, "... B H1"]
    ) -> Float[Tensor, "... B E"]:
        """Return ℓ_t of all triples. It depends on the hidden units only."""
        return self.d + h1 @ self.U.T


class GBM(RBM):
    """The GBM: an RBM with relation logits ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        self.g = nn.Parameter(torch.zeros(spec.T, 2))

    def relation_logits(
        self, edges: Edges, v: Float[Tensor, "... B V"], h1: Float[Tensor, "... B H1"]
    ) -> Float[Tensor, "... B E"]:
        """Return ℓ_t of all triples. It also depends on the presence of classes i and j."""
        # The units are the same for all scenes, so `edges` has a single row.
        subject, object_ = v[..., edges.subject[0]], v[..., edges.object[0]]
        two_way = subject * self.g[:, 0] + object_ * self.g[:, 1]
        return super().relation_logits(edges, v, h1) + two_way
