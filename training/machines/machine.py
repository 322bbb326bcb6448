"""The common interface of the machines, and the whole energy except its relation logits.

    E(v, r, h1, t | q) = - (b + a_q + u_q + Y_t)·v - v'Lv/2 - (c1 + Q_t)·h1 - v'W h1
                         - (e + y_q)_t - sum_e g_e [r_e ℓ_e(v, h1) - log(1 + exp ℓ_e)]

q is the data source of the scene, and t its room type; an unknown one has the weights 0. h1 has one
entry for each state of a hidden unit but the first, which has the energy 0: 1 for the state of the
unit, else 0. With two states, the units are binary, as in the paper. A variant defines its relation
units e = (a, i, j), their gates g_e and logits ℓ_e. A gate of 0 forces its unit to 0.

The term log(1 + exp ℓ_e) normalises each relation separately. So the sum over an unobserved
relation is 1, and relations have no effect on objects and hidden units. The published machine lacks
this term; `training.seed` has it as published.

Given the objects, the log-odds of an unlisted class i have a closed form:

    log-odds_i = b_i + a_qi + Y_ti + (vL)_i + sum_m log sum_z p_m(z | v, t) exp(W_i[m, z])

In lists of a known share of the classes of a scene, kappa_i of this share is added. u_qi belongs to
whole scenes only. If the source is unknown, a_qi is replaced by its mean over the sources given the
listed classes, with the probabilities p(q | v) = softmax(f + a v). A room type has the probability

    p(t | v) = sum_q p(q | v) softmax_t(e + y_q + Y v + sum_m log sum_z p_m(z | v) exp(Q_t[m, z]))

p_m are the probabilities of the states of unit m, with the logits x = c1 + Q_t + v'W.

Dimensions: "..." samples, B scenes, "B|1" scenes or one row for all, V classes, C room types, H1
hidden units, E relation units, n listed classes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import softplus

from app.inference.variants import MachineSpec
from app.inference.weights import LISTED_SHARES
from training.machines.edges import Edges, LaidOut, SceneRelations, triple_keys

OBJECT_WEIGHTS = ("b", "c1", "e", "W", "Q", "L", "Y", "f", "a", "y", "kappa")
"""Names of the weights without relations."""


class BoltzmannMachine(nn.Module, ABC):
    """A Boltzmann machine over objects v, relations r, hidden units h1, and a room type t.

    Source: Bozcan, Oymak, Alemdar, Kalkan, "What is (missing or wrong) in the scene?", ICRA 2018.
    """

    triples: Tensor
    fantasies: Tensor
    fantasy_rooms: Tensor

    def __init__(self, spec: MachineSpec) -> None:
        """Make all weights 0. u is fitted after training, so it needs no gradient."""
        super().__init__()
        self.spec = spec
        self.b = nn.Parameter(torch.zeros(spec.V))
        self.c1 = nn.Parameter(torch.zeros(spec.H1))
        self.e = nn.Parameter(torch.zeros(spec.C))
        self.W = nn.Parameter(torch.zeros(spec.V, spec.H1))
        self.Q = nn.Parameter(torch.zeros(spec.C, spec.H1))
        self.f = nn.Parameter(torch.zeros(spec.profiles))
        self.a = nn.Parameter(torch.zeros(spec.profiles, spec.V))
        self.y = nn.Parameter(torch.zeros(spec.profiles, spec.C))
        self.u = nn.Parameter(torch.zeros(spec.profiles + 1, spec.V), requires_grad=False)
        self.kappa = nn.Parameter(torch.zeros(len(LISTED_SHARES) + 1, spec.V))
        if spec.coupled:
            self.L = nn.Parameter(torch.zeros(spec.V, spec.V))
            self.Y = nn.Parameter(torch.zeros(spec.C, spec.V))
        self.register_buffer("triples", torch.zeros(spec.T, 3, dtype=torch.int32))
        if spec.N:
            # Stored chain samples in words of 32 classes, and their room types (-1: unknown).
            empty = torch.zeros(spec.N, -(-spec.V // 32), dtype=torch.int32)
            self.register_buffer("fantasies", empty)
            self.register_buffer("fantasy_rooms", torch.full((spec.N,), -1, dtype=torch.int32))
        self.triple_keys = torch.zeros(spec.T, dtype=torch.int64)
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda module, _: module.index_triples()
        )

    def index_triples(self) -> None:
        """Check the table of triples and build its search keys."""
        table = self.triples.long()
        limits = torch.tensor([self.spec.A, self.spec.V, self.spec.V])
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

    def set_triples(self, triples: Int[Tensor, "T 3"]) -> Self:
        """Set the triples (a, i, j) that have their own weights; they are sorted and distinct."""
        if tuple(triples.shape) != (self.spec.T, 3):
            raise ValueError(
                f"triples have the shape {tuple(triples.shape)}; expected ({self.spec.T}, 3)"
            )
        self.triples.copy_(triples)
        self.index_triples()
        return self

    @torch.no_grad()
    def initialise(self, generator: torch.Generator, scale: float = 0.05) -> Self:
        """Draw W and the factors of relations from N(0, scale²). Other weights keep 0."""
        for name, parameter in self.named_parameters():
            if parameter.dim() > 1 and name not in ("Q", "a", "y", "u", "kappa", "L", "Y"):
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
        return self

    @property
    def parameter_count(self) -> int:
        """Number of trained weights. A coupling of two classes counts once."""
        V = self.spec.V
        doubled = V * (V + 1) // 2 if self.spec.coupled else 0
        return sum(parameter.numel() for parameter in self.parameters()) - doubled

    @property
    def couplings(self) -> Float[Tensor, "V V"] | None:
        """The symmetric couplings between classes, with a diagonal of 0, or None."""
        return self.L if self.spec.coupled else None

    def by_unit(self, x: Float[Tensor, "... H1"]) -> Float[Tensor, "... units states-1"]:
        """Return values of h1 by hidden unit and state."""
        return x.unflatten(-1, (self.spec.units, self.spec.states - 1))

    def state_means(self, x: Float[Tensor, "... H1"]) -> Float[Tensor, "... H1"]:
        """Return the probabilities of the states of h1 with the logits x."""
        if self.spec.states == 2:
            return x.sigmoid()
        return self._all_states(x).softmax(-1)[..., 1:].flatten(-2)

    def _all_states(self, x: Float[Tensor, "... H1"]) -> Float[Tensor, "... units states"]:
        """Return the logits of all states, the first one included."""
        logits = self.by_unit(x)
        return torch.cat([torch.zeros_like(logits[..., :1]), logits], -1)

    def hidden_bias(self, room: Int[Tensor, "B"] | None) -> Float[Tensor, "B|1 H1"]:
        """Return the bias c1 + Q[t] of h1. A room type t of -1 is unknown."""
        return self.c1 + _rows(self.Q, room)

    def hidden_logits(
        self, v: Float[Tensor, "B V"], room: Int[Tensor, "B"] | None = None
    ) -> Float[Tensor, "B H1"]:
        """Return the logits x = c1 + Q[t] + v'W of h1 given the objects v."""
        return self.hidden_bias(room) + sparse_product(v, self.W)

    def hidden_log_odds(
        self, x: Float[Tensor, "B H1"], weights: Float[Tensor, "rows H1"]
    ) -> Float[Tensor, "B rows"]:
        """Return sum_m log sum_z p_m(z) exp(w[m, z]) of each row w; x are the logits of p_m."""
        p = self._all_states(x).softmax(-1).movedim(-2, 0)  # (units, B, states)
        factors = self.by_unit(weights).exp().permute(1, 2, 0)  # (units, states - 1, rows)
        # The first state of a unit has the weight 0, and so the factor 1.
        return (p[..., :1] + p[..., 1:] @ factors).log().sum(0)

    def scene_bias(self, source: Int[Tensor, "B"] | None) -> Float[Tensor, "B|1 V"]:
        """Return b + a[q] + u[q] of whole scenes; for a source q of -1 or None, b + u[-1]."""
        if source is None or not self.spec.profiles:
            return (self.b + self.u[-1]).unsqueeze(0)
        return self.b + _rows(self.a, source) + self.u[source]

    def source_weights(
        self, v: Float[Tensor, "B V"], source: Int[Tensor, "B"] | None
    ) -> Float[Tensor, "B sources"]:
        """Return p(q | v, source): 1 for a stated source. A source of -1 or None is unknown."""
        inferred = (self.f + v @ self.a.T).softmax(-1)
        if source is None or not self.spec.profiles:
            return inferred
        stated = torch.nn.functional.one_hot(source.clamp(min=0), self.spec.profiles)
        return torch.where((source >= 0).unsqueeze(-1), stated.to(v.dtype), inferred)

    def object_log_odds(
        self,
        v: Float[Tensor, "B V"],
        *,
        room: Int[Tensor, "B"] | None = None,  # -1: unknown
        source: Int[Tensor, "B"] | None = None,  # -1: unknown
        share: Int[Tensor, "B"] | None = None,  # bin of `LISTED_SHARES`; adds kappa
    ) -> Float[Tensor, "B V"]:
        """Return the log-odds of each unlisted class given the listed classes v, in closed form."""
        bias = self.b + self.source_weights(v, source) @ self.a + self.room_bias(room)
        log_odds = bias + self.hidden_log_odds(self.hidden_logits(v, room), self.W)
        if (couplings := self.couplings) is not None:
            log_odds = log_odds + sparse_product(v, couplings)
        return log_odds if share is None else log_odds + self.kappa[share]

    def room_bias(self, room: Int[Tensor, "B"] | None) -> Float[Tensor, "B|1 V"]:
        """Return the couplings Y[t] of the room type t to the classes."""
        return _rows(self.Y, room) if self.spec.coupled else torch.zeros(1, self.spec.V)

    def room_rate(
        self, room: Int[Tensor, "B"] | None, source: Int[Tensor, "B"] | None
    ) -> Float[Tensor, "B|1"]:
        """Return the bias e_t + y_qt of the room type of each scene."""
        if room is None or not self.spec.C:
            return torch.zeros(1)
        rate = self.e[room.clamp(min=0)]
        if source is not None and self.spec.profiles:
            rate = rate + self.y[source.clamp(min=0), room.clamp(min=0)] * (source >= 0)
        return rate * (room >= 0)

    def room_log_p(
        self, v: Float[Tensor, "B V"], source: Int[Tensor, "B"] | None = None
    ) -> Float[Tensor, "B C"]:
        """Return log p(t | v, source) of each room type t, with the mean over the sources."""
        logits = self.e + self.hidden_log_odds(self.hidden_logits(v), self.Q)
        if self.spec.coupled:
            logits = logits + sparse_product(v, self.Y.T)
        if not self.spec.profiles:
            return logits.log_softmax(-1)
        by_source = (logits.unsqueeze(-2) + self.y).log_softmax(-1)  # log p(t | v, q)
        return (self.source_weights(v, source).unsqueeze(-1).log() + by_source).logsumexp(-2)

    def free_energy(
        self,
        v: Float[Tensor, "B V"],
        room: Int[Tensor, "B"] | None = None,
        source: Int[Tensor, "B"] | None = None,
    ) -> Float[Tensor, "B"]:
        """Return F = -log sum over h1 and r of exp(-E), in closed form."""
        free = -(v * self.scene_bias(source)).sum(-1)
        if (couplings := self.couplings) is not None:
            free = free - 0.5 * (sparse_product(v, couplings) * v).sum(-1)
            free = free - (v * self.room_bias(room)).sum(-1)
        log_states = self._all_states(self.hidden_logits(v, room)).logsumexp(-1).sum(-1)
        return free - self.room_rate(room, source) - log_states

    @abstractmethod
    def start_relations(
        self,
        by_relation: Float[Tensor, "A"],  # log-odds that an observed relation holds
        by_unit: Float[Tensor, "T"],  # log-odds of a triple in a scene with relations
        mean_log_counts: Float[Tensor, "V"],  # of the number of instances of each class
    ) -> None:
        """Set the relation biases from statistics of the training data."""

    @abstractmethod
    def edges(self, classes: Int[Tensor, "B n"], counts: Int[Tensor, "B n"] | None = None) -> Edges:
        """Return the units between classes (-1: padding) with counts (0: unknown; default 1)."""

    @abstractmethod
    def lay_out(self, scenes: SceneRelations) -> LaidOut:
        """Return the relations between classes as the relation units of this machine."""

    @abstractmethod
    def gate(self, edges: Edges, v: Float[Tensor, "... B V"]) -> Float[Tensor, "... B E"]:
        """Return 1 for each unit that can be 1 given v, else 0."""

    @abstractmethod
    def relation_logits(
        self, edges: Edges, v: Float[Tensor, "... B V"], h1: Float[Tensor, "... B H1"]
    ) -> Float[Tensor, "... B E"]:
        """Return the logit ℓ_e(v, h1) of each relation unit e, given states or means of h1."""

    def implied(
        self, edges: Edges, observed: Float[Tensor, "B E"], h1: Float[Tensor, "B H1"]
    ) -> Float[Tensor, "B E"]:
        """Return the changes of the relation logits by observed relations, given means of h1."""
        del edges, h1
        return torch.zeros_like(observed)

    def relation_term(
        self,
        edges: Edges,
        v: Float[Tensor, "... B V"],
        r: Float[Tensor, "... B E"],
        h1: Float[Tensor, "... B H1"],
    ) -> Float[Tensor, "... B"]:
        """Return sum_e g_e (r_e ℓ_e - log(1 + exp ℓ_e)) = log p(r | v, h1)."""
        logits = self.relation_logits(edges, v, h1)
        return ((r * logits - softplus(logits)) * self.gate(edges, v)).sum(-1)

    def energy(
        self,
        v: Float[Tensor, "B V"],
        r: Float[Tensor, "B E"],
        h1: Float[Tensor, "B H1"],
        edges: Edges,
        room: Int[Tensor, "B"] | None = None,
        source: Int[Tensor, "B"] | None = None,
    ) -> Float[Tensor, "B"]:
        """Return the energy E(v, r, h1, t) of states h1; +inf if a unit with gate 0 is 1."""
        hidden = (h1 * (self.hidden_bias(room) + v @ self.W)).sum(-1)
        log_weight = (v * self.scene_bias(source)).sum(-1) + hidden
        if (couplings := self.couplings) is not None:
            log_weight = log_weight + 0.5 * ((v @ couplings) * v).sum(-1)
            log_weight = log_weight + (v * self.room_bias(room)).sum(-1)
        log_weight = log_weight + self.room_rate(room, source)
        energy = -log_weight - self.relation_term(edges, v, r, h1)
        return torch.where((r > self.gate(edges, v)).any(-1), torch.inf, energy)


def sparse_product(v: Float[Tensor, "B V"], weights: Float[Tensor, "V k"]) -> Float[Tensor, "B k"]:
    """Return v @ weights by a sparse product: most classes of a scene are absent."""
    return torch.sparse.mm(v.to_sparse(), weights)


def _rows(table: Float[Tensor, "m k"], index: Int[Tensor, "B"] | None) -> Float[Tensor, "B|1 k"]:
    """Return the rows of a table at the indices; 0 for -1 and None."""
    if index is None or not len(table):
        return table.new_zeros(1, table.shape[1])
    return table[index.clamp(min=0)] * (index >= 0).unsqueeze(-1)
