"""The common interface of the machines, and the whole energy except its relation logits.

    E(v,r,h1,h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2 - sum_e r_e ℓ_e(v,h1)

The sum runs over the relation units e = (a,i,j) of the machine variant. A variant defines its
relation units, the gate of a unit and the logit ℓ_e. A gate of 0 forces its unit to 0. This module
defines all other terms. If a room type t is given, c1 means c1 + Q[t]. The model is conditioned on
the room type, so the room type has no unit.

Every variant has two forms of the relation part of the energy. A unit with an open gate adds:

    seed    - r_e ℓ_e - κ_a
    local   - r_e ℓ_e + log(1 + exp ℓ_e)

Both forms have the same p(r | v, h1). In the local form, unobserved relations have no effect on
other units. The seed form is the energy of the paper. A relation that is summed out in the seed
form raises the probability of its two objects. The weight κ (0 in the paper) compensates for this.

Tensor dimensions: "..." stands for samples. They come first, then scenes, then units.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from app.inference.variants import MachineSpec
from training.machines.bernoulli import bernoulli
from training.machines.edges import Edges, PairEdges, triple_keys


@dataclass(frozen=True)
class State:
    """The state of several Gibbs chains.

    Attributes:
        v: presence of objects, (chains, classes).
        h1, h2: hidden units of each layer, (chains, hidden units).
        r: values of the relation units, (chains, units).
        edges: layout of the relation units in r.
    """

    v: Tensor
    h1: Tensor
    h2: Tensor
    r: Tensor
    edges: Edges


class BoltzmannMachine(nn.Module, ABC):
    """A Boltzmann machine over objects v, relations r and hidden units h1 and h2.

    Source: Bozcan, Oymak, Alemdar, Kalkan, "What is (missing or wrong) in the scene?", ICRA 2018.
    """

    # True if single triples have residual weights besides the shared weights. The objective
    # `relation_likelihood` can fit the residual weights.
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
            # Stored chain samples as bits, (samples, words of 32 classes), and their room types. A
            # room type of -1 is unknown.
            empty = torch.zeros(spec.N, -(-spec.V // 32), dtype=torch.int32)
            self.register_buffer("fantasies", empty)
            self.register_buffer("fantasy_rooms", torch.full((spec.N,), -1, dtype=torch.int32))
        self.fantasies: Tensor
        self.fantasy_rooms: Tensor
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda module, _: module.index_triples()
        )
        self.triple_keys = torch.zeros(spec.T, dtype=torch.int64)

    def index_triples(self) -> None:
        """Check the table of triples and build its search keys."""
        table = self.triples.long()
        limits = torch.tensor([self.spec.A, self.spec.V, self.spec.V], device=table.device)
        if bool((table < 0).any()) or bool((table >= limits).any()):
            raise ValueError(
                "the table of triples has an index out of range; (a, i, j) must be below (A, V, V)"
            )
        relation, subject, object_ = table.unbind(1)
        keys = triple_keys(relation, subject, object_, self.spec.V)
        if bool((keys[1:] <= keys[:-1]).any()):
            raise ValueError(
                "the table of triples is not strictly sorted; sort it by (a, i, j) without repeats"
            )
        self.triple_keys = keys

    def set_triples(self, triples: Tensor) -> Self:
        """Set the triples (a, i, j) that have their own weights: (triples, 3), sorted, distinct."""
        if tuple(triples.shape) != (self.spec.T, 3):
            raise ValueError(
                f"triples have the shape {tuple(triples.shape)}; expected ({self.spec.T}, 3)"
            )
        self.triples.copy_(triples)
        self.index_triples()
        return self

    @torch.no_grad()
    def initialise(self, generator: torch.Generator, scale: float = 0.01) -> Self:
        """Draw the weight matrices from N(0, scale²). Biases keep their values."""
        for parameter in self.parameters():
            if parameter.dim() > 1:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
        return self

    @abstractmethod
    def start_relations(self, by_relation: Tensor, by_unit: Tensor, usual: Tensor) -> None:
        """Set relation biases to log-odds of the training data.

        Args:
            by_relation: log-odds that an observed relation holds, (relations,).
            by_unit: log-odds that a triple holds in a scene with annotated relations, (triples,).
            usual: mean log number of instances of each class, (classes,).
        """

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(parameter.numel() for parameter in self.parameters())

    @abstractmethod
    def edges(self, classes: Tensor, counts: Tensor | None = None) -> Edges:
        """Return the relation units between the given classes of each scene.

        The class indices are (scenes, n) int64, with padding -1. The counts are the numbers of
        instances, 0 where unknown. The default is one instance of each class.
        """

    @abstractmethod
    def places(self, pairs: PairEdges) -> tuple[Edges, Tensor, Tensor]:
        """Return the units, the index of the unit of each relation in `pairs`, and its existence.

        The last two have the shape (scenes, relations of `pairs`). Without a unit, the index is
        arbitrary.
        """

    @abstractmethod
    def lay_out(
        self, classes: Tensor, counts: Tensor, holds: Tensor, observed: Tensor
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return the relations between classes in the layout of this machine: edges, r, observed.

        In an RBM or GBM, the units of absent classes are 0. They count as observed if the scene has
        any annotated relation.

        Args:
            classes, counts: class indices and numbers of instances, (scenes, n), as in `edges`.
            holds, observed: value of each relation between the classes, and True where it is
                observed, (scenes, relations, n, n).
        """

    @abstractmethod
    def open_units(
        self, v: Tensor, observed: tuple[Edges, Tensor, Tensor] | None, least: int = 0
    ) -> tuple[Edges, Tensor, Tensor]:
        """Return edges, r and observed of the relation units that can be 1 given the objects v.

        Args:
            observed: observed relations, whose values r contains.
            least: least number of classes between which there are units, with padding.
        """

    @abstractmethod
    def gate(self, edges: Edges, v: Tensor) -> Tensor:
        """Return 1 for each unit that can be 1 given v, else 0, (..., scenes, units)."""

    @abstractmethod
    def relation_logits(self, edges: Edges, v: Tensor, h1: Tensor) -> Tensor:
        """Return the logit ℓ_e(v, h1) of each relation unit e, (..., scenes, units).

        Args:
            h1: binary states or means of the hidden units, (..., scenes, hidden units).
        """

    @abstractmethod
    def hidden_input(self, edges: Edges, weight: Tensor) -> Tensor:
        """Return sum_e weight_e U_e for weights (..., scenes, units), (..., scenes, H1)."""

    def linear_relations(self, edges: Edges, v: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
        """Return sum_e r_e ℓ_e(v, 0), (..., scenes), and sum_e r_e U_e, (..., scenes, H1)."""
        bare = self.relation_logits(edges, v, v.new_zeros(*v.shape[:-1], self.spec.H1))
        return (r * bare).sum(-1), self.hidden_input(edges, r)

    def implied(self, edges: Edges, observed: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
        """Return the change of each relation logit due to observed relations, (scenes, units).

        The change is zero in a machine without implication weights (`training.machines.triway`).

        Args:
            observed: observed relations, (scenes, units). 1 means that the relation holds.
            h1: means of the hidden units given the objects, (scenes, hidden units).
            apart: True leaves out the effects between relations of the same two classes.
        """
        del edges, h1, apart
        return torch.zeros_like(observed)

    @abstractmethod
    def relation_context(self, edges: Edges) -> Tensor:
        """Return the weights U_e to h1 of few units, (scenes or 1, units, hidden units)."""

    @abstractmethod
    def attraction(self, v: Tensor, h1: Tensor, edges: Edges, candidates: Tensor) -> Tensor:
        """Return the part of each candidate's log-odds that comes from its unobserved relations.

        For candidate i, the part is log sum_{R_i} exp(-E) at v_i = 1 minus the same at v_i = 0,
        given h1. R_i are the relations of i. The terms b_i + W_i·h1 are left out.

        Args:
            v: presence of objects, (..., scenes, classes). Each candidate counts as absent.
            edges: relation units of the scene. The units of a candidate are unobserved.
            candidates: class indices, (scenes or 1, candidates) int64.
        """

    @abstractmethod
    def between(self, edges: Edges, values: Tensor, classes: Tensor) -> Tensor:
        """Return values of the units as a table, (scenes, relations, n, n); -inf without unit.

        The units are those between the classes, (scenes, n) int64. Padding is -1.
        """

    @property
    def relations_act(self) -> bool:
        """True if unobserved relations affect objects and hidden units (seed form only)."""
        return not self.spec.is_local

    @abstractmethod
    def acting_units(self, v: Tensor) -> Edges | None:
        """Return the unobserved relation units that affect objects. The local form returns None."""

    def context_units(self, edges: Edges) -> Edges | None:
        """Return the unobserved relation units that affect h1 while relations are trained."""
        del edges
        return None

    def sample_objects(
        self, state: State, generator: torch.Generator, *, held: Tensor | None, collapsed: bool
    ) -> Tensor:
        """Sample the objects v given the other units, (scenes, classes); see `gibbs`.

        Args:
            held: bool, broadcastable to v. True marks objects that keep their value.
            collapsed: True sums out the unobserved relations that affect objects.
        """
        del held, collapsed
        return bernoulli(self._object_input(state.h1).sigmoid_(), generator)

    def _object_input(self, h1: Tensor) -> Tensor:
        # addmm adds the bias within the product, because memory access limits the speed of a sweep.
        return torch.addmm(self.b, h1, self.W.T)

    def begin_independent(self, machine: BoltzmannMachine) -> None:
        """Set the relation weights to those of `machine.scaled(beta=0)`."""

    def relation_log_partition(self) -> float:
        """Return the contribution of the relation units to log Z at beta = 0 (`scaled`)."""
        return 0.0

    @abstractmethod
    def scaled(self, beta: float, base: BoltzmannMachine | None = None) -> Self:
        """Return a machine between `base` (beta = 0) and this machine (beta = 1).

        The objects of `base` are independent. Without a base, beta multiplies every logit: the
        result is this machine at temperature 1 / beta.
        """

    def relation_term(self, logits: Tensor, gate: Tensor, r: Tensor, observed: Tensor) -> Tensor:
        """Return the term of each unit in log sum_{unobserved r} exp(-E), (..., scenes, units).

        Args:
            logits, gate: logit ℓ_e and gate of each relation unit, (..., scenes, units).
            r, observed: values and bool mask of the observed relations, broadcastable to `logits`.
        """
        summed = softplus(logits)
        if not self.relations_act:
            return torch.where(observed, r * logits - summed, 0.0) * gate
        return torch.where(observed, r * logits, summed) * gate

    def relation_slope(self, logits: Tensor, gate: Tensor, r: Tensor, observed: Tensor) -> Tensor:
        """Return the derivative of `relation_term` by the logit ℓ_e, (..., scenes, units)."""
        mean = logits.sigmoid()
        if not self.relations_act:
            return torch.where(observed, r - mean, 0.0) * gate
        return torch.where(observed, r, mean) * gate

    def context_bias(self, room: Tensor | None) -> Tensor:
        """Return the bias c1 + Q[t] of the hidden units, (scenes or 1, hidden units).

        The room type t of a scene is its entry of `room`, (scenes,) int64. -1 means unknown.
        """
        if room is None or not self.spec.C:
            return self.c1.unsqueeze(0)
        return self.c1 + self.Q[room.clamp(min=0)] * (room >= 0).unsqueeze(-1)

    def energy(
        self, v: Tensor, r: Tensor, h1: Tensor, h2: Tensor, edges: Edges, room: Tensor | None = None
    ) -> Tensor:
        """Return the energy E(v, r, h1, h2), (..., scenes); +inf if a unit with gate 0 is 1."""
        gate = self.gate(edges, v)
        logits = self.relation_logits(edges, v, h1)
        observed = torch.ones_like(gate, dtype=torch.bool)
        relation = self.relation_term(logits, gate, r, observed).sum(-1)
        energy = self.object_energy(v, h1, h2, room) - relation - self.pair_offset(edges, v)
        return torch.where((r > gate).any(-1), torch.inf, energy)

    def object_energy(self, v: Tensor, h1: Tensor, h2: Tensor, room: Tensor | None) -> Tensor:
        """Return the energy without the terms of relations, (..., scenes)."""
        context = (h1 * (self.context_bias(room) + v @ self.W)).sum(-1)
        return -(v @ self.b + h2 @ self.c2 + context + ((h1 @ self.J) * h2).sum(-1))

    def pair_offset(self, edges: Edges, v: Tensor) -> Tensor:
        """Return the sum of κ_a over units with an open gate, (..., scenes); 0 without κ."""
        return v.new_zeros(v.shape[:-1])

    def free_energy(
        self,
        v: Tensor,
        r: Tensor | None = None,
        edges: Edges | None = None,
        h2: Tensor | None = None,
        room: Tensor | None = None,
    ) -> Tensor:
        """Return the free energy F = -log sum_{h1} exp(-E), (..., scenes), in closed form.

        In the seed form, r contains the observed values of all units in `edges`. Other units are 0.
        In the local form, all relations must be unobserved (r = None). A machine with a second
        hidden layer needs the state h2 of that layer.

        Raises:
            ValueError: the free energy has no closed form for these arguments.
        """
        if self.spec.H2 and h2 is None:
            raise ValueError(
                "the free energy of a machine with two hidden layers has a closed form only given "
                "h2: pass h2"
            )
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
        """Return -b·v - c2·h2 - sum_k softplus(c1 + v'W + J h2 + context)_k, (..., scenes).

        The context is an addition to the logits of h1, (..., scenes, hidden units).
        """
        free = -(v @ self.b)
        x = self.context_bias(room) + v @ self.W + context
        if h2 is not None:
            x, free = x + h2 @ self.J.T, free - h2 @ self.c2
        return free - softplus(x).sum(-1)

    def second_layer_logits(self, h1: Tensor) -> Tensor:
        """Return the logits c2 + h1'J of p(h2 = 1 | h1), (..., scenes, units of h2)."""
        return self.c2 + h1 @ self.J

    def object_logits(self, h1: Tensor) -> Tensor:
        """Return the log-odds b + W h1 of each object without relations, (..., scenes, classes)."""
        return self.b + h1 @ self.W.T
