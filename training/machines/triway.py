"""The Triway machine: shared weights connect each relation to two present objects and the context.

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2 - sum_{e=(a,i,j)} r_e v_i v_j ℓ_e(h1)
    ℓ_e(h1) = d_a + w_e + U_e·h1
    w_e = s[a,i] + o[a,j] + sum_k S[i,k] R[a,k] O[j,k] + w_e' + n[a,0] log n_i + n[a,1] log n_j
    U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]

The published code multiplies w by v_i v_j, but not U. Here, both are multiplied by v_i v_j, and a
relation can be 1 only between present objects (r_e ≤ v_i v_j). Products of the factors S, O, R and
M replace a free weight for each triple (a,i,j). Triples seen in training also have a free residual
weight w'. n_i and n_j are the numbers of instances of the two classes. Their logs enter with the
weights n, because a relation between classes holds if it holds between any two instances. If a
number of instances is unknown, the mean log n_i of the class is used.

With G > 0 (local form), the observed relations r_G also change the logits of other relations. For
example, if A is left of B and B is left of C, then A is left of C. Relation units that are
independent given h1 cannot represent such a rule.

    log-odds of r_e given r_G  =  ℓ_e(h1) + x_e(r_G),       e = (a, i, j)
    x_e = sum_f (gamma[0,a,f] + sum_q z_q gamma[q,a,f]) phi_f(i, j; r_G),    z = B E[h1 | v]

The model is conditioned on r_G and has no energy term for r_G. All other conditionals keep their
closed form. Without observed relations, x = 0. The strength of the rules depends on the hidden
units through z, because some data sets annotate every visible pair and others only a few. The
features phi_f use the A relations in both directions, so b and c are 2A relations. The features of
r_e never use r_e itself:

    pair      r_b(i, j)                                              2A features
    path      there is a class k with r_b(i, k) and r_c(k, j)        (2A)² features
    degree    number of classes k other than j with r_b(i, k)        2A features, each at most 3
              number of classes k other than i with r_b(k, j)        2A features, each at most 3

Forms of the energy: `seed` is the energy above, minus κ_a for each pair of present classes and each
relation a. κ is 0 in the paper. `local` adds softplus(ℓ_e) instead.

The rules follow Mnih, Larochelle and Hinton, "Conditional restricted Boltzmann machines for
structured output prediction" (2011), whose model is also conditioned on observed units.
"""

from __future__ import annotations

import math
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding, softplus

from app.inference.variants import MachineSpec, feature_count
from training.machines.bernoulli import bernoulli
from training.machines.edges import (
    Edges,
    PairEdges,
    find_triples,
    pair_edges,
    present_classes,
    triple_keys,
)
from training.machines.machine import BoltzmannMachine, State
from training.machines.rbm import scale

# Maximum of a degree feature. Degrees are capped, because more neighbours add little information.
_MOST = 3.0


class Triway(BoltzmannMachine):
    """A machine whose relation units connect two present objects and the hidden units."""

    has_residuals = True

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
        self.usual = nn.Parameter(torch.zeros(V))
        self.residual = nn.Parameter(torch.zeros(spec.T))
        if spec.G:
            self.gamma = nn.Parameter(torch.zeros(1 + spec.G, A, feature_count(A)))
            self.B = nn.Parameter(torch.zeros(spec.G, H1))
        self.kappa = nn.Parameter(torch.zeros(A), requires_grad=False)

    @torch.no_grad()
    def start_relations(self, by_relation: Tensor, by_unit: Tensor, usual: Tensor) -> None:
        self.d.copy_(by_relation)
        self.usual.copy_(usual)

    def edges(self, classes: Tensor, counts: Tensor | None = None) -> PairEdges:
        """Return the A·n² relation units between n classes. All other units are 0."""
        if counts is None:
            return pair_edges(classes, self.spec.A)
        usual = self.usual[classes.clamp(min=0)]
        logs = torch.where(counts > 0, counts.clamp(min=1).to(self.b.dtype).log(), usual)
        return pair_edges(classes, self.spec.A, log_subjects=logs)

    def places(self, pairs: PairEdges) -> tuple[Edges, Tensor, Tensor]:
        index = torch.arange(pairs.shape[-1]).expand(pairs.shape)
        return pairs, index, torch.ones_like(index, dtype=torch.bool)

    def lay_out(
        self, classes: Tensor, counts: Tensor, holds: Tensor, observed: Tensor
    ) -> tuple[Edges, Tensor, Tensor]:
        # A flattened table has the layout of this machine.
        return self.edges(classes, counts), holds.flatten(1), observed.flatten(1)

    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        return edges.ends_present(v)

    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        pairs = _pairs(edges)
        shared = self.R + torch.einsum("akh,...bh->...bak", self.M, h1)
        left = embedding(pairs.subjects, self.S).unsqueeze(-3) * shared.unsqueeze(-2)
        product = left.flatten(-3, -2) @ embedding(pairs.objects, self.O).mT
        product = product.unflatten(-2, left.shape[-3:-1])
        bias = self.d + h1 @ self.P.T
        subject, object_ = self._end_weights(pairs)
        ends = (subject + bias.unsqueeze(-1)).unsqueeze(-1) + object_.unsqueeze(-2)
        logits: Tensor = product + ends
        return (logits + self._residuals(pairs) if self.spec.T else logits).flatten(-3)

    def _end_weights(self, pairs: PairEdges) -> tuple[Tensor, Tensor]:
        """Return the terms of the relation logits of only the subject or only the object class.

        The terms are s[a,i] + n[a,0] log n_i, (scenes, relations, n), for subjects i, and
        o[a,j] + n[a,1] log n_j, (scenes, relations, m), for objects j.
        """
        counts = self.n[:, 0, None] * pairs.log_subjects.unsqueeze(1)
        subject = self.s[:, pairs.subjects].transpose(0, 1) + counts
        counts = self.n[:, 1, None] * pairs.log_objects.unsqueeze(1)
        return subject, self.o[:, pairs.objects].transpose(0, 1) + counts

    def _residuals(self, pairs: PairEdges) -> Tensor:
        """Return the weight w_e' of each unit, (scenes, relations, n, m); 0 without a triple."""
        keys = triple_keys(pairs.relation, pairs.subject, pairs.object, self.spec.V)
        position, exists = find_triples(self.triple_keys, keys)
        return pairs.unflatten(self.residual[position] * exists)

    def implied(self, edges: Edges, observed: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
        if not self.spec.G:
            return super().implied(edges, observed, h1)
        grid = _pairs(edges).unflatten(observed)
        return implied(self.gamma, self.B, grid, h1, apart=apart).flatten(-3)

    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        pairs = _pairs(edges)
        grid = pairs.unflatten(weight)
        return self._context_input(self._factors(pairs, grid), grid.sum((-1, -2)))

    def linear_relations(self, edges: Edges, v: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
        pairs = _pairs(edges)
        grid = pairs.unflatten(r)
        factors, outgoing, incoming = self._factors(pairs, grid), grid.sum(-1), grid.sum(-2)
        count = outgoing.sum(-1)
        subject, object_ = self._end_weights(pairs)
        bare = (factors * self.R).sum((-1, -2)) + count @ self.d
        bare = bare + (outgoing * subject).sum((-1, -2)) + (incoming * object_).sum((-1, -2))
        if self.spec.T:
            bare = bare + (grid * self._residuals(pairs)).sum((-1, -2, -3))
        return bare, self._context_input(factors, count)

    def _factors(self, pairs: PairEdges, weight: Tensor) -> Tensor:
        """Return sum_{i,j} weight[a,i,j] S[i,k] O[j,k], (..., scenes, relations, K)."""
        # A product of (A·n, m) by (m, K) for each scene avoids a copy of O for each relation a.
        product: Tensor = weight.flatten(-3, -2) @ embedding(pairs.objects, self.O)
        product = product.unflatten(-2, weight.shape[-3:-1])
        subjects = embedding(pairs.subjects, self.S).unsqueeze(-3)
        return (product * subjects).sum(-2)

    def _context_input(self, factors: Tensor, count: Tensor) -> Tensor:
        """Return sum_{a,k} factors[a,k] M[a,k] + sum_a count_a P[a], (..., scenes, H1)."""
        return factors.flatten(-2) @ self.M.flatten(0, 1) + count @ self.P

    def held_objects(self, edges: Edges, r: Tensor) -> Tensor:
        """Return 1 for each class with a relation r = 1, else 0, (scenes, classes)."""
        pairs = _pairs(edges)
        grid = pairs.unflatten(r).amax(-3)
        is_held = r.new_zeros(len(r), self.spec.V)
        is_held.scatter_reduce_(1, pairs.subjects.expand(len(r), -1), grid.amax(-1), "amax")
        is_held.scatter_reduce_(1, pairs.objects.expand(len(r), -1), grid.amax(-2), "amax")
        return is_held

    def relation_context(self, edges: Edges) -> Tensor:
        pairs = _pairs(edges)
        subject, object_ = self.S[pairs.subjects], self.O[pairs.objects]
        product = subject.unsqueeze(-2) * object_.unsqueeze(-3)
        rows = torch.einsum("bijk,akh->baijh", product, self.M)
        return (rows + self.P[:, None, None]).flatten(1, 3)

    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        # The sum of softplus(ℓ_e) + κ_a over the relations of each candidate; 0 in the local form.
        pairs = _pairs(edges)
        ends = pairs.subjects, pairs.valid_subjects, pairs.log_subjects
        return self._attraction(v, h1, *ends, candidates)

    def attraction_to_all(self, v: Tensor, h1: Tensor, candidates: Tensor) -> Tensor:
        """Return `attraction` by relations to all present classes, with one instance of each."""
        anchors = torch.arange(self.spec.V).expand(len(h1), -1)
        valid = torch.ones_like(anchors, dtype=torch.bool)
        logs = torch.zeros(anchors.shape, dtype=h1.dtype)
        return self._attraction(v, h1, anchors, valid, logs, candidates)

    def _attraction(
        self,
        v: Tensor,
        h1: Tensor,
        anchors: Tensor,
        valid: Tensor,
        logs: Tensor,
        candidates: Tensor,
    ) -> Tensor:
        if not self.relations_act:
            return h1.new_zeros(*h1.shape[:-1], candidates.shape[-1])
        present = v.gather(-1, anchors.expand(*v.shape[:-1], -1)) * valid
        candidates = candidates.expand(len(anchors), -1)
        # Leave out relations of a candidate to its own class. Their units (a,i,i) are added below.
        is_other = (anchors.unsqueeze(-2) != candidates.unsqueeze(-1)) * present.unsqueeze(-2)
        A = self.spec.A
        outgoing = pair_edges(candidates, A, objects=anchors, log_objects=logs)
        incoming = pair_edges(anchors, A, objects=candidates, log_subjects=logs)
        forward = outgoing.unflatten(self.relation_logits(outgoing, v, h1))
        backward = incoming.unflatten(self.relation_logits(incoming, v, h1)).mT
        kappa = self.kappa[:, None, None]
        terms = softplus(forward) + softplus(backward) + 2 * kappa
        total = (terms * is_other.unsqueeze(-3)).sum((-1, -3))
        loop = self._loop_logits(candidates, h1)
        return total + (softplus(loop) + self.kappa).sum(-1)

    def _loop_logits(self, candidates: Tensor, h1: Tensor) -> Tensor:
        """Return the logits of the relations of each candidate to its own class, (..., A)."""
        shared = self.R + torch.einsum("akh,...bh->...bak", self.M, h1)
        product = (self.S * self.O)[candidates] @ shared.mT
        bias = (self.d + h1 @ self.P.T).unsqueeze(-2)
        logits = product + bias + (self.s + self.o).T[candidates]
        if not self.spec.T:
            return logits
        axis = torch.arange(self.spec.A, device=candidates.device)
        ends = candidates.unsqueeze(-1)
        position, exists = find_triples(
            self.triple_keys, triple_keys(axis, ends, ends, self.spec.V)
        )
        return logits + self.residual[position] * exists

    def open_units(
        self, v: Tensor, observed: tuple[Edges, Tensor, Tensor] | None, least: int = 0
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return the units between present classes; the classes of observed units come first.

        Raises:
            ValueError: the numbers of scenes in `observed` and in v differ.
        """
        frame = None if observed is None else _pairs(observed[0])
        if frame is not None and len(frame.subjects) != len(v):
            raise ValueError(f"observed relations must have one row per chain, {len(v)} rows")
        edges = self.edges(present_classes(v, None if frame is None else frame.subjects, least))
        r = self.b.new_zeros(edges.shape)
        is_observed = torch.zeros_like(r, dtype=torch.bool)
        if frame is not None and observed is not None:
            # unflatten() returns views, so both assignments change r and is_observed.
            n = frame.subjects.shape[1]
            edges.unflatten(is_observed)[..., :n, :n] = frame.unflatten(observed[2])
            edges.unflatten(r)[..., :n, :n] = frame.unflatten(observed[1] * observed[2])
        return edges, r, is_observed

    def sample_objects(
        self, state: State, generator: torch.Generator, *, held: Tensor | None, collapsed: bool
    ) -> Tensor:
        """Sample the objects v given the hidden units h1, (scenes, classes).

        In the seed form, `collapsed` samples the objects one after another. Without it, objects of
        relations with r = 1 stay present.

        Raises:
            ValueError: `collapsed` is False in a seed-form machine with κ.
        """
        if not self.relations_act:
            return super().sample_objects(state, generator, held=held, collapsed=collapsed)
        if collapsed:
            return self._collapsed_sweep(state.v.clone(), state.h1, held, generator)
        if bool(self.kappa.any()):
            raise ValueError(
                "collapsed=False needs a machine with κ = 0; with κ, the objects depend on each "
                "other even given h1 and r"
            )
        drawn = super().sample_objects(state, generator, held=held, collapsed=collapsed)
        return drawn.maximum(self.held_objects(state.edges, state.r))

    def _collapsed_sweep(
        self, v: Tensor, h1: Tensor, held: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        """Sample each class in turn given the others, with the relations summed out."""
        logits = self.object_logits(h1)
        for i in range(self.spec.V):
            gain = self.attraction_to_all(v, h1, torch.tensor([[i]]))[:, 0]
            sample = bernoulli((logits[:, i] + gain).sigmoid(), generator)
            if held is not None:
                sample = torch.where(held.expand_as(v)[:, i], v[:, i], sample)
            v[:, i] = sample
        return v

    def pair_offset(self, edges: Edges, v: Tensor) -> Tensor:
        if not bool(self.kappa.any()):
            return super().pair_offset(edges, v)
        gate = self.gate(edges, v)
        return _pairs(edges).unflatten(gate).sum((-1, -2)) @ self.kappa

    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        return _pairs(edges).unflatten(values)

    def acting_units(self, v: Tensor) -> Edges | None:
        if not self.relations_act:
            return None
        value, index = v.topk(int(v.sum(1).max()), dim=1)
        return self.edges(torch.where(value > 0, index, -1))

    def context_units(self, edges: Edges) -> Edges | None:
        return edges if self.relations_act else None

    @torch.no_grad()
    def begin_independent(self, machine: BoltzmannMachine) -> None:
        if self.relations_act:
            self.kappa.fill_(-math.log(2))

    @torch.no_grad()
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Multiply every weight by beta.

        With a base, b is interpolated with the b of the base, and κ with -log 2. At beta = 0, both
        states of a relation unit then have the weight 1/2. The sum over a relation is therefore 1,
        and objects are independent.
        """
        return scale(self, beta, base, keep=("b", "kappa"), fixed=("S", "O", "B", "usual"))


def _pairs(edges: Edges) -> PairEdges:
    if not isinstance(edges, PairEdges):
        raise TypeError(
            "edges have the wrong type; a Triway machine needs PairEdges: build them with "
            "machine.edges(classes)"
        )
    return edges


def implication_features(observed: Tensor) -> Tensor:
    """Return the features phi of observed relations, (scenes, features, n, n) over class pairs.

    The pair feature of relation a equals r_e itself, so `implied` does not use that feature for a.

    Args:
        observed: observed relations, (scenes, relations, n, n). 1 means that the relation holds.
    """
    n = observed.shape[-1]
    between = observed * ~torch.eye(n, dtype=torch.bool, device=observed.device)
    directed = torch.cat([between, between.mT], 1)
    kinds = directed.shape[1]
    # One batched product counts the paths of all relation pairs: (B, 2A·n, n) by (B, n, 2A·n).
    paths = directed.flatten(1, 2) @ directed.transpose(1, 2).flatten(2)
    paths = (
        paths.view(len(observed), kinds, n, kinds, n).transpose(2, 3).flatten(1, 2).clamp(max=1.0)
    )
    outgoing = directed.sum(-1, keepdim=True) - directed
    incoming = directed.sum(-2, keepdim=True) - directed
    degrees = torch.cat([outgoing, incoming], 1).clamp(max=_MOST)
    return torch.cat([directed, paths, degrees], 1)


def implied(
    gamma: Tensor, B: Tensor, observed: Tensor, h1: Tensor, *, apart: bool = False
) -> Tensor:
    """Return the changes x of the relation logits due to observed relations.

    The result has the shape (scenes, relations, n, n) over pairs of n classes.


    Args:
        gamma: weights of the features, (1 + G, relations, features).
        B: weights from hidden units to z, (G, hidden units).
        observed: observed relations, (scenes, relations, n, n). 1 means that the relation holds.
        h1: means of the hidden units given the objects, (scenes, hidden units).
        apart: True leaves out the effects between relations of the same pair of classes.
    """
    A = observed.shape[1]
    itself = torch.zeros(gamma.shape[1:], dtype=torch.bool, device=gamma.device)
    itself[:, :A].fill_diagonal_(True)
    if apart:
        # The path and degree features remain, because they depend on relations to other classes.
        itself[:, : 2 * A] = True
    gamma = gamma.masked_fill(itself, 0.0)
    weight = gamma[0] + torch.einsum("bq,qaf->baf", h1 @ B.T, gamma[1:])
    features = implication_features(observed)
    return (weight @ features.flatten(2)).view(observed.shape)
