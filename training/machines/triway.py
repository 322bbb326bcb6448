"""The Triway machine: shared weights connect each relation to two present objects and the context.

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2 - sum_{e=(a,i,j)} r_e v_i v_j ℓ_e(h1)
    ℓ_e(h1) = d_a + w_e + U_e·h1
    w_e = s[a,i] + o[a,j] + sum_k S[i,k] R[a,k] O[j,k] + w_e' + n[a,0] log n_i + n[a,1] log n_j
    U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]

The published code gates w by v_i v_j and does not gate the relation–context weight. Here the state
space is {r_e ≤ v_i v_j}, so a relation can be on only between present objects. The factors S, O, R
and M share the weights, which replaces one free weight for each (a,i,j). The residual w' exists for
triples seen in training. n weighs the instance counts n_i and n_j of the two classes, because a
class-level relation is the OR over instance pairs. If a count is unknown, the usual log n_i of the
class is used.

With G > 0 (local form) observed relations r_G also shift the logits of other relations. For
example, if A is left of B and B is left of C, then A is left of C. Units that are independent given
h1 cannot represent such a rule.

    log-odds of r_e given r_G  =  ℓ_e(h1) + x_e(r_G),       e = (a, i, j)
    x_e = sum_f (gamma[0,a,f] + sum_q z_q gamma[q,a,f]) phi_f(i, j; r_G),    z = B E[h1 | v]

The model conditions on r_G, as it conditions on a room type. All other conditionals keep their
closed form. Without observed relations, x = 0. z makes the strength of the rules depend on the
context, because some sources list every visible pair and others only a few neighbours. The features
phi_f use the A relations in both directions (2A relations b and c), but never r_e itself:

    pair      r_b(i, j)                                              2A features
    path      there is a class k with r_b(i, k) and r_c(k, j)        (2A)² features
    degree    number of other classes k with r_b(i, k), and with     4A features, each at most 3
              r_b(k, j)

Forms: `seed` is the energy above, with a compensating offset κ_a for each active unit (0 in the
paper). `local` adds softplus(ℓ_e) for every active unit.

The implications follow Mnih, Larochelle and Hinton, "Conditional restricted Boltzmann machines for
structured output prediction" (2011), which conditions on observed units.
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
from training.machines.machine import BoltzmannMachine
from training.machines.rbm import scale

# Degrees are capped, because each further neighbour adds less information.
_MOST = 3.0


class Triway(BoltzmannMachine):
    """Gated, factorised relations on active pairs, in the seed form or the local form."""

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
        """Set d to the log-odds of each relation."""
        self.d.copy_(by_relation)
        self.usual.copy_(usual)

    def edges(self, classes: Tensor, counts: Tensor | None = None) -> PairEdges:
        """Return the A·n² units between the given classes; all other units are off.

        Args:
            counts: instances of each class; 0 means unknown and uses the usual count of the class.
        """
        if counts is None:
            return pair_edges(classes, self.spec.A)
        usual = self.usual[classes.clamp(min=0)]
        logs = torch.where(counts > 0, counts.clamp(min=1).to(self.b.dtype).log(), usual)
        return pair_edges(classes, self.spec.A, log_subjects=logs)

    def places(self, pairs: PairEdges) -> tuple[Edges, Tensor, Tensor]:
        """Return the pairs themselves, because every pair has a unit."""
        place = torch.arange(pairs.shape[-1]).expand(pairs.shape)
        return pairs, place, torch.ones_like(place, dtype=torch.bool)

    def lay_out(
        self, classes: Tensor, counts: Tensor, holds: Tensor, observed: Tensor
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return the relations flattened, without further changes."""
        return self.edges(classes, counts), holds.flatten(1), observed.flatten(1)

    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        """Return v_i v_j."""
        return edges.ends_present(v)

    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        """Return d_a + w_e + U_e·h1."""
        pairs = _pairs(edges)
        shared = self.R + torch.einsum("akh,...bh->...bak", self.M, h1)
        left = embedding(pairs.subjects, self.S).unsqueeze(-3) * shared.unsqueeze(-2)
        product = left.flatten(-3, -2) @ embedding(pairs.objects, self.O).mT
        product = product.unflatten(-2, left.shape[-3:-1])
        bias = self.d + h1 @ self.P.T
        subject, object_ = self._end_weights(pairs)
        ends = (subject + bias.unsqueeze(-1)).unsqueeze(-1) + object_.unsqueeze(-2)
        logits: Tensor = product + ends
        if self.spec.T:
            logits = logits + self._residuals(pairs)
        return logits.flatten(-3)

    def _end_weights(self, pairs: PairEdges) -> tuple[Tensor, Tensor]:
        """Return s[a,i] + n[a,0] log n_i, (B, A, n), and o[a,j] + n[a,1] log n_j, (B, A, m)."""
        counts = self.n[:, 0, None] * pairs.log_subjects.unsqueeze(1)
        subject = self.s[:, pairs.subjects].transpose(0, 1) + counts
        counts = self.n[:, 1, None] * pairs.log_objects.unsqueeze(1)
        return subject, self.o[:, pairs.objects].transpose(0, 1) + counts

    def _residuals(self, pairs: PairEdges) -> Tensor:
        """Return w_e', (B, A, n, m); 0 for triples not seen in training."""
        keys = triple_keys(pairs.relation, pairs.subject, pairs.object, self.spec.V)
        position, found = find_triples(self.triple_keys, keys)
        return pairs.unflatten(self.residual[position] * found)

    def implied(self, edges: Edges, given: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
        """Return the logit shifts x_e; zeros in a machine without the weights gamma and B."""
        if not self.spec.G:
            return super().implied(edges, given, h1)
        grid = _pairs(edges).unflatten(given)
        return implied(self.gamma, self.B, grid, h1, apart=apart).flatten(-3)

    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        """Return sum_e weight_e U_e from the factors, without forming U."""
        pairs = _pairs(edges)
        grid = pairs.unflatten(weight)
        return self._context_input(self._factors(pairs, grid), grid.sum((-1, -2)))

    def linear_relations(self, edges: Edges, v: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
        """Return sum_e r_e ℓ_e(0) and sum_e r_e U_e from the factors, without forming ℓ or U."""
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
        """Return sum_{i,j} weight[a,i,j] S[i,k] O[j,k], (..., B, A, K)."""
        # One (A·n, m) by (m, K) product for each scene; a broadcast over a would copy O for each a.
        product: Tensor = weight.flatten(-3, -2) @ embedding(pairs.objects, self.O)
        product = product.unflatten(-2, weight.shape[-3:-1])
        subjects = embedding(pairs.subjects, self.S).unsqueeze(-3)
        return (product * subjects).sum(-2)

    def _context_input(self, factors: Tensor, count: Tensor) -> Tensor:
        """Return sum_{a,k} factors[a,k] M[a,k] + sum_a count_a P[a], (..., B, H1)."""
        return factors.flatten(-2) @ self.M.flatten(0, 1) + count @ self.P

    def held_objects(self, edges: Edges, r: Tensor) -> Tensor:
        """Return (B, V) floats: 1 for the objects of relations that are on."""
        pairs = _pairs(edges)
        grid = pairs.unflatten(r).amax(-3)
        held = r.new_zeros(len(r), self.spec.V)
        held.scatter_reduce_(1, pairs.subjects.expand(len(r), -1), grid.amax(-1), "amax")
        held.scatter_reduce_(1, pairs.objects.expand(len(r), -1), grid.amax(-2), "amax")
        return held

    def relation_context(self, edges: Edges) -> Tensor:
        """Return U_e for each unit."""
        pairs = _pairs(edges)
        subject, object_ = self.S[pairs.subjects], self.O[pairs.objects]
        product = subject.unsqueeze(-2) * object_.unsqueeze(-3)
        rows = torch.einsum("bijk,akh->baijh", product, self.M)
        return (rows + self.P[:, None, None]).flatten(1, 3)

    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """Return the sum over R_i of softplus(ℓ_e) + κ_a in the seed form; 0 in the local form."""
        pairs = _pairs(edges)
        return self._attraction(
            v, h1, pairs.subjects, pairs.valid_subjects, pairs.log_subjects, candidates
        )

    def attraction_to_all(self, v: Tensor, h1: Tensor, candidates: Tensor) -> Tensor:
        """Return `attraction` with one instance of every class as an anchor."""
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
        # A candidate that is also an anchor counts as absent here; its own unit (a,i,i) is added
        # below.
        other = (anchors.unsqueeze(-2) != candidates.unsqueeze(-1)) * present.unsqueeze(-2)
        A = self.spec.A
        outgoing = pair_edges(candidates, A, objects=anchors, log_objects=logs)
        incoming = pair_edges(anchors, A, objects=candidates, log_subjects=logs)
        forward = outgoing.unflatten(self.relation_logits(outgoing, v, h1))
        backward = incoming.unflatten(self.relation_logits(incoming, v, h1)).mT
        kappa = self.kappa[:, None, None]
        both = softplus(forward) + softplus(backward) + 2 * kappa
        total = (both * other.unsqueeze(-3)).sum((-1, -3))
        loop = self._loop_logits(candidates, h1)
        return total + (softplus(loop) + self.kappa).sum(-1)

    def _loop_logits(self, candidates: Tensor, h1: Tensor) -> Tensor:
        """Return ℓ of the units (a,i,i), (..., B, N, A)."""
        shared = self.R + torch.einsum("akh,...bh->...bak", self.M, h1)
        product = (self.S * self.O)[candidates] @ shared.mT
        bias = (self.d + h1 @ self.P.T).unsqueeze(-2)
        logits = product + bias + (self.s + self.o).T[candidates]
        if not self.spec.T:
            return logits
        axis = torch.arange(self.spec.A, device=candidates.device)
        ends = candidates.unsqueeze(-1)
        position, found = find_triples(self.triple_keys, triple_keys(axis, ends, ends, self.spec.V))
        return logits + self.residual[position] * found

    def open_units(
        self, v: Tensor, given: tuple[Edges, Tensor, Tensor] | None, least: int = 0
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return the units between present classes; the classes of the given units come first.

        Raises:
            ValueError: the given units do not have one row for each row of v.
        """
        frame = None if given is None else _pairs(given[0])
        if frame is not None and len(frame.subjects) != len(v):
            raise ValueError(f"observed relations must have one row per chain, {len(v)} rows")
        leading = None if frame is None else frame.subjects
        edges = self.edges(present_classes(v, leading, least))
        r = self.b.new_zeros(edges.shape)
        known = torch.zeros_like(r, dtype=torch.bool)
        if frame is not None and given is not None:
            # Both assignments write into views of r and known.
            n = frame.subjects.shape[1]
            edges.unflatten(known)[..., :n, :n] = frame.unflatten(given[2])
            edges.unflatten(r)[..., :n, :n] = frame.unflatten(given[1] * given[2])
        return edges, r, known

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
        """Sample v given h1.

        The seed form samples object by object if collapsed. Otherwise it keeps the objects of
        relations that are on.

        Raises:
            ValueError: the seed form has κ and is not collapsed.
        """
        if not self.relations_act:
            return super().sample_objects(v, h1, r, edges, generator)
        if collapsed:
            return self._collapsed_sweep(v.clone(), h1, held, generator)
        if bool(self.kappa.any()):
            raise ValueError(
                "collapsed=False needs κ = 0: with κ, objects are dependent even given h1 and r"
            )
        drawn = super().sample_objects(v, h1, r, edges, generator)
        return drawn.maximum(self.held_objects(edges, r))

    def _collapsed_sweep(
        self, v: Tensor, h1: Tensor, held: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        logits = self.object_logits(h1)
        for i in range(self.spec.V):
            gain = self.attraction_to_all(v, h1, torch.tensor([[i]]))[:, 0]
            drawn = bernoulli((logits[:, i] + gain).sigmoid(), generator)
            if held is not None:
                drawn = torch.where(held.expand_as(v)[:, i], v[:, i], drawn)
            v[:, i] = drawn
        return v

    def pair_offset(self, edges: Edges, v: Tensor) -> Tensor:
        """Return the sum of κ_a over active units."""
        if not bool(self.kappa.any()):
            return super().pair_offset(edges, v)
        gate = self.gate(edges, v)
        return _pairs(edges).unflatten(gate).sum((-1, -2)) @ self.kappa

    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        """Return the values as a table over the classes, which is the layout of the units."""
        return _pairs(edges).unflatten(values)

    def acting_units(self, v: Tensor) -> Edges | None:
        """Return the units between the classes present in v (B, V); None in the local form."""
        if not self.relations_act:
            return None
        value, index = v.topk(int(v.sum(1).max()), dim=1)
        return self.edges(torch.where(value > 0, index, -1))

    def context_units(self, edges: Edges) -> Edges | None:
        """Return all units in the seed form; None in the local form."""
        return edges if self.relations_act else None

    @torch.no_grad()
    def begin_independent(self, machine: BoltzmannMachine) -> None:
        """Set κ to -log 2 in the seed form."""
        if self.relations_act:
            self.kappa.fill_(-math.log(2))

    @torch.no_grad()
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Multiply every weight by beta.

        With a base, b goes to b_base and κ to -log 2. At beta = 0 the two states of a relation unit
        then weigh 1/2 each. So relations sum out to one, and objects are independent.
        """
        return scale(self, beta, base, keep=("b", "kappa"), fixed=("S", "O", "B", "usual"))


def _pairs(edges: Edges) -> PairEdges:
    if not isinstance(edges, PairEdges):
        raise TypeError("a Triway machine needs PairEdges; build them with machine.edges(classes)")
    return edges


def implication_features(given: Tensor) -> Tensor:
    """Return the features phi, (B, F, n, n), of given relations.

    The pair feature of relation a equals r_e where e is given, so `implied` ignores it.

    Args:
        given: (B, A, n, n), 1 where a relation is given as holding, else 0.
    """
    n = given.shape[-1]
    between = given * ~torch.eye(n, dtype=torch.bool, device=given.device)
    both = torch.cat([between, between.mT], 1)
    steps = both.shape[1]
    # All paths at once: (B, 2A·n, n) by (B, n, 2A·n).
    paths = both.flatten(1, 2) @ both.transpose(1, 2).flatten(2)
    paths = paths.view(len(given), steps, n, steps, n).transpose(2, 3).flatten(1, 2).clamp(max=1.0)
    outgoing = both.sum(-1, keepdim=True) - both
    incoming = both.sum(-2, keepdim=True) - both
    degrees = torch.cat([outgoing, incoming], 1).clamp(max=_MOST)
    return torch.cat([both, paths, degrees], 1)


def implied(gamma: Tensor, B: Tensor, given: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
    """Return the logit shifts x, (B, A, n, n).

    Args:
        gamma: (1 + G, A, F).
        B: (G, H1).
        given: (B, A, n, n), 1 where a relation is given as holding, else 0.
        h1: (B, H1), means of the context given the objects.
        apart: leave out the implications between relations of the same pair.
    """
    A = given.shape[1]
    itself = torch.zeros(gamma.shape[1:], dtype=torch.bool, device=gamma.device)
    itself[:, :A].fill_diagonal_(True)
    if apart:
        # The path and degree features remain: they are about other classes.
        itself[:, : 2 * A] = True
    gamma = gamma.masked_fill(itself, 0.0)
    weight = gamma[0] + torch.einsum("bq,qaf->baf", h1 @ B.T, gamma[1:])
    features = implication_features(given)
    shifts: Tensor = (weight @ features.flatten(2)).view(given.shape)
    return shifts
