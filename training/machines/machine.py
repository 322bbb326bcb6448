"""The interface that the three machines share, and all of the energy but its relation logits.

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2 - sum_e r_e ℓ_e(v,h1)

with the sum over the variant's relation units e = (a,i,j). A variant says which units exist, when
one may be on (its gate) and what its logit ℓ_e is; everything else is here. With a room type t
given, c1 stands for c1 + Q[t]: the room type is a condition, not a unit of the model.

Two forms of the relation part, for every variant:

    seed    - r_e ℓ_e - κ_a         for every active unit
    local   - r_e ℓ_e + log(1 + exp ℓ_e)

The local form leaves p(r | v, h1) as it is and makes unobserved relations drop out of everything
else. The seed form keeps the paper's energy; its κ (0 in the paper) compensates for the attraction
that a summed-out relation exerts on its two ends.

Shapes: leading sample dimensions first, then scenes B, then units. Energies have the leading shape.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from app.inference.variants import MachineSpec
from training.machines.bernoulli import bernoulli
from training.machines.edges import Edges, PairEdges, triple_keys


class BoltzmannMachine(nn.Module, ABC):
    """A Boltzmann machine over objects v, relations r and context h1, h2.

    Source: Bozcan, Oymak, Alemdar, Kalkan, "What is (missing or wrong) in the scene?", ICRA 2018.
    """

    # Triples have weights of their own beside shared ones, which `objectives.relations` may fit.
    has_residuals = False

    def __init__(self, spec: MachineSpec) -> None:
        super().__init__()
        self.spec = spec
        self.b = nn.Parameter(torch.zeros(spec.V))
        self.c1 = nn.Parameter(torch.zeros(spec.H1))
        self.c2 = nn.Parameter(torch.zeros(spec.H2))
        self.W = nn.Parameter(torch.zeros(spec.V, spec.H1))
        self.J = nn.Parameter(torch.zeros(spec.H1, spec.H2))
        self.Q = nn.Parameter(torch.zeros(spec.C, spec.H1))
        self.register_buffer("triples", torch.zeros(spec.T, 3, dtype=torch.int32))
        self.triples: Tensor
        if spec.N:
            # N chain samples as bits, (N, ceil(V / 32)), and their room types, -1 for none.
            empty = torch.zeros(spec.N, -(-spec.V // 32), dtype=torch.int32)
            self.register_buffer("fantasies", empty)
            self.register_buffer("fantasy_rooms", torch.full((spec.N,), -1, dtype=torch.int32))
        self.fantasies: Tensor
        self.fantasy_rooms: Tensor
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda module, _: module.index_triples()
        )
        self.triple_keys = torch.zeros(spec.T, dtype=torch.int64)

    # -- construction ---------------------------------------------------------------------------

    def index_triples(self) -> None:
        """Check the table of triples and build its search keys."""
        table = self.triples.long()
        limits = torch.tensor([self.spec.A, self.spec.V, self.spec.V])
        if bool((table < 0).any()) or bool((table >= limits).any()):
            raise ValueError("triples must hold (a, i, j) within (A, V, V)")
        relation, subject, object_ = table.unbind(1)
        keys = triple_keys(relation, subject, object_, self.spec.V)
        if bool((keys[1:] <= keys[:-1]).any()):
            raise ValueError("triples must be distinct and sorted by (a, i, j)")
        self.triple_keys = keys

    def set_triples(self, triples: Tensor) -> Self:
        """Say which (a, i, j) have a weight of their own; (T, 3), distinct and sorted."""
        if tuple(triples.shape) != (self.spec.T, 3):
            raise ValueError(f"triples must be ({self.spec.T}, 3), not {tuple(triples.shape)}")
        self.triples.copy_(triples)
        self.index_triples()
        return self

    @torch.no_grad()
    def initialise(self, generator: torch.Generator, scale: float = 0.01) -> Self:
        """Draw the matrices from N(0, scale²); biases stay as they are."""
        for parameter in self.parameters():
            if parameter.dim() > 1:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
        return self

    @abstractmethod
    def start_relations(self, by_relation: Tensor, by_unit: Tensor, usual: Tensor) -> None:
        """Set relation biases to the log-odds seen in training.

        Args:
            by_relation: (A,) log-odds that an observed relation holds.
            by_unit: (T,) log-odds that a scene with relations holds each triple of the table.
            usual: (V,) mean log of the instances of each class.
        """

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(parameter.numel() for parameter in self.parameters())

    # -- what a variant defines -----------------------------------------------------------------

    @abstractmethod
    def edges(self, classes: Tensor, counts: Tensor | None = None) -> Edges:
        """The relation units of scenes that hold the given classes.

        Args:
            classes: (B, n) int64, -1 where padded.
            counts: (B, n) instances per class, 0 where unknown; one each where omitted.
        """

    @abstractmethod
    def places(self, pairs: PairEdges) -> tuple[Edges, Tensor, Tensor]:
        """The machine's units, the place of each pair's unit among them, and whether it has one.

        The last two are (B, A·n·m). Pairs without a unit have an arbitrary place.
        """

    @abstractmethod
    def lay_out(
        self, classes: Tensor, counts: Tensor, holds: Tensor, observed: Tensor
    ) -> tuple[Edges, Tensor, Tensor]:
        """Relations between the classes of scenes as (edges, r, observed) of this machine.

        In an ungated machine the units that touch an absent class are off, and observed so where
        the scene's relations were annotated at all.

        Args:
            classes, counts: (B, n), as in `edges`.
            holds, observed: (B, A, n, n).
        """

    @abstractmethod
    def open_units(
        self, v: Tensor, given: tuple[Edges, Tensor, Tensor] | None
    ) -> tuple[Edges, Tensor, Tensor]:
        """The units that v leaves open, as (edges, r, observed), and r as far as it is given."""

    @abstractmethod
    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        """(..., B, E): 1 where a unit may be on, given v (..., B, V)."""

    @abstractmethod
    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        """ℓ_e(v, h1), (..., B, E); h1 is (..., B, H1), binary or a mean."""

    @abstractmethod
    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        """sum_e weight_e U_e, (..., B, H1), for weight (..., B, E)."""

    def linear_relations(self, edges: Edges, v: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
        """sum_e r_e ℓ_e(v, 0), (..., B), and sum_e r_e U_e, (..., B, H1)."""
        bare = self.relation_logits(edges, v, v.new_zeros(*v.shape[:-1], self.spec.H1))
        return (r * bare).sum(-1), self.hidden_input(edges, r)

    def implied(self, edges: Edges, given: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
        """What given relations add to the logits of the others, (B, E); see `triway`.

        Nothing but in a machine that has weights for it.

        Args:
            given: (B, E), 1 where a unit is given as on.
            h1: (B, H1) means given the objects.
            apart: without what the relations of two classes imply for each other.
        """
        del edges, h1, apart
        return torch.zeros_like(given)

    @abstractmethod
    def relation_context(self, edges: Edges) -> Tensor:
        """The rows U_e, (B or 1, E, H1). Allocates them: for few units only."""

    @abstractmethod
    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """What summing out the unobserved relations R_i of a candidate i adds to its log-odds.

        Args:
            v: (..., B, V), each candidate counted as absent.
            h1: (..., B, H1).
            edges: the units of the scene; those that touch a candidate are unobserved.
            candidates: (B or 1, N) int64.

        Returns:
            (..., B, N): log sum_{R_i} exp(-E) at v_i = 1, minus the same at v_i = 0, given h1,
            without the object part b_i + W_i·h1.
        """

    @abstractmethod
    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        """Values (B, E) of units as relations between classes, (B, A, n, n); -inf without a unit.

        Args:
            classes: (B, n) int64, -1 where padded; `edges` are their units.
        """

    @property
    def relations_act(self) -> bool:
        """Whether unobserved relations act on objects and context; never in the local form."""
        return not self.spec.is_local

    @abstractmethod
    def acting_units(self, v: Tensor) -> Edges | None:
        """Units that act on objects while they are unobserved; None in the local form."""

    def context_units(self, edges: Edges) -> Edges | None:
        """Of these units, those that the context sees unobserved while relations are learnt."""
        del edges
        return None

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
        """v given h1 and, where it acts, r, (B, V); see `training.machines.gibbs`.

        Args:
            held: bool, broadcastable to v: these keep their value where it matters to others.
            collapsed: unobserved relations are summed out, if they act.
        """
        del v, r, edges, held, collapsed
        return bernoulli(self._object_input(h1).sigmoid_(), generator)

    def _object_input(self, h1: Tensor) -> Tensor:
        # addmm: the bias enters with the product; memory is what a sweep waits for.
        return torch.addmm(self.b, h1, self.W.T)

    def begin_independent(self, machine: BoltzmannMachine) -> None:
        """Set this machine's relation weights to those of `machine` at beta = 0, see `scaled`."""

    def relation_log_partition(self) -> float:
        """What the relation units of independent objects add to log Z."""
        return 0.0

    @abstractmethod
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """The machine on the path from `base` (independent objects) at beta = 0 to this one at 1.

        Without a base every logit is multiplied by beta: the machine at temperature 1 / beta.
        """

    # -- the relation part ----------------------------------------------------------------------

    def relation_term(self, logits: Tensor, gate: Tensor, r: Tensor, observed: Tensor) -> Tensor:
        """Each unit's contribution to log sum_{unobserved r} exp(-E), given h1; (..., B, E).

        Args:
            logits, gate: ℓ_e and the gate, (..., B, E).
            r: values of the observed units; ignored where unobserved.
            observed: bool, broadcastable to logits.
        """
        summed = softplus(logits)
        if not self.relations_act:
            return torch.where(observed, r * logits - summed, 0.0) * gate
        return torch.where(observed, r * logits, summed) * gate

    def relation_slope(self, logits: Tensor, gate: Tensor, r: Tensor, observed: Tensor) -> Tensor:
        """Derivative of `relation_term` by the logit, (..., B, E)."""
        mean = logits.sigmoid()
        if not self.relations_act:
            return torch.where(observed, r - mean, 0.0) * gate
        return torch.where(observed, r, mean) * gate

    # -- energies -------------------------------------------------------------------------------

    def context_bias(self, room: Tensor | None) -> Tensor:
        """c1 + Q[t], (B or 1, H1); room is (B,) int64, -1 where no room type is given."""
        if room is None or not self.spec.C:
            return self.c1.unsqueeze(0)
        return self.c1 + self.Q[room.clamp(min=0)] * (room >= 0).unsqueeze(-1)

    def energy(
        self,
        v: Tensor,
        r: Tensor,
        h1: Tensor,
        h2: Tensor,
        edges: Edges,
        room: Tensor | None = None,
    ) -> Tensor:
        """E(v, r, h1, h2), shape (..., B); +inf where a unit is on that its gate holds off."""
        gate = self.gate(edges, v)
        logits = self.relation_logits(edges, v, h1)
        observed = torch.ones_like(gate, dtype=torch.bool)
        relation = self.relation_term(logits, gate, r, observed).sum(-1)
        energy = self.object_energy(v, h1, h2, room) - relation - self.pair_offset(edges, v)
        return torch.where((r > gate).any(-1), torch.inf, energy)

    def object_energy(self, v: Tensor, h1: Tensor, h2: Tensor, room: Tensor | None) -> Tensor:
        """The energy without relations, (..., B)."""
        context = (h1 * (self.context_bias(room) + v @ self.W)).sum(-1)
        return -(v @ self.b + h2 @ self.c2 + context + ((h1 @ self.J) * h2).sum(-1))

    def pair_offset(self, edges: Edges, v: Tensor) -> Tensor:
        """sum of κ_a over active units, (..., B); zero but for a compensated seed form."""
        return v.new_zeros(v.shape[:-1])

    def hidden_logits(
        self,
        v: Tensor,
        r: Tensor,
        edges: Edges,
        h2: Tensor | None = None,
        room: Tensor | None = None,
    ) -> Tensor:
        """x = c1 + v'W + sum_e r_e U_e + J h2: p(h1 = 1 | v, r, h2) = sigmoid(x) in the seed form.

        In the local form the relations enter x only through their own weights (`draw_hidden`), so r
        must be left out there: pass zeros.
        """
        x = self.context_bias(room) + v @ self.W + self.hidden_input(edges, r)
        return x if h2 is None else x + h2 @ self.J.T

    def free_energy(
        self,
        v: Tensor,
        r: Tensor | None = None,
        edges: Edges | None = None,
        h2: Tensor | None = None,
        room: Tensor | None = None,
    ) -> Tensor:
        """F = -log sum_{h1} exp(-E), shape (..., B), where a closed form exists.

        Seed form: every unit of `edges` observed as r, the others off. Local form: every relation
        unobserved (r = None), which is exact. A second layer must be given as h2.

        Raises:
            ValueError: where no closed form exists.
        """
        if self.spec.H2 and h2 is None:
            raise ValueError("F has no closed form over a second layer: give h2")
        if not self.relations_act:
            if r is not None:
                raise ValueError("F has no closed form in the local form with relations observed")
            return self.free_energy_given(v, v.new_zeros(()), h2, room)
        if r is None or edges is None:
            raise ValueError("F has no closed form in the seed form with relations unobserved")
        bare, context = self.linear_relations(edges, v, r)
        free = self.free_energy_given(v, context, h2, room) - bare - self.pair_offset(edges, v)
        return torch.where((r > self.gate(edges, v)).any(-1), torch.inf, free)

    def free_energy_given(
        self, v: Tensor, context: Tensor, h2: Tensor | None = None, room: Tensor | None = None
    ) -> Tensor:
        """-log sum_{h1} of the object part with h1's input raised by context (..., B, H1).

        -b·v - c2·h2 - sum_k softplus(c1 + v'W + J h2 + context)_k, shape (..., B).
        """
        free = -(v @ self.b)
        x = self.context_bias(room) + v @ self.W + context
        if h2 is not None:
            x, free = x + h2 @ self.J.T, free - h2 @ self.c2
        return free - softplus(x).sum(-1)

    # -- conditionals of the other blocks -------------------------------------------------------

    def second_layer_logits(self, h1: Tensor) -> Tensor:
        """c2 + h1'J: p(h2 = 1 | h1) = sigmoid of it, (..., B, H2)."""
        return self.c2 + h1 @ self.J

    def object_logits(self, h1: Tensor) -> Tensor:
        """b + W h1, (..., B, V): log-odds of v_i given h1 but for its relations."""
        return self.b + h1 @ self.W.T
