"""The common interface of the machines, and the whole energy except its relation logits.

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2 - sum_e r_e ℓ_e(v,h1)

The sum runs over the variant's relation units e = (a,i,j). A variant defines the existing units,
the gate that allows a unit to be on, and the logit ℓ_e. All other terms are defined here. If a room
type t is given, c1 means c1 + Q[t]. The room type is a condition, not a unit of the model.

Every variant has two forms of the relation part:

    seed    - r_e ℓ_e - κ_a         for every active unit
    local   - r_e ℓ_e + log(1 + exp ℓ_e)

Both forms have the same p(r | v, h1). In the local form, unobserved relations drop out of all other
conditionals. The seed form keeps the paper's energy. Its κ (0 in the paper) compensates for the
attraction that a summed-out relation has on its two objects.

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

    # True if triples have their own weights beside the shared ones; `objectives.relations` may fit
    # them.
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
            # N chain samples as bits, (N, ceil(V / 32)), and their room types, -1 for unknown.
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
        limits = torch.tensor([self.spec.A, self.spec.V, self.spec.V], device=table.device)
        if bool((table < 0).any()) or bool((table >= limits).any()):
            raise ValueError("triples must hold (a, i, j) within (A, V, V)")
        relation, subject, object_ = table.unbind(1)
        keys = triple_keys(relation, subject, object_, self.spec.V)
        if bool((keys[1:] <= keys[:-1]).any()):
            raise ValueError("triples must be distinct and sorted by (a, i, j)")
        self.triple_keys = keys

    def set_triples(self, triples: Tensor) -> Self:
        """Set the triples (a, i, j) that have their own weights; (T, 3), distinct and sorted."""
        if tuple(triples.shape) != (self.spec.T, 3):
            raise ValueError(f"triples must be ({self.spec.T}, 3), not {tuple(triples.shape)}")
        self.triples.copy_(triples)
        self.index_triples()
        return self

    @torch.no_grad()
    def initialise(self, generator: torch.Generator, scale: float = 0.01) -> Self:
        """Draw the matrices from N(0, scale²); biases are unchanged."""
        for parameter in self.parameters():
            if parameter.dim() > 1:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
        return self

    @abstractmethod
    def start_relations(self, by_relation: Tensor, by_unit: Tensor, usual: Tensor) -> None:
        """Set relation biases to the log-odds seen in training.

        Args:
            by_relation: (A,) log-odds that an observed relation holds.
            by_unit: (T,) log-odds of each triple of the table in scenes with relations.
            usual: (V,) mean log of the instances of each class.
        """

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(parameter.numel() for parameter in self.parameters())

    # -- what a variant defines -----------------------------------------------------------------

    @abstractmethod
    def edges(self, classes: Tensor, counts: Tensor | None = None) -> Edges:
        """Return the relation units between the given classes of each scene.

        Args:
            classes: (B, n) int64, -1 where padded.
            counts: (B, n) instances of each class, 0 where unknown; default: one each.
        """

    @abstractmethod
    def places(self, pairs: PairEdges) -> tuple[Edges, Tensor, Tensor]:
        """Return the machine's units, and for each pair the index of its unit and if it has a unit.

        The last two have shape (B, A·n·m). For a pair without a unit, the index is arbitrary.
        """

    @abstractmethod
    def lay_out(
        self, classes: Tensor, counts: Tensor, holds: Tensor, observed: Tensor
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return the relations between classes as (edges, r, observed) in this machine's layout.

        In an ungated machine the units of absent classes are off. They count as observed if the
        scene has any annotated relation.

        Args:
            classes, counts: (B, n), as in `edges`.
            holds, observed: (B, A, n, n).
        """

    @abstractmethod
    def open_units(
        self, v: Tensor, given: tuple[Edges, Tensor, Tensor] | None, least: int = 0
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return the units that may be on given v, as (edges, r, observed).

        r contains the values of the given units.

        Args:
            least: least number of classes between which there are units, with padding.
        """

    @abstractmethod
    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        """Return the gates (..., B, E): 1 if a unit may be on given v (..., B, V), else 0."""

    @abstractmethod
    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        """Return the relation logits ℓ_e(v, h1), (..., B, E).

        Args:
            h1: (..., B, H1), binary states or means.
        """

    @abstractmethod
    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        """Return sum_e weight_e U_e, (..., B, H1), for weight (..., B, E)."""

    def linear_relations(self, edges: Edges, v: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
        """Return sum_e r_e ℓ_e(v, 0), (..., B), and sum_e r_e U_e, (..., B, H1)."""
        bare = self.relation_logits(edges, v, v.new_zeros(*v.shape[:-1], self.spec.H1))
        return (r * bare).sum(-1), self.hidden_input(edges, r)

    def implied(self, edges: Edges, given: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
        """Return the logit shifts (B, E) that given relations imply for others; see `triway`.

        The shifts are zero in machines without implication weights.

        Args:
            given: (B, E), 1 where a unit is given as on.
            h1: (B, H1) means given the objects.
            apart: leave out the implications between relations of the same two classes.
        """
        del edges, h1, apart
        return torch.zeros_like(given)

    @abstractmethod
    def relation_context(self, edges: Edges) -> Tensor:
        """Return the context weights U_e of every unit, (B or 1, E, H1); pass few units only."""

    @abstractmethod
    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """Return the log-odds that summing out the unobserved relations R_i adds to candidate i.

        Args:
            v: (..., B, V); each candidate counts as absent.
            h1: (..., B, H1).
            edges: the units of the scene; units of a candidate are unobserved.
            candidates: (B or 1, N) int64.

        Returns:
            (..., B, N): log sum_{R_i} exp(-E) at v_i = 1, minus the same at v_i = 0, given h1,
            without the object part b_i + W_i·h1.
        """

    @abstractmethod
    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        """Return values (B, E) of units as a table (B, A, n, n) over classes; -inf without a unit.

        Args:
            classes: (B, n) int64, -1 where padded; `edges` has the units between these classes.
        """

    @property
    def relations_act(self) -> bool:
        """Whether unobserved relations act on objects and context; never in the local form."""
        return not self.spec.is_local

    @abstractmethod
    def acting_units(self, v: Tensor) -> Edges | None:
        """Return the unobserved units that act on objects; None in the local form."""

    def context_units(self, edges: Edges) -> Edges | None:
        """Return the unobserved units that act on the context while relations are trained."""
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
        """Sample v given h1 and, in forms where r acts on v, given r, (B, V); see `gibbs`.

        Args:
            held: bool, broadcastable to v; held objects keep their value while others are sampled.
            collapsed: sum out unobserved relations that act on objects.
        """
        del v, r, edges, held, collapsed
        return bernoulli(self._object_input(h1).sigmoid_(), generator)

    def _object_input(self, h1: Tensor) -> Tensor:
        # addmm adds the bias within the product, because memory access limits the speed of a sweep.
        return torch.addmm(self.b, h1, self.W.T)

    def begin_independent(self, machine: BoltzmannMachine) -> None:
        """Set this machine's relation weights to those of `machine` at beta = 0, see `scaled`."""

    def relation_log_partition(self) -> float:
        """Return the part of log Z that relation units contribute at beta = 0, see `scaled`."""
        return 0.0

    @abstractmethod
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Return the machine at beta on the path from `base` (beta = 0) to this machine (beta = 1).

        The base has independent objects.

        Without a base, beta multiplies every logit. This is the machine at temperature 1 / beta.
        """

    # -- the relation part ----------------------------------------------------------------------

    def relation_term(self, logits: Tensor, gate: Tensor, r: Tensor, observed: Tensor) -> Tensor:
        """Return each unit's part of log sum_{unobserved r} exp(-E), given h1; (..., B, E).

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
        """Return the derivative of `relation_term` by the logit, (..., B, E)."""
        mean = logits.sigmoid()
        if not self.relations_act:
            return torch.where(observed, r - mean, 0.0) * gate
        return torch.where(observed, r, mean) * gate

    # -- energies -------------------------------------------------------------------------------

    def context_bias(self, room: Tensor | None) -> Tensor:
        """Return c1 + Q[t], (B or 1, H1); room is (B,) int64, -1 where the room type is unknown."""
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
        """Return E(v, r, h1, h2), shape (..., B); +inf if a unit is on and its gate is off."""
        gate = self.gate(edges, v)
        logits = self.relation_logits(edges, v, h1)
        observed = torch.ones_like(gate, dtype=torch.bool)
        relation = self.relation_term(logits, gate, r, observed).sum(-1)
        energy = self.object_energy(v, h1, h2, room) - relation - self.pair_offset(edges, v)
        return torch.where((r > gate).any(-1), torch.inf, energy)

    def object_energy(self, v: Tensor, h1: Tensor, h2: Tensor, room: Tensor | None) -> Tensor:
        """Return the energy without relations, (..., B)."""
        context = (h1 * (self.context_bias(room) + v @ self.W)).sum(-1)
        return -(v @ self.b + h2 @ self.c2 + context + ((h1 @ self.J) * h2).sum(-1))

    def pair_offset(self, edges: Edges, v: Tensor) -> Tensor:
        """Return the sum of κ_a over active units, (..., B); 0 unless the seed form has κ."""
        return v.new_zeros(v.shape[:-1])

    def hidden_logits(
        self,
        v: Tensor,
        r: Tensor,
        edges: Edges,
        h2: Tensor | None = None,
        room: Tensor | None = None,
    ) -> Tensor:
        """Return x = c1 + v'W + sum_e r_e U_e + J h2.

        In the seed form p(h1 = 1 | v, r, h2) = sigmoid(x). In the local form relations affect h1
        only through the weights of draws (`draw_hidden`), so pass zeros for r.
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
        """Return F = -log sum_{h1} exp(-E), shape (..., B), where a closed form exists.

        In the seed form, every unit of `edges` is observed as r and other units are off. In the
        local form, every relation is unobserved (r = None), and F is exact. A machine with a second
        layer needs its state h2.

        Raises:
            ValueError: there is no closed form.
        """
        if self.spec.H2 and h2 is None:
            raise ValueError("the free energy has no closed form over a second layer: pass h2")
        if not self.relations_act:
            if r is not None:
                raise ValueError(
                    "the free energy of a local-form machine has no closed form with observed "
                    "relations: pass r=None"
                )
            return self.free_energy_given(v, v.new_zeros(()), h2, room)
        if r is None or edges is None:
            raise ValueError(
                "the free energy of a seed-form machine needs observed relations (r and edges): "
                "without them it has no closed form"
            )
        bare, context = self.linear_relations(edges, v, r)
        free = self.free_energy_given(v, context, h2, room) - bare - self.pair_offset(edges, v)
        return torch.where((r > self.gate(edges, v)).any(-1), torch.inf, free)

    def free_energy_given(
        self, v: Tensor, context: Tensor, h2: Tensor | None = None, room: Tensor | None = None
    ) -> Tensor:
        """Return -log sum_{h1} exp(-E) of the object part, with context (..., B, H1) added to x.

        -b·v - c2·h2 - sum_k softplus(c1 + v'W + J h2 + context)_k, shape (..., B).
        """
        free = -(v @ self.b)
        x = self.context_bias(room) + v @ self.W + context
        if h2 is not None:
            x, free = x + h2 @ self.J.T, free - h2 @ self.c2
        return free - softplus(x).sum(-1)

    # -- conditionals of the other blocks -------------------------------------------------------

    def second_layer_logits(self, h1: Tensor) -> Tensor:
        """Return c2 + h1'J, (..., B, H2): the logits of p(h2 = 1 | h1)."""
        return self.c2 + h1 @ self.J

    def object_logits(self, h1: Tensor) -> Tensor:
        """Return b + W h1, (..., B, V): log-odds of v_i given h1, without the relations of i."""
        return self.b + h1 @ self.W.T
