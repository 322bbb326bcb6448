"""What a machine says of a scene: its context given the observations, and its unlisted classes.

For machines in the local form. Without given relations p(h1 | v) is factorial, with means

    m = sigmoid(x),   x = c1 + Q[t] + v'W + J m2

A second layer is held at its mean field m2 given the objects. With given relations, h1 is held at
its mean field y, see `RelationUnits.fixed_point`. Where given relations must count for less, their
pull is scaled: y = x + ω (y - x) and ω slope_e take the place of y and slope_e, with an ω for
questions about objects and another for those about relations (`Pull`). So in any case

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `relations`

The closed form takes the judged unit out of y first. For a given relation that is its own slope.
For a present object it is W_i, the slopes of all its relations, and its part in the second layer.
The other slopes stay.

`Completions` are for classes that are there although a scene does not list them. A class that is
present is listed with probability c, the coverage. So for the listed classes L

    p(v, h | L) ∝ p(v, h) (1 - c)^{|v \\ L|}   for v ⊇ L

which is the machine itself with the biases of unlisted classes lowered by log(1 - c). Its
posterior is estimated from the chain samples v_f that a machine keeps (`fantasies`):

 1. Each has a context h_f ~ p(h1 | v_f), drawn once, and logits l = b + W h_f. For a scene it gets
    the importance weight, σ the logistic function,

        log w_f = sum_{i in L} log σ(l_i) + sum_{i not in L} log(1 - c σ(l_i)) + room

    Structure (walls …) is left out of both sums. `room` is 0 without a room type.
 2. Systematic resampling with offsets (m + 1/2) / M picks M samples.
 3. Each becomes a completion: an unlisted class j that is no structure is added if
    l_j + log(1 - c) > logit u_mj, with fixed numbers u: M strata of [0, 1) for each class.
 4. Given a completion the context is summed out in closed form, the class itself taken out of y:

        log-odds_mi = b_i + log(1 - c) + sum_k [softplus(y_k + W_ik) - softplus(y_k)]

    The answer is the log-odds of the mean of σ(log-odds_mi) over the completions.

The random numbers are the same for every request, so the same scene has the same answer.

Samples may have been drawn under room types, so they follow a mixture over these. Without a room
type they stand for all rooms as training had them. With room type t, room = Q[t]·h_f minus the log
of the mixture, sum_s n_s exp(Q[s]·h_f) / Z_s, with Z_s as in the multistate Bennett acceptance
ratio.

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
"""Of the contexts h_f and the numbers u."""

# Slopes up to which what a given relation says of itself is taken out to first order
# (docs/decisions/inference.md).
_GENTLE = 0.5
_NO_SLOPES = np.zeros(0, dtype=np.float32)

# Below it e^-l leaves float32.
_LEAST_LOGIT = np.float32(-80.0)
# Values of the coverage whose weights of an empty scene are kept, 4 N bytes each.
_KEPT = 32
# Factors whose product stays within float32: none is below _LEAST.
_FACTORS, _LEAST = 4, np.float32(1e-7)
_ROOM_SWEEPS = 100
_SETTLED = 1e-7
# Of log p of a sample beside the best room: products of two such stay within float64.
_LEAST_PULL = -300.0


class Pull(NamedTuple):
    """How strongly observed relations act on the context, from 0 to 1, by kind of question."""

    objects: float = 1.0
    relations: float = 1.0


FULL = Pull()


class ClosedForm:
    """Log-odds of objects and relations in closed form.

    The same scene gives the same bits, independent of other questions.

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, weights: Weights) -> None:
        if not self.fits(weights):
            raise ValueError("a closed form needs the local form and moderate weights in float32")
        self._weights = weights
        self.W, self.b = weights["W"], weights["b"]
        self._c1, self._Q = weights["c1"], weights["Q"]
        self.units = weights.spec.kind.units(weights)
        self._group = group_size(self.W)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine is one of those that this module is for."""
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
            room: index of the room type; None where it is not known.
            pull: how strongly the given relations act.
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
        """x, and what each class adds to it through the second layer."""
        without = base - presence[:, None] * self.W[classes]
        bases = np.concatenate([base[None], without]).astype(np.float32)
        x, _ = self._weights.with_second_layer(bases)
        pulled = (x - bases).astype(np.float32)
        return x[0].astype(np.float32), pulled[0] - pulled[1:]

    def relation_log_odds(self, context: Context, between: Between | None = None) -> Floats:
        """Log-odds of all relations between the classes, each without itself, (A, n, n)."""
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
        """The same of some units (E,), relations a from places i to places j."""
        given, shift, _ = self.units.said(context)
        slopes = given[a, i, j] if len(given) else np.zeros(len(a), dtype=np.float32)
        return self.units.without_itself(context, a, i, j, slopes, shift)

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """The same of many absent candidates (N,), were they there, to one class.

        Args:
            anchor: place of the class.
            outgoing: from the candidate to the anchor; otherwise back.
        """
        both = self.units.placement_log_odds(context, candidates, np.array([anchor]), relation)
        return both[0 if outgoing else 1][:, 0, 0]

    def shares(self, context: Context) -> Floats:
        """What each class and its relations add to y, (n, H1)."""
        share = self.units.shares(context)
        return share if context.through is None else share + context.through

    def gains_given_rest(self, context: Context, shares: Floats) -> Floats:
        """What the rest of a scene does for the log-odds of each of its classes, (n,)."""
        found: Floats = objects.gains_without(
            context.object_y, shares, self.W[context.classes], self._group
        )
        return found

    def reasons(self, context: Context, shares: Floats, gains: Floats, rows: Places) -> Floats:
        """How the gain of the classes in `rows` (N,) changes by each other class, (N, n).

        Args:
            gains: (n,) given the rest.
        """
        without: Floats = objects.gains_without_others(
            *(context.object_y, shares, self.W[context.classes], rows),
            *(*self.units.common(context), self._group),
        )
        change = gains[rows, None] - without
        change[np.arange(len(rows)), rows] = 0
        return change

    def reasons_for_absent(self, context: Context, shares: Floats, candidates: Places) -> Floats:
        """The same of absent classes (N,): what each present one does for them, (N, n)."""
        found: Floats = objects.reasons_for_absent(
            context.object_y, shares, self.W[candidates], self._group
        )
        return found


def _scaled(pull: float, x: Floats, y: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    """x + pull (y - x) and pull slopes; to the bit x at 0, and y and slopes at 1."""
    if pull >= 1:
        return y, slopes
    weight = np.float32(pull)
    return x + weight * (y - x), weight * slopes


class Completions:
    """Posterior of unlisted classes, for a machine whose weights do not change.

    Args:
        structure: (V,) classes that are never added, and tell nothing where they are unlisted.
        scorer: of the same machine.
        count: M, completions of a scene.

    Raises:
        ValueError: a machine without stored samples; see `fits`.
    """

    def __init__(
        self,
        weights: Weights,
        structure: Mask,
        scorer: ContextScorer,
        count: int = COMPLETIONS,
    ) -> None:
        if not self.fits(weights):
            raise ValueError("completions need stored samples and moderate weights in float32")
        self._scorer, self._structure = scorer, structure
        self._W, self._b = weights["W"], weights["b"]
        generator = np.random.Generator(np.random.Philox(SEED))
        contexts = _contexts(weights, generator)
        logits = self._b + contexts @ self._W.T
        # Of classes (V,) and samples (N,) or completions (M,): a class lies in one piece.
        self._odds_against = np.exp(-np.maximum(logits, _LEAST_LOGIT)).T.copy()
        self._noise = np.exp(-_stratified_logits(count, len(self._b), generator)).T.copy()
        self._rooms = _room_weights(weights, contexts)
        # Of the instance: a cache of the method would keep every instance alive.
        self._empty = lru_cache(maxsize=_KEPT)(self._unlisted_evidence)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine keeps samples, and products of its factors are safe."""
        return weights.spec.N > 0 and group_size(weights["W"]) > 0

    def log_odds(
        self,
        y: Floats,
        classes: Places,
        presence: Floats,
        coverage: float,
        room: int | None = None,
    ) -> Floats:
        """Log-odds of every class being there unlisted, (V,); of listed ones, without meaning.

        Args:
            y: (H1,) logits of h1 given all that is known, unlisted classes absent.
            classes, presence: (n,) the listed classes.
            coverage: c, below 1.
            room: index of the room type; None where it is not known.
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
        """sum_i log(1 - c σ(l_i)) over all classes but structure, (N,)."""
        chance = 1 / (1 + self._odds_against[~self._structure])
        total = np.zeros(chance.shape[1], np.float32)
        for start in range(0, len(chance), _FACTORS):
            factors = 1 - np.float32(coverage) * chance[start : start + _FACTORS]
            total += np.log(np.maximum(factors, _LEAST).prod(0))
        return total


def _contexts(weights: Weights, generator: np.random.Generator) -> Floats:
    """h_f ~ p(h1 | v_f), (N, H1); with a second layer, h2 at its mean field."""
    base = weights["c1"] + weights.scenes @ weights["W"]
    if weights.spec.C:
        rooms = weights["fantasy_rooms"]
        base += np.where((rooms >= 0)[:, None], weights["Q"][rooms.clip(min=0)], 0)
    y, _ = weights.with_second_layer(base)
    on: Floats = (generator.random(y.shape) < sigmoid(y)).astype(np.float32)
    return on


def _stratified_logits(count: int, classes: int, generator: np.random.Generator) -> Floats:
    """Logits of uniform numbers (M, V): each class has one number in each of M equal strata."""
    strata = generator.random((count, classes)).argsort(0)
    uniform = (strata + generator.random((count, classes))) / count
    uniform = uniform.clip(1e-12, 1 - 1e-12)
    return (np.log(uniform) - np.log1p(-uniform)).astype(np.float32)


def _room_weights(weights: Weights, contexts: Floats) -> Floats:
    """What a room type adds to log w of each sample, (C, N)."""
    spec = weights.spec
    if not spec.C:
        return np.zeros((0, 0), dtype=np.float32)
    pull = contexts.astype(np.float64) @ weights["Q"].T.astype(np.float64)
    # The last state is "no room type".
    pull = np.concatenate([pull, np.zeros((len(pull), 1))], 1)
    rooms = weights["fantasy_rooms"]
    drawn, sizes = np.unique(np.where(rooms < 0, spec.C, rooms), return_counts=True)
    # Both sums of the iteration as products: p(n | room) up to a factor of each sample. None is 0,
    # so that no sum is.
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
