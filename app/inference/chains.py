"""Sampling of scenes by Gibbs chains, each with its own random stream.

A chain starts at a stored scene and makes sweeps over h1 and v. It draws relations once, at the
end, because relations do not act on the other units. Observed relations hold from the start.

The start of a chain is a random stored scene. Its weight, given the evidence, is

    log w = sum_{i given} log p(v_i = 1 | h1, other classes)
            - 6 [sampled under another room type than t],

where h1 is the mean of the hidden units given the stored scene, and t is the requested room type.
If the machine stores no scene of room type t, the last term is h1·Q[t] + v·Y[t]. The method is
sampling importance resampling, followed by Gibbs sweeps. A chain keeps its room type. Without a
requested room type, it keeps that of its start.

The base rates are those of whole scenes (`Weights.scene_bias`). They stay the same in all sweeps.

The result of a chain depends only on its conditions and its random stream.

Source: Gordon, Salmond and Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
estimation" (1993), for resampling and moving.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import exp, logistic, sigmoid, softplus
from app.inference.implications import draw_in_groups
from app.inference.relation_units import (
    NEVER,
    ObservedRelations,
    Pairs,
    RelationUnits,
    all_pairs,
    relation_units,
)
from app.inference.weights import Weights, unpack_scenes
from app.scene.spatial_relations import HOLDS

Bits = UInt8[NDArray, " V"]
"""Presence of each class."""

OTHER_ROOM = np.float32(6.0)
"""Reduction of the log weight of stored scenes whose room type differs from the requested one."""

MOST_DRAWN = 256
"""Maximum number of classes that a chain adds to the required ones.

Three times as many as shipped models add at the highest temperature. The arrays of relations have
the square of the number of classes.
"""

# A chain generates the random numbers of this many sweeps in one call.
_AT_ONCE = 64


class CrowdedSceneError(ValueError):
    """A chain has added more than `MOST_DRAWN` classes to a scene."""


def random_stream(seed: int, number: int) -> np.random.Generator:
    """Return random stream ``number``, from 0, of a seed. The streams are independent."""
    sequence = np.random.SeedSequence(seed, spawn_key=(number,))
    return np.random.Generator(np.random.PCG64(sequence))


@dataclass(frozen=True, slots=True)
class Conditions:
    """The fixed conditions of a chain."""

    classes: Int[NDArray, " n"]  # classes that stay present, distinct and ascending
    observed: ObservedRelations | None  # relations between these classes
    room: int | None = None  # room type; None if unknown
    profile: int | None = None  # data source whose base rates apply


@dataclass(frozen=True, slots=True)
class ChainState:
    """The final state of a chain."""

    classes: Int[NDArray, " n"]  # present classes, ascending
    room: int | None  # room type; None if unknown
    logits: Float[NDArray, "A n n"]  # of the relations, at temperature 1
    r: Bool[NDArray, "A n n"]  # relations that hold; those of a class to itself only if observed


class ChainArrays(NamedTuple):
    """Weights for Gibbs sweeps; see `weights.layout`."""

    W: Float[NDArray, "V H1"]
    WT: Float[NDArray, "H1 V"]  # transpose of W
    L: Float[NDArray, "V|0 V"]  # without rows for a machine without couplings
    b: Float[NDArray, " V"]


class SceneChains:
    """Gibbs chains of a machine. Scenes of `excluded` room types start a chain only on request."""

    def __init__(
        self, weights: Weights, units: RelationUnits | None = None, excluded: Collection[int] = ()
    ) -> None:
        self.machine, self._excluded = weights, list(excluded)
        self.units = units or relation_units(weights)
        W, spec = weights["W"], weights.spec
        self.arrays = ChainArrays(
            W=W,
            WT=np.ascontiguousarray(W.T),
            L=weights["L"] if spec.coupled else np.zeros((0, spec.V), np.float32),
            b=weights["b"],
        )
        self.mean: Float[NDArray, "N H1"] = np.zeros((0, spec.H1), np.float32)  # of h1
        if spec.N:
            self.mean = weights.sample_means

    def under(self, conditions: Conditions, temperature: float = 1.0) -> "ConditionedChains":
        """Return the chains under the conditions of one request."""
        return ConditionedChains(self, conditions, temperature)

    def continued(
        self,
        present: Float[NDArray, " V"],
        room: int | None,
        steps: int,
        stream: np.random.Generator,
    ) -> Bits:
        """Return the presence of each class after ``steps`` sweeps of a chain from a scene."""
        conditions = Conditions(np.zeros(0, np.int64), None, room)
        on = (present > 0).astype(np.uint8)
        self.under(conditions).sweep(on, steps, stream)
        return on

    def sample_weights(self, conditions: Conditions) -> Float[NDArray, " N"]:
        """Return the probability of each stored scene as the start of a chain; see the module."""
        machine, classes = self.machine, conditions.classes
        logits = machine["b"][classes] + self.mean @ machine["W"][classes].T
        if machine.spec.coupled:
            logits += machine.chain_samples @ machine["L"][:, classes]
        log_weights = self._room_log_weights(conditions.room) - softplus(-logits).sum(1)
        weights = np.exp(log_weights - log_weights.max()).astype(np.float64)
        return weights / weights.sum()

    def _room_log_weights(self, room: int | None) -> Float[NDArray, " N"]:
        """Return the log weight of each stored scene for a requested room type, or for none."""
        machine = self.machine
        stored_rooms = machine["fantasy_rooms"]
        if room is None:
            is_other = np.isin(stored_rooms, self._excluded)
        elif machine.spec.C:
            is_other = stored_rooms != room
            if is_other.all():
                fit = self.mean @ machine["Q"][room]
                return fit + machine.chain_samples @ machine.room_couplings(room)
        else:
            is_other = np.zeros(len(self.mean), np.bool_)
        return np.where(is_other, -OTHER_ROOM, np.float32(0))


class ConditionedChains:
    """Chains under the same conditions; see `SceneChains.under`."""

    def __init__(self, chains: SceneChains, conditions: Conditions, temperature: float) -> None:
        self._chains, self._machine = chains, chains.machine
        self._conditions, self._temperature = conditions, temperature
        evidence = conditions.classes, conditions.profile, conditions.room
        bias, self._room_bias = chains.machine.scene_bias(*evidence)
        self._w = chains.arrays._replace(b=bias)  # weights of the sweeps
        self._beta = np.float32(1.0 / temperature)
        self._room, self._bias = conditions.room, chains.machine.room_bias(conditions.room)
        self._required_classes = np.zeros(chains.machine.spec.V, np.uint8)
        self._required_classes[conditions.classes] = 1
        self._others: dict[int | None, ConditionedChains] = {}  # by room type

    @cached_property
    def _start_cdf(self) -> Float[NDArray, " N"]:
        """Cumulative probabilities of the stored scenes as the start of a chain."""
        return np.cumsum(self._chains.sample_weights(self._conditions))

    def _in_room(self, room: int | None) -> "ConditionedChains":
        """Return the chains under the same conditions in a room type."""
        if room == self._room:
            return self
        if room not in self._others:
            conditions = replace(self._conditions, room=room)
            self._others[room] = self._chains.under(conditions, self._temperature)
        return self._others[room]

    def draw(self, steps: int, stream: np.random.Generator) -> ChainState:
        """Run ``steps`` sweeps of one chain with its random stream and return its final state.

        Raises:
            CrowdedSceneError: the scene has too many classes.
        """
        on, room = np.zeros(self._machine.spec.V, np.uint8), self._room
        if self._machine.spec.N:
            start = int(np.searchsorted(self._start_cdf[:-1], stream.random(), "right"))
            packed = self._machine["fantasies"][start : start + 1]
            on = unpack_scenes(packed, len(on))[0].astype(np.uint8)
            own = int(self._machine["fantasy_rooms"][start])
            room = own if room is None and own >= 0 else room
        return self._in_room(room)._continued(on, steps, stream)

    def _continued(self, on: Bits, steps: int, stream: np.random.Generator) -> ChainState:
        """Return the state of a chain after ``steps`` sweeps, which change the classes ``on``."""
        h1 = self.sweep(on, steps, stream)
        classes = np.flatnonzero(on)
        if (drawn := len(classes) - len(self._conditions.classes)) > MOST_DRAWN:
            most = f"more than the maximum of {MOST_DRAWN}"
            raise CrowdedSceneError(f"the model draws {drawn} classes for one scene, {most}")
        logits = self._logits(classes, h1)
        r = self._relations(classes, logits, stream)
        return ChainState(classes, self._room, logits, r)

    def sweep(self, on: Bits, steps: int, stream: np.random.Generator) -> Int[NDArray, " units"]:
        """Run sweeps that change the classes ``on`` in place. Return the states of the units."""
        on |= self._required_classes
        h1 = np.zeros(self._machine.spec.units, np.int64)
        while steps > 0:
            uniform = stream.random((min(steps, _AT_ONCE), len(h1) + len(on)), np.float32)
            sweeps(self._w, self._bias, self._required_classes, self._beta, uniform, on, h1)
            steps -= _AT_ONCE
        return h1

    def _hidden_logits(self, classes: Int[NDArray, " n"]) -> Float[NDArray, " H1"]:
        """Return the logits x of h1 given present classes."""
        return self._bias + self._machine["W"][classes].sum(0)

    def _logits(
        self, classes: Int[NDArray, " n"], h1: Int[NDArray, " units"]
    ) -> Float[NDArray, "A n n"]:
        """Return the logits of the relations between classes with one instance each."""
        n, spec = len(classes), self._machine.spec
        pairs = Pairs(classes, np.zeros(n, np.float32), np.ones(n, np.float32), *all_pairs(n))
        # 1 for the state of each unit, without an entry for the first state.
        entries = (h1[:, None] == np.arange(1, spec.states)).astype(np.float32).reshape(1, -1)
        mean, _ = self._chains.units.moments(entries, pairs, slice(0, spec.A), sampled=True)
        return mean.reshape(spec.A, n, n)

    def _relations(
        self,
        classes: Int[NDArray, " n"],
        logits: Float[NDArray, "A n n"],
        stream: np.random.Generator,
    ) -> Bool[NDArray, "A n n"]:
        """Sample the relations between different classes. Observed relations keep their value."""
        r = np.zeros(logits.shape, np.bool_)
        free = ~np.broadcast_to(np.eye(len(classes), dtype=np.bool_), r.shape)
        observed = self._conditions.observed
        if observed is not None:
            # The observed classes are always present, so ``classes`` contains each of them.
            rows = np.searchsorted(classes, self._conditions.classes)
            a, i, j = observed.a, rows[observed.i], rows[observed.j]  # relation, subject, object
            has_unit = logits[a, i, j] > NEVER / 2
            units = a[has_unit], i[has_unit], j[has_unit]
            r[units], free[units] = observed.r[has_unit] >= HOLDS, False
        uniform, group_numbers = stream.random((2, *r.shape), np.float32)
        hidden_logits = self._hidden_logits(classes)
        weight = self._chains.units.implication_weights(hidden_logits, float(self._beta))
        if weight is not None:
            draw_in_groups(weight, self._beta * logits, free, uniform, group_numbers, r)
        else:
            r |= free & (uniform < sigmoid(self._beta * logits))
        return r

    def log_score(
        self, state: ChainState, shown: Bool[NDArray, " n"], kept: Bool[NDArray, "A n n"]
    ) -> float:
        """Return the log score of a sampled scene at temperature 1.

        The score is a log-probability up to a constant of the model:

            (b + Y_t)·v + v'Lv/2 + e_t + sum_m log sum_z exp(x_mz) + log p(kept | v, h1)

        b contains the base rates, which depend on the profile or on the listed classes. The first
        terms are log p(v, t) + log Z, where t is the room type. An unknown room type has e_t = 0
        and Y_t = 0. Only `shown` classes count as present, and only `kept` relations as on.
        """
        if state.room != self._room:
            return self._in_room(state.room).log_score(state, shown, kept)
        listed, machine = state.classes[shown], self._machine
        hidden_logits = self._hidden_logits(listed).astype(np.float64)
        by_unit = hidden_logits.reshape(-1, machine.spec.states - 1)
        # The first state of each unit has the logit 0.
        log_sums = np.logaddexp.reduce(by_unit, axis=1, initial=0.0)
        logits = state.logits[:, shown][:, :, shown].astype(np.float64)
        on = kept[:, shown][:, :, shown]
        score = self._w.b[listed].sum() + log_sums.sum() + self._room_bias
        if machine.spec.coupled:
            score += 0.5 * machine["L"][np.ix_(listed, listed)].sum()
        return float(score + (on * logits - softplus(logits)).sum())


@compiled
def sweeps(
    w: ChainArrays,
    bias: Float[NDArray, " H1"],
    required: Bits,
    beta: float,
    uniform: Float[NDArray, "sweeps units+V"],
    on: Bits,
    h1: Int[NDArray, " units"],
) -> None:
    """Run Gibbs sweeps that change the presence `on` of the classes and the states `h1` in place.

    A sweep draws h1 given the classes, and then the classes. Coupled classes are drawn one after
    another, each given all others. `required` classes stay present. beta is 1 / temperature.
    `uniform` has a random number in [0, 1) for each draw: of units m, then of classes i and j.
    """
    (V, H1), units, coupled = w.W.shape, len(h1), len(w.L) > 0
    others = H1 // units  # states of a unit but the first, whose logit is 0
    x, field = np.empty(H1, np.float32), np.empty(V, np.float32)
    from_classes = np.zeros(V, np.float32)
    for i in range(V if coupled else 0):
        if on[i]:
            changed = w.L[i]
            for j in range(V):
                from_classes[j] += changed[j]
    for t in range(len(uniform)):
        row = uniform[t]
        # Loops compile faster than assignments of arrays.
        for k in range(H1):
            x[k] = bias[k]
        for i in range(V):
            field[i] = w.b[i]
            if on[i]:
                weights = w.W[i]
                for k in range(H1):
                    x[k] += weights[k]
        for m in range(units):
            logits, top = x[m * others : (m + 1) * others], np.float32(0.0)
            for z in range(others):
                top = max(top, beta * logits[z])
            total = exp(-top)
            for z in range(others):
                total += exp(beta * logits[z] - top)
            threshold, cumulative, state = row[m] * total, exp(-top), 0
            while state < others and threshold >= cumulative:
                cumulative += exp(beta * logits[state] - top)
                state += 1
            h1[m] = state
            if state:
                from_h1 = w.WT[m * others + state - 1]
                for i in range(V):
                    field[i] += from_h1[i]
        for i in range(V):
            logit = beta * (field[i] + from_classes[i])
            drawn = max(required[i], np.uint8(row[units + i] < logistic(logit)))
            if coupled and drawn != on[i]:
                sign, changed = np.float32(1.0 if drawn else -1.0), w.L[i]
                for j in range(V):
                    from_classes[j] += sign * changed[j]
            on[i] = drawn
