"""The posterior given a scene: log-odds of objects, relations and unlisted classes.

The machine must have the local form. v are the object units, h1 the hidden units of the first
layer, and x their logits given the objects. Without observed relations p(h1 | v) is factorial, with
means m:

    m = sigmoid(x),   x = c1 + Q[t] + v'W + J m2

t is the room type. A second layer is fixed at its mean field m2 given the objects.

Observed relations e change the logits of h1 from x to their mean field y, see
`RelationUnits.fixed_point`. `Pull` can reduce this effect by a factor ω: x + ω (y - x) replaces y,
and ω slope_e replaces slope_e. Questions about objects and questions about relations have different
factors ω. Then

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `relations`

The judged unit is first subtracted from y. For an observed relation, this is its own slope. For a
present object it is W_i, the slopes of all its relations, and its effect through the second layer.
The slopes of other relations are not computed again.

`Completions` estimate the probability of classes that are present but unlisted. Each present class
is listed with probability c, the coverage. So, for the listed classes L,

    p(v, h | L) ∝ p(v, h) (1 - c)^{|v \\ L|}   for v ⊇ L

This is the same machine with log(1 - c) added to the biases of unlisted classes. Its posterior is
estimated from the chain samples v_f that the machine stores (`fantasies`). σ is the logistic
function.

 1. Each sample has a context h_f ~ p(h1 | v_f), drawn once, and logits l = b + W h_f. Its
    importance weight for a scene is

        log w_f = sum_{i in L} log σ(l_i) + sum_{i not in L} log(1 - c σ(l_i)) + room

    Both sums exclude structure (walls …). `room` is 0 without a room type.
 2. Systematic resampling with offsets (m + 1/2) / M selects M samples.
 3. Each selected sample m becomes a completion of the scene. It adds each unlisted class j, except
    structure, for which l_j + log(1 - c) > logit u_mj. The numbers u are fixed: one in each of M
    equal strata of [0, 1) for each class.
 4. Given a completion, the context is summed out in closed form. Class i is first subtracted from
    y:

        log-odds_mi = b_i + log(1 - c) + sum_k [softplus(y_k + W_ik) - softplus(y_k)]

    The answer is the log-odds of the mean of σ(log-odds_mi) over the completions.

All requests use the same random numbers, so the same scene always gets the same answer.

The chain samples may have different room types. Then they follow a mixture over these types, in
which n_s samples have type s. For a scene of room type t,

    room = Q[t]·h_f - log sum_s n_s exp(Q[s]·h_f) / Z_s

with Z_s from the multistate Bennett acceptance ratio. A scene without a room type uses the mixture
itself.

Sources: self-normalised importance sampling with resampling and one Rao–Blackwellised Gibbs step;
Shirts and Chodera, "Statistically optimal analysis of samples from multiple equilibrium states"
(2008).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import objects
from app.inference.elementary import sigmoid
from app.inference.objects import ContextScorer, group_size
from app.inference.relations import Between, Context, Ends, Given
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

COMPLETIONS = 16
SEED = 20180521
"""Seed of the contexts h_f and the numbers u."""

# Up to this slope, the effect of an observed relation on itself is subtracted to first order
# (docs/decisions/inference.md).
_GENTLE = 0.5
_NO_SLOPES = np.zeros(0, dtype=np.float32)

# For smaller logits l, e^-l would overflow float32.
_LEAST_LOGIT = np.float32(-80.0)
# Number of coverage values whose weights of an empty scene are cached, 4 N bytes each.
_KEPT = 32
# Products of _FACTORS factors of at least _LEAST stay within the range of float32.
_FACTORS, _LEAST = 4, np.float32(1e-7)
_ROOM_SWEEPS = 100
_SETTLED = 1e-7
# Smallest log p of a sample relative to its best room: products of two stay within float64.
_LEAST_PULL = -300.0


class Pull(NamedTuple):
    """Factors ω of the effect of observed relations on h1, from 0 to 1, by kind of question."""

    objects: float = 1.0
    relations: float = 1.0


FULL = Pull()


class ClosedForm:
    """Log-odds of objects and relations in closed form.

    The same scene always gives bit-identical log-odds. Other questions have no effect on them.

    Raises:
        ValueError: the machine does not fit this closed form; see `fits`.
    """

    def __init__(self, weights: Weights) -> None:
        if not self.fits(weights):
            raise ValueError("the closed form requires the local form and bounded float32 weights")
        self._weights = weights
        self.W, self.b = weights["W"], weights["b"]
        self._c1, self._Q = weights["c1"], weights["Q"]
        self.units = weights.spec.kind.units(weights)
        self._group = group_size(self.W)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine has the local form and bounded float32 weights."""
        return (
            weights.spec.is_local
            and weights["W"].dtype == np.float32
            and group_size(weights["W"]) > 0
        )

    def context(
        self,
        classes: Places,
        presence: Floats,
        log_counts: Floats,
        room: int | None = None,
        given: Given | None = None,
        pull: Pull = FULL,
    ) -> Context:
        """Logits of h1 given the objects, the room type and the given relations.

        Args:
            classes: (n,) distinct classes of the scene.
            presence: (n,) probability that each class is present.
            log_counts: (n,) log of the number of instances of each class.
            room: index of the room type; None if unknown.
            given: observed relations; None without any.
            pull: factors of the effect of the observed relations.
        """
        x: Floats = self._c1 + presence @ self.W[classes]
        if room is not None and len(self._Q):
            x += self._Q[room]
        through = None
        if self._weights.spec.H2:
            x, through = self._second_layer(x, classes, presence)
        scene = classes, presence, log_counts
        if given is None or not len(given.a):
            none = _NO_SLOPES
            return Context(*scene, x, x, None, None, none, x, none, through)
        i, j = given.i, given.j
        ends = Ends(
            *(classes[i], classes[j], log_counts[i], log_counts[j], presence[i], presence[j])
        )
        y, units, slopes = self.units.fixed_point(x, given, ends)
        object_y, object_slopes = _scaled(pull.objects, x, y, slopes)
        y, slopes = _scaled(pull.relations, x, y, slopes)
        return Context(*scene, x, y, given, units, slopes, object_y, object_slopes, through)

    def _second_layer(
        self, base: Floats, classes: Places, presence: Floats
    ) -> tuple[Floats, Floats]:
        """x, (H1,), and the effect of each class on x through the second layer, (n, H1)."""
        without = base - presence[:, None] * self.W[classes]
        bases = np.concatenate([base[None], without]).astype(np.float32)
        x, _ = self._weights.with_second_layer(bases)
        pulled = (x - bases).astype(np.float32)
        return x[0].astype(np.float32), pulled[0] - pulled[1:]

    def relation_log_odds(self, context: Context, between: Between | None = None) -> Floats:
        """Log-odds of all relations between the classes, (A, n, n).

        Each relation is judged as if it were unobserved itself.
        """
        between = self.units.between(context) if between is None else between
        found = self.units.log_odds(between)
        given, units = context.given, context.units
        if given is not None and units is not None:
            steep = np.flatnonzero(np.abs(context.slopes) > _GENTLE)
            if len(steep):
                where = units.place[steep]
                place = given.a[where], given.i[where], given.j[where]
                found[place] = self.units.without_itself(
                    context, *place, context.slopes[steep], between.shift
                )
        return found

    def unit_log_odds(self, context: Context, a: Places, i: Places, j: Places) -> Floats:
        """Log-odds of E relations, each judged as if it were unobserved itself, (E,).

        Args:
            a: (E,) canonical relations.
            i, j: (E,) indices of subject and object class in the scene.
        """
        given, shift, _ = self.units.said(context)
        slopes = given[a, i, j] if len(given) else np.zeros(len(a), dtype=np.float32)
        return self.units.without_itself(context, a, i, j, slopes, shift)

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """Log-odds of one relation of N absent classes to an anchor, if they were present, (N,).

        Args:
            candidates: (N,) absent classes.
            relation: canonical relation.
            anchor: index of the anchor's class in the scene.
            outgoing: whether the candidate is the relation's subject; otherwise the anchor is.
        """
        both = self.units.placement_log_odds(context, candidates, np.array([anchor]), relation)
        return both[0 if outgoing else 1][:, 0, 0]

    def shares(self, context: Context) -> Floats:
        """The sum that each class and its relations add to y, (n, H1)."""
        share = self.units.shares(context)
        return share if context.through is None else share + context.through

    def gains_given_rest(self, context: Context, shares: Floats) -> Floats:
        """The change of each class's log-odds b_i by the rest of the scene, (n,)."""
        found: Floats = objects.gains_without(
            context.object_y, shares, self.W[context.classes], self._group
        )
        return found

    def reasons(self, context: Context, shares: Floats, gains: Floats, rows: Places) -> Floats:
        """The change of the gains of the classes in `rows` by each other class, (N, n).

        Args:
            context: the context of the scene.
            shares: (n, H1) result of `shares`.
            gains: (n,) result of `gains_given_rest`.
            rows: (N,) indices of the explained classes in the scene.
        """
        without: Floats = objects.gains_without_others(
            *(context.object_y, shares, self.W[context.classes], rows),
            *(*self.units.common(context), self._group),
        )
        change = gains[rows, None] - without
        change[np.arange(len(rows)), rows] = 0
        return change

    def reasons_for_absent(self, context: Context, shares: Floats, candidates: Places) -> Floats:
        """The change of absent classes' log-odds by each class of the scene, (N, n).

        Args:
            context: the context of the scene.
            shares: (n, H1) result of `shares`.
            candidates: (N,) absent classes.
        """
        found: Floats = objects.reasons_for_absent(
            context.object_y, shares, self.W[candidates], self._group
        )
        return found


def _scaled(pull: float, x: Floats, y: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    """x + pull (y - x), and pull slopes. A pull of 1 returns y and slopes unchanged."""
    if pull >= 1:
        return y, slopes
    weight = np.float32(pull)
    return x + weight * (y - x), weight * slopes


class Completions:
    """Posterior of unlisted classes, for a machine with fixed weights.

    Args:
        weights: weights and stored samples of the machine.
        structure: (V,) which classes are structure; completions ignore these classes.
        scorer: scorer of the same machine.
        count: M, number of completions of a scene.

    Raises:
        ValueError: the machine has no stored samples, or its weights are too large; see `fits`.
    """

    def __init__(
        self,
        weights: Weights,
        structure: Mask,
        scorer: ContextScorer,
        count: int = COMPLETIONS,
    ) -> None:
        if not self.fits(weights):
            raise ValueError("completions require stored samples and bounded float32 weights")
        self._scorer, self._structure = scorer, structure
        self._W, self._b = weights["W"], weights["b"]
        generator = np.random.Generator(np.random.Philox(SEED))
        contexts = _contexts(weights, generator)
        logits = self._b + contexts @ self._W.T
        # Shapes (V, N) for samples and (V, M) for completions: each class is contiguous in memory.
        self._odds_against = np.exp(-np.maximum(logits, _LEAST_LOGIT)).T.copy()
        self._noise = np.exp(-_stratified_logits(count, len(self._b), generator)).T.copy()
        self._rooms = _room_weights(weights, contexts)
        # Each instance has its own cache: a cache of the method would keep every instance alive.
        self._empty = lru_cache(maxsize=_KEPT)(self._unlisted_evidence)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine stores samples, and its weights are small enough for float32."""
        return weights.spec.N > 0 and group_size(weights["W"]) > 0

    def log_odds(
        self,
        y: Floats,
        classes: Places,
        presence: Floats,
        coverage: float,
        room: int | None = None,
    ) -> Floats:
        """Log-odds that each class is present but unlisted, (V,).

        Entries of listed classes have no meaning.

        Args:
            y: (H1,) logits of h1 given the evidence, with unlisted classes absent.
            classes: (n,) the listed classes.
            presence: (n,) probability that each listed class is present.
            coverage: c, below 1.
            room: index of the room type; None if unknown.
        """
        base = self._empty(coverage)
        if room is not None and len(self._rooms):
            base = base + self._rooms[room]
        unlisted = np.float32(math.log1p(-coverage))
        telling = ~self._structure[classes]
        picked = objects.resampled(
            *(base, self._odds_against, classes[telling], presence[telling]),
            *(np.float32(1 - coverage), self._noise.shape[1]),
        )
        usable = ~self._structure
        usable[classes] = False
        found: Floats = objects.completed_log_odds(
            *(y, picked, self._odds_against, np.exp(unlisted) * self._noise, usable),
            *(self._b + unlisted, self._W, self._scorer.exp_w, self._scorer.group),
        )
        return found

    def _unlisted_evidence(self, coverage: float) -> Floats:
        """Sum of log(1 - c σ(l_i)) over all classes i except structure, for each sample, (N,)."""
        chance = 1 / (1 + self._odds_against[~self._structure])
        total = np.zeros(chance.shape[1], np.float32)
        for start in range(0, len(chance), _FACTORS):
            factors = 1 - np.float32(coverage) * chance[start : start + _FACTORS]
            total += np.log(np.maximum(factors, _LEAST).prod(0))
        return total


def _contexts(weights: Weights, generator: np.random.Generator) -> Floats:
    """Draw h_f ~ p(h1 | v_f), (N, H1), with a second layer fixed at its mean field."""
    base = weights["c1"] + weights.scenes @ weights["W"]
    if weights.spec.C:
        rooms = weights["fantasy_rooms"]
        base += np.where((rooms >= 0)[:, None], weights["Q"][rooms.clip(min=0)], 0)
    y, _ = weights.with_second_layer(base)
    on: Floats = (generator.random(y.shape) < sigmoid(y)).astype(np.float32)
    return on


def _stratified_logits(count: int, classes: int, generator: np.random.Generator) -> Floats:
    """Logits of uniform numbers, (M, V), one in each of M equal strata for each class."""
    strata = generator.random((count, classes)).argsort(0)
    uniform = (strata + generator.random((count, classes))) / count
    uniform = uniform.clip(1e-12, 1 - 1e-12)
    return (np.log(uniform) - np.log1p(-uniform)).astype(np.float32)


def _room_weights(weights: Weights, contexts: Floats) -> Floats:
    """The term `room` of log w for each room type and sample, (C, N)."""
    spec = weights.spec
    if not spec.C:
        return np.zeros((0, 0), dtype=np.float32)
    pull = contexts.astype(np.float64) @ weights["Q"].T.astype(np.float64)
    # The last state is "no room type".
    pull = np.concatenate([pull, np.zeros((len(pull), 1))], 1)
    rooms = weights["fantasy_rooms"]
    drawn, sizes = np.unique(np.where(rooms < 0, spec.C, rooms), return_counts=True)
    # p(sample | room) up to a factor per sample, so that both sums of the iteration are matrix
    # products. The lower bound keeps every entry, and so every sum, above 0.
    top = pull[:, drawn].max(1)
    share = np.exp(np.maximum(pull[:, drawn] - top[:, None], _LEAST_PULL))
    log_z = np.zeros(len(drawn))
    mixture = np.ones(len(pull))
    for _ in range(_ROOM_SWEEPS):
        mixture = share @ (sizes * np.exp(-log_z))
        before, log_z = log_z, np.log((1 / mixture) @ share)
        log_z -= log_z[0]
        if np.abs(log_z - before).max() < _SETTLED:
            break
    log_mixture = top + np.log(mixture)
    return np.ascontiguousarray((pull[:, : spec.C] - log_mixture[:, None]).T.astype(np.float32))
