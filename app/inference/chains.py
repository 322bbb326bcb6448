"""Sampling of scenes by Gibbs chains, each with its own random stream.

The module supports machines in the local form. A chain starts at a stored scene and makes sweeps
over h1, h2 and v. With observed relations, a chain samples h1 by Metropolis–Hastings. It samples
relations once, at the end, because in the local form they do not act on the other units.

The start of a chain is a random stored scene. Its weight, given the evidence, is

    log w = sum_{i given} log p(v_i = 1 | h1) + sum_{k held} log p(h1_k = 1)
            - 6 [sampled under another room type than t],

where h1 is the mean of the hidden units given the stored scene, and t is the requested room type.
If the machine stores no scene of room type t, the last term is h1·Q[t].

A sweep takes microseconds and releases the interpreter's lock. The result of a chain depends only
on its conditions and its random stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import chain_kernels as kernels
from app.inference.elementary import sigmoid, softplus
from app.inference.relation_kernels import draw_in_groups
from app.inference.relations import (
    NEVER,
    Ends,
    ObservedRelations,
    RelationUnits,
    all_pairs,
    ends_of,
    relation_units,
)
from app.inference.weights import Weights, unpack_scenes

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Bits = NDArray[np.uint8]

OTHER_ROOM = np.float32(6.0)
"""Reduction of the log weight of stored scenes whose room type differs from the requested one."""

# A chain generates the random numbers of this many sweeps in one call.
_AT_ONCE = 64


def random_stream(seed: int, number: int) -> np.random.Generator:
    """Return random stream ``number``, from 0, of a seed. The streams are independent."""
    sequence = np.random.SeedSequence(seed, spawn_key=(number,))
    return np.random.Generator(np.random.PCG64(sequence))


class Arrays(NamedTuple):
    """Weights for the compiled kernels. `weights.layout` explains the attributes not listed here.

    Attributes:
        WT: (H1, V), transpose of W.
        JT: (H2, H1), transpose of J.
        directions: (H1, R K') contribution of each h1 unit to the R K' factors of relation logits.
    """

    W: Floats
    WT: Floats
    J: Floats
    JT: Floats
    b: Floats
    c2: Floats
    directions: Floats


class ObservedUnits(NamedTuple):
    """E observed relation units, each on or off.

    Attributes:
        a: (E,) index of the relation, or 0 if the units do not share factors. It selects a row of
            `Arrays.directions`.
        z: (E, K') factors of each unit. They are constant during a chain.
        base: (E,) logit of each unit without the contribution of h1. It is constant during a chain.
        r: (E,) 1 if the relation holds, else 0.
    """

    a: Indices
    z: Floats
    base: Floats
    r: Floats


@dataclass(frozen=True, slots=True)
class Conditions:
    """The fixed conditions of a chain.

    Attributes:
        classes: (n,) int64, distinct indices of the classes that stay present, ascending.
        log_counts: (n,) log of the number of instances of each class.
        observed: observed relations between these classes, or None without observed relations.
        held, held2: distinct indices of the units of h1 and h2 that stay on.
        room: index of the room type, or None if unknown.
    """

    classes: Indices
    log_counts: Floats
    observed: ObservedRelations | None
    held: Indices
    held2: Indices
    room: int | None = None


@dataclass(frozen=True, slots=True)
class ChainState:
    """The final state of a chain.

    Attributes:
        classes: (n,) int64, indices of the present classes, ascending.
        h1, h2: indices of the hidden units that are on, ascending.
        logits: (A, n, n) logits of the relations between the classes at temperature 1.
        r: (A, n, n) bool, relations that are on. Relations of a class to itself are on only if
            observed.
    """

    classes: Indices
    h1: Indices
    h2: Indices
    logits: Floats
    r: Mask


class SceneChains:
    """Gibbs chains of a machine.

    Args:
        units: relation units of the machine. With None, the class builds them.

    Raises:
        ValueError: the class does not support the machine; see `supports`.
    """

    def __init__(self, weights: Weights, units: RelationUnits | None = None) -> None:
        if not self.supports(weights):
            raise ValueError(
                "compiled chains need a machine in the local form with float32 weights"
            )
        self.machine = weights
        self.units = units or relation_units(weights)
        W, J, H1 = weights["W"], weights["J"], weights.spec.H1
        shared = self.units.G.reshape(-1, H1) if len(self.units.G) else np.eye(H1)
        self.arrays = Arrays(
            W=W,
            WT=np.ascontiguousarray(W.T),
            J=J,
            JT=np.ascontiguousarray(J.T),
            b=weights["b"],
            c2=weights["c2"],
            directions=np.ascontiguousarray(shared.T, np.float32),
        )
        # (N, H1) means of h1 given the stored scenes.
        self.mean: Floats = np.zeros((0, H1), np.float32)
        if weights.spec.N:
            x, _ = weights.with_second_layer(weights["c1"] + weights.scenes @ W)
            self.mean = sigmoid(x).astype(np.float32)

    @staticmethod
    def supports(weights: Weights) -> bool:
        """Return whether this module supports the machine: it needs the local form in float32."""
        return weights.spec.is_local and weights["W"].dtype == np.float32

    def under(self, conditions: Conditions, temperature: float = 1.0) -> ConditionedChains:
        """Return the chains under the conditions of one request."""
        return ConditionedChains(self, conditions, temperature)

    def sample_weights(self, conditions: Conditions) -> NDArray[np.float64]:
        """Return the probability of each stored scene as the start of a chain, (N,); see module."""
        spec, Q, room = self.machine.spec, self.machine["Q"], conditions.room
        log_weights = np.zeros(len(self.mean), np.float32)
        if room is not None and spec.C:
            same_room = self.machine["fantasy_rooms"] == room
            if same_room.any():
                log_weights += np.where(same_room, 0, -OTHER_ROOM)
            else:
                log_weights += self.mean @ Q[room]
        classes = conditions.classes
        logits = self.machine["b"][classes] + self.mean @ self.machine["W"][classes].T
        log_weights -= softplus(-logits).sum(1)
        log_weights += np.log(np.maximum(self.mean[:, conditions.held], 1e-37)).sum(1)
        weights = np.exp(log_weights - log_weights.max()).astype(np.float64)
        probabilities: NDArray[np.float64] = weights / weights.sum()
        return probabilities


class ConditionedChains:
    """Chains under the same conditions. Each chain has its own random stream.

    `SceneChains.under` creates this object.
    """

    def __init__(self, chains: SceneChains, conditions: Conditions, temperature: float) -> None:
        self._chains, self._machine, self._w = chains, chains.machine, chains.arrays
        spec = chains.machine.spec
        self._beta = np.float32(1.0 / temperature)
        self._bias = chains.machine.room_bias(conditions.room)
        self._required_classes = _indicator(spec.V, conditions.classes)
        self._required_h1 = _indicator(spec.H1, conditions.held)
        self._required_h2 = _indicator(spec.H2, conditions.held2)
        self._classes, self._observed_relations = conditions.classes, conditions.observed
        self._observed = self._observed_units(conditions)
        # Cumulative probabilities of the stored scenes as the start of a chain.
        self._start_cdf = np.zeros(0)
        if spec.N:
            self._start_cdf = np.cumsum(chains.sample_weights(conditions))

    def _observed_units(self, conditions: Conditions) -> ObservedUnits:
        observed, units = conditions.observed, self._chains.units
        if observed is None:
            empty = np.zeros(0, np.float32)
            width = units.G.shape[1] if len(units.G) else self._machine.spec.H1
            no_factors = np.zeros((0, width), np.float32)
            return ObservedUnits(a=np.zeros(0, np.int64), z=no_factors, base=empty, r=empty)
        ends = _present(conditions.classes, observed.i, observed.j, conditions.log_counts)
        selected = units.select(observed.a, ends)
        a = selected.a if len(units.G) else np.zeros_like(selected.a)
        return ObservedUnits(a, selected.z, selected.base, observed.r[selected.kept])

    def draw(self, steps: int, stream: np.random.Generator) -> ChainState:
        """Run ``steps`` sweeps of one chain with its random stream and return its final state.

        The chain starts at a random stored scene; see `SceneChains.sample_weights`. If the machine
        stores no scenes, the start has only the required classes, and h1 follows from its biases.
        """
        V, H1 = self._w.W.shape
        present, h1_mean = np.zeros(V, np.uint8), sigmoid(self._bias)
        if len(self._start_cdf):
            start = int(np.searchsorted(self._start_cdf[:-1], stream.random(), "right"))
            packed = self._machine["fantasies"][start : start + 1]
            present = unpack_scenes(packed, V)[0].astype(np.uint8)
            h1_mean = self._chains.mean[start]
        h1 = (stream.random(H1, np.float32) < h1_mean).astype(np.uint8) | self._required_h1
        h2 = np.zeros_like(self._required_h2)
        if len(h2):
            h2_mean = sigmoid(self._machine["c2"] + h1 @ self._machine["J"])
            h2 = (stream.random(len(h2), np.float32) < h2_mean) | self._required_h2
        return self.move(present | self._required_classes, h1, h2, steps, stream)

    def move(
        self, on: Bits, h1: Bits, h2: Bits, steps: int, stream: np.random.Generator
    ) -> ChainState:
        """Continue a chain from a state, change the state in place, and return the final state.

        The state has the presence of the classes (V,) and the hidden units h1 (H1,) and h2 (H2,).
        """
        per_sweep = len(on) + 2 * len(h1) + len(h2) + kernels.PROPOSALS
        required = self._required_classes, self._required_h1, self._required_h2
        chain = on, h1, h2
        while steps > 0:
            uniform = stream.random((min(steps, _AT_ONCE), per_sweep), np.float32)
            kernels.sweeps(
                self._w, self._bias, *required, self._observed, self._beta, uniform, *chain
            )
            steps -= _AT_ONCE
        classes = np.flatnonzero(on)
        logits = self._logits(classes, h1)
        r = self._relations(classes, logits, stream)
        return ChainState(classes, np.flatnonzero(h1), np.flatnonzero(h2), logits, r)

    def _context_bias(self, classes: Indices, beta: float = 1.0) -> tuple[Floats, Floats]:
        """Return the logits x of h1 given present classes, (H1,), and the means of h2, (H2,)."""
        base = self._bias + self._machine["W"][classes].sum(0)
        x, m2 = self._machine.with_second_layer(base[None], beta)
        return x[0].astype(np.float32), m2[0]

    def _logits(self, classes: Indices, h1: Bits) -> Floats:
        """Return the logits of the relations between classes with one instance each, (A, n, n)."""
        n, A = len(classes), self._machine.spec.A
        ends = _present(classes, *all_pairs(n), np.zeros(n, np.float32))
        mean, _ = self._chains.units.normal(h1[None].astype(np.float32), ends, certain=True)
        return mean.reshape(A, n, n)

    def _relations(self, classes: Indices, logits: Floats, stream: np.random.Generator) -> Mask:
        """Sample the relations r (A, n, n) between different classes.

        Observed units keep their value. Relations of a class to itself are off unless observed,
        because other units do not depend on them.
        """
        r = np.zeros(logits.shape, np.bool_)
        free = ~np.broadcast_to(np.eye(len(classes), dtype=np.bool_), r.shape)
        observed = self._observed_relations
        if observed is not None:
            # The observed classes are always present, so ``classes`` contains each of them.
            rows = np.searchsorted(classes, self._classes)
            a, i, j = observed.a, rows[observed.i], rows[observed.j]
            has_unit = logits[a, i, j] > NEVER / 2
            units = a[has_unit], i[has_unit], j[has_unit]
            r[units], free[units] = observed.r[has_unit] > 0, False
        uniform, group_numbers = stream.random((2, *r.shape), np.float32)
        if self._machine.spec.G:
            x, _ = self._context_bias(classes, float(self._beta))
            weight = self._chains.units.implication_weights(x, float(self._beta))
            draw_in_groups(weight, self._beta * logits, free, uniform, group_numbers, r)
        else:
            r |= free & (uniform < sigmoid(self._beta * logits))
        return r

    def log_score(self, state: ChainState, shown: Mask, kept: Mask) -> float:
        """Return the log score of a sampled scene at temperature 1, up to a constant of the model.

            b·v + sum_k softplus(x_k) + log p(kept | v, h1)

        The first two terms are log p(v) + log Z. The last term is the log-probability of the
        relations given the sampled h1. With a second layer, m is the mean field of h2. Then x
        contains J m, and the score also contains c2·m and the entropy of m. This score is a lower
        bound on the log of the sum over h2.

        Args:
            state: final state of a chain.
            shown: (n,) bool, True for classes that count as present.
            kept: (A, n, n) bool, True for relations that count as on.
        """
        listed = state.classes[shown]
        x, m = self._context_bias(listed)
        # A mean of exactly 0 or 1 has the entropy 0, but its logarithm would be infinite.
        uncertain = m[(m > 0) & (m < 1)].astype(np.float64)
        entropy = -(uncertain * np.log(uncertain) + (1 - uncertain) * np.log1p(-uncertain)).sum()
        logits = state.logits[:, shown][:, :, shown].astype(np.float64)
        on = kept[:, shown][:, :, shown]
        score = self._machine["b"][listed].sum() + softplus(x).sum() + self._machine["c2"] @ m
        return float(score + entropy + (on * logits - softplus(logits)).sum())


def _indicator(size: int, units: Indices) -> Bits:
    indicator = np.zeros(size, np.uint8)
    indicator[units] = 1
    return indicator


def _present(classes: Indices, i: Indices, j: Indices, log_counts: Floats) -> Ends:
    """Return `Ends` for pairs (i, j) of indices into ``classes``, with presence 1."""
    return ends_of(classes, np.ones(len(classes), np.float32), log_counts, i, j)
