"""The Triway machine: shared weights connect each relation to two present objects and the context.

    ℓ_e(h1) = d_a + w_e + U_e·h1,       e = (a, i, j),   gate g_e = v_i v_j
    w_e = s[a,i] + o[a,j] + sum_k S[i,k] R[a,k] O[j,k] + w_e' + n[a,0] log n_i + n[a,1] log n_j
    U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]

Products of the factors S, O, R and M replace a free weight for each triple (a,i,j). Triples seen in
training also have a free residual weight w'. n_i and n_j are the numbers of instances: a relation
between classes holds if it holds between any two instances. An unknown log n_i is its class mean.

With G > 0, the observed relations r_G also change the logits of other relations: if A is left of B
and B is left of C, then A is left of C. Units that are independent given h1 cannot represent this.

    log-odds of r_e given r_G  =  ℓ_e(h1) + x_e(r_G)
    x_e = sum_f (gamma[0,a,f] + sum_q z_q gamma[q,a,f]) phi_f(i, j; r_G),    z = B E[h1 | v]

The model is conditioned on r_G and has no energy term for it. All other conditionals keep their
closed form. The rules depend on h1 through z, because some data sets annotate every visible pair
and others only a few. The features phi_f use the A relations in both directions, so b and c are 2A
relations. The features of r_e never use r_e itself:

    pair      r_b(i, j)                                              2A features
    path      there is a class k with r_b(i, k) and r_c(k, j)        (2A)² features
    degree    number of classes k other than j with r_b(i, k)        2A features, each at most 3
              number of classes k other than i with r_b(k, j)        2A features, each at most 3

Source: Mnih, Larochelle and Hinton, "Conditional restricted Boltzmann machines for structured
output prediction" (2011), for models that are conditioned on observed units.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding

from app.inference.variants import MachineSpec, feature_count
from training.machines.edges import (
    Edges,
    LaidOut,
    PairEdges,
    SceneRelations,
    find_triples,
    pair_edges,
    triple_keys,
)
from training.machines.machine import BoltzmannMachine

# Maximum of a degree feature. Degrees are capped, because more neighbours add little information.
_MOST = 3.0


class Triway(BoltzmannMachine):
    """A machine whose relation units connect two present objects and the hidden units."""

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__(spec)
        V, A, K, H1 = spec.V, spec.A, spec.K, spec.H1
        self.d = nn.Parameter(torch.zeros(A))
        self.s = nn.Parameter(torch.zeros(A, V))
        self.o = nn.Parameter(torch.zeros(A, V))
        self.S = nn.Parameter(torch.zeros(V, K))
        self.O = nn.Parameter(torch.zeros(V, K))
        self.R = nn.Parameter(torch.zeros(A, K))
        self.M = nn.Parameter(torch.zeros(A, K, H1))
        self.P = nn.Parameter(torch.zeros(A, H1))
        self.n = nn.Parameter(torch.zeros(A, 2))
        self.usual = nn.Parameter(torch.zeros(V))  # mean log n_i, used if n_i is unknown
        self.residual = nn.Parameter(torch.zeros(spec.T))  # w'
        if spec.G:
            self.gamma = nn.Parameter(torch.zeros(1 + spec.G, A, feature_count(A)))
            self.B = nn.Parameter(torch.zeros(spec.G, H1))

    @torch.no_grad()
    def start_relations(
        self,
        by_relation: Float[Tensor, "A"],
        by_unit: Float[Tensor, "T"],
        mean_log_counts: Float[Tensor, "V"],
    ) -> None:
        """Set d to the log-odds of each relation, and `usual`. Single triples keep the weight 0."""
        self.d.copy_(by_relation)
        self.usual.copy_(mean_log_counts)

    def edges(
        self, classes: Int[Tensor, "B n"], counts: Int[Tensor, "B n"] | None = None
    ) -> PairEdges:
        """Return the A·n² relation units between n classes. All other units are 0."""
        if counts is None:
            return pair_edges(classes, self.spec.A)
        mean_log_counts = self.usual[classes.clamp(min=0)]
        logs = torch.where(counts > 0, counts.clamp(min=1).to(self.b.dtype).log(), mean_log_counts)
        return pair_edges(classes, self.spec.A, logs)

    def lay_out(self, scenes: SceneRelations) -> LaidOut:
        # A flattened table has the layout of this machine.
        edges = self.edges(scenes.classes, scenes.counts)
        return edges, scenes.holds.flatten(1), scenes.observed.flatten(1)

    def gate(self, edges: Edges, v: Float[Tensor, "... B V"]) -> Float[Tensor, "... B E"]:
        ends = (index.expand(*v.shape[:-1], -1) for index in (edges.subject, edges.object))
        subject, object_ = (v.gather(-1, index) for index in ends)
        return subject * object_ * edges.valid

    def relation_logits(
        self, edges: Edges, v: Float[Tensor, "... B V"], h1: Float[Tensor, "... B H1"]
    ) -> Float[Tensor, "... B E"]:
        """Return the logits ℓ_e of all relations between the n classes of each scene, flattened."""
        pairs = _pairs(edges)
        # R[a,k] + M[a,k]·h1, so that one product over k gives both terms with S and O.
        shared = self.R + torch.einsum("akh,...bh->...bak", self.M, h1)
        left = embedding(pairs.classes, self.S).unsqueeze(-3) * shared.unsqueeze(-2)
        product = left.flatten(-3, -2) @ embedding(pairs.classes, self.O).mT
        product = product.unflatten(-2, left.shape[-3:-1])  # (..., B, A, n, n)
        bias = self.d + h1 @ self.P.T
        # s[a,i] + n[a,0] log n_i of the subjects i, and o[a,j] + n[a,1] log n_j of the objects j.
        subject, object_ = (
            weights[:, pairs.classes].transpose(0, 1) + n.unsqueeze(1) * pairs.log_counts[:, None]
            for weights, n in zip((self.s, self.o), self.n.unbind(1), strict=True)
        )
        pair_bias = (subject + bias.unsqueeze(-1)).unsqueeze(-1) + object_.unsqueeze(-2)
        logits: Tensor = product + pair_bias
        if self.spec.T:  # add the residual weights w' of the triples that have one
            keys = triple_keys(pairs.relation, pairs.subject, pairs.object, self.spec.V)
            position, exists = find_triples(self.triple_keys, keys)
            logits = logits + pairs.unflatten(self.residual[position] * exists)
        return logits.flatten(-3)

    def implied(
        self, edges: Edges, observed: Float[Tensor, "B E"], h1: Float[Tensor, "B H1"]
    ) -> Float[Tensor, "B E"]:
        """Return the changes x_e of the logits by observed relations r_G; 0 without rules."""
        if not self.spec.G:
            return super().implied(edges, observed, h1)
        return implied(self.gamma, self.B, _pairs(edges).unflatten(observed), h1).flatten(-3)


def _pairs(edges: Edges) -> PairEdges:
    """Return the edges, or raise TypeError if they are not `PairEdges`."""
    if not isinstance(edges, PairEdges):
        raise TypeError(
            "edges have the wrong type; a Triway machine needs PairEdges: build them with "
            "machine.edges(classes)"
        )
    return edges


def implication_features(observed: Float[Tensor, "B A n n"]) -> Float[Tensor, "B F n n"]:
    """Return the features phi of relations that are observed to hold, over pairs of classes.

    The F features are in the order of the module: 2A of pairs, (2A)² of paths and 4A degrees.
    """
    n = observed.shape[-1]
    between = observed * ~torch.eye(n, dtype=torch.bool)
    directed = torch.cat([between, between.mT], 1)  # the A relations in both directions
    kinds = directed.shape[1]
    # One batched product counts the paths of all relation pairs: (B, 2A·n, n) by (B, n, 2A·n).
    paths = directed.flatten(1, 2) @ directed.transpose(1, 2).flatten(2)
    paths = paths.view(len(observed), kinds, n, kinds, n).transpose(2, 3).flatten(1, 2).clamp(max=1)
    # Degrees of the pair (i, j) leave out the relation between i and j itself.
    outgoing = directed.sum(-1, keepdim=True) - directed
    incoming = directed.sum(-2, keepdim=True) - directed
    degrees = torch.cat([outgoing, incoming], 1).clamp(max=_MOST)
    return torch.cat([directed, paths, degrees], 1)


def implied(
    gamma: Float[Tensor, "1+G A F"],
    B: Float[Tensor, "G H1"],
    observed: Float[Tensor, "B A n n"],
    h1: Float[Tensor, "B H1"],
) -> Float[Tensor, "B A n n"]:
    """Return the changes x of the relation logits by observed relations, given means of h1."""
    A = observed.shape[1]
    # The first A features are the pair features. That of relation a is r_e itself: weight 0.
    itself = torch.zeros(gamma.shape[1:], dtype=torch.bool)
    itself[:, :A].fill_diagonal_(True)
    gamma = gamma.masked_fill(itself, 0.0)
    weight = gamma[0] + torch.einsum("bq,qaf->baf", h1 @ B.T, gamma[1:])
    return (weight @ implication_features(observed).flatten(2)).view(observed.shape)
