"""Log-odds of classes and room types in closed form.

The hidden units m contribute log E[exp(w·h1)] to the log-odds of a class (row w of W) or of a room
type (row w of Q). x are the logits of h1, see `weights`:

    hidden(w) = sum_m log sum_z p_m(z) exp(w[m, z]),   p_m = softmax over the states of unit m

The first state of a unit has the weight 0. The log-odds of class i given the other classes are

    b_i + Y_ti + sum_q p_q a_qi + sum_j presence_j L_ij + hidden(W_i),   p = softmax(f + a v)

at the logits x without class i, with the presence v of the other classes. p_q is the probability of
the data source q. If a request names its profile q, p_q is 1. An unknown room type t has Y_t = 0.
The probability of a room type t given the listed classes is

    p(t | v) = sum_q p_q softmax_t(e + y_q + Y v + hidden(Q))

Both factors of a product p_m(z) exp(w) are positive, so their sum loses no digits. A compiled loop
multiplies the sums of several units and takes one log of the product. The group is small enough to
keep the product within float32.
"""

from __future__ import annotations

from bisect import bisect
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled, compiled_in_any_order
from app.inference.elementary import (
    LN2,
    exp,
    exponent,
    log,
    log_softmax,
    mantissa,
    sigmoid,
    softmax,
)
from app.inference.relation_units import EncodedScene
from app.inference.weights import LISTED_SHARES, Weights, all_states

LARGEST_WEIGHT: Final = 40.0
"""Maximum |weight| between h1 and a class or room type that float32 products allow."""

# Maximum |log| of a product of sums; float32 covers exp(±87).
_LOG_RANGE: Final = 80.0
# Maximum number of sums per log. With more, the products take most of the time.
_LARGEST_GROUP: Final = 25
# Maximum number of classes per tile. A tile is a block of classes whose exp(W) fits into the
# second-level cache.
_TILE: Final = 800
# The width of a tile is a multiple of this number, so that it fills whole vector registers.
_LANES: Final = 16
_SMALLEST: Final = 1e-300  # least probability of a room type
# Maximum number of biases that a scorer keeps, of 4 bytes for each class.
_KEPT_BIASES: Final = 64
# Listed share in the middle of each bin of kappa. The last bin lists all classes but one.
_MIDDLES: Final = (0.15, 0.45, 0.8, 1.0)


class HiddenLogOdds:
    """The contributions hidden(w) of the hidden units to log-odds, for constant rows of weights w.

    The object computes each row of a result separately with the same operations. So the bits of a
    row do not depend on the other rows.

    Raises:
        ValueError: a weight is NaN, or its absolute value is above `LARGEST_WEIGHT`.
    """

    def __init__(self, weights: Float[NDArray, "rows H1"], states: int) -> None:
        largest = float(np.abs(weights).max(initial=0))
        if not largest <= LARGEST_WEIGHT:
            raise ValueError(f"weights must be between -{LARGEST_WEIGHT} and {LARGEST_WEIGHT}")
        self._rows, self._states = len(weights), states
        self._group = min(_LARGEST_GROUP, max(1, int(_LOG_RANGE / max(largest, 1.0))))
        # -(-a // b) rounds a / b up. Tiles have equal widths of whole vector registers.
        tiles = max(1, -(-self._rows // _TILE))
        width = -(-self._rows // (tiles * _LANES)) * _LANES
        # The padding of the last tile is 1, which leaves the products near 1.
        factors = np.ones((tiles * width, weights.shape[1]), np.float32)
        np.exp(weights, out=factors[: self._rows])
        by_state = factors.reshape(tiles, width, weights.shape[1] // (states - 1), states - 1)
        self._factors = np.ascontiguousarray(by_state.transpose(0, 2, 3, 1))

    def __call__(self, x: Float[NDArray, "B H1"]) -> Float[NDArray, "B rows"]:
        """Return the contribution for each row of weights at the logits x of h1."""
        p = all_states(x, self._states)
        return _hidden_log_odds(p, self._factors, self._group, self._rows)


class ObjectScorer:
    """The log-odds of classes and room types of a machine with constant weights.

    Raises:
        ValueError: a weight is NaN or too large; see `HiddenLogOdds`.
    """

    def __init__(self, weights: Weights) -> None:
        self._weights, self._states = weights, weights.spec.states
        # By coverage and room type.
        self._biases: dict[tuple[float, int | None], Float[NDArray, " V"]] = {}
        self._increases: dict[int, tuple[Float[NDArray, " V"], Float[NDArray, " V"]]] = {}
        self.hidden = HiddenLogOdds(weights["W"], self._states)
        self.hidden_of_rooms = HiddenLogOdds(weights["Q"], self._states)

    def absent(
        self,
        x: Float[NDArray, " H1"],
        classes: Int[NDArray, " n"],
        presence: Float[NDArray, " n"],
        profile: int | None,
        coverage: float,
        room: int | None = None,
    ) -> Float[NDArray, " V"]:
        """Return the log-odds of each class given the listed classes and the logits x of h1.

        Entries of listed classes have no meaning. `coverage` is the listed share of the scene; 1
        means all classes but one. The base rates of the data source `profile` apply, if any.
        """
        weights, log_odds = self._weights, self.hidden(x[None])[0]
        bias = self._biases.get((coverage, room))
        if bias is None:
            bias = weights["b"] + weights.room_couplings(room) + self.kappa(coverage)
            if len(self._biases) < _KEPT_BIASES:
                self._biases[coverage, room] = bias
        log_odds += bias
        if weights.spec.profiles:
            p = weights.source_weights(classes, presence[None], profile)[0]
            log_odds += p.astype(np.float32) @ weights["a"]
        if weights.spec.coupled:
            log_odds += presence @ weights["L"][classes]
        return log_odds

    def kappa(self, coverage: float) -> Float[NDArray, " V"]:
        """Return the bias of each class for a listed share, interpolated between the bins."""
        kappa = self._weights["kappa"]
        low = bisect(_MIDDLES, coverage, 1, len(LISTED_SHARES)) - 1
        # Beyond the first and the last middle, the value is that of the nearest bin.
        share = (coverage - _MIDDLES[low]) / (_MIDDLES[low + 1] - _MIDDLES[low])
        weight = np.float32(min(max(share, 0.0), 1.0))
        return (1 - weight) * kappa[low] + weight * kappa[low + 1]

    def given_rest(
        self,
        scene: EncodedScene,
        profile: int | None,
        room: int | None = None,
        *,
        explained: bool = False,
    ) -> tuple[Float[NDArray, " n"], Float[NDArray, "n n|0"]]:
        """Return the log-odds of each listed class i given the other listed classes.

        If `explained`, the second result is how much each listed class j changes them: the log-odds
        of i with class j, minus the log-odds of i without class j. An entry with i = j is 0.
        """
        weights, rows = self._weights, np.arange(len(scene.classes))
        bias = weights["b"] + weights.room_couplings(room) + weights["kappa"][-1]
        return self._explained(bias, scene, profile, rows, scene.classes, explained=explained)

    def given_others(
        self,
        classes: Int[NDArray, " n"],
        presence: Float[NDArray, "B n"],
        row: Int[NDArray, " T"],
        targets: Int[NDArray, " T"],
        profile: int | None,
        room: int | None = None,
    ) -> Float[NDArray, " T"]:
        """Return the log-odds of T target classes in B scenes with some of n distinct classes.

        Target t is in the scene `row[t]`. The presence of the target class itself does not count.
        """
        weights, W = self._weights, self._weights["W"]
        v = np.where(classes == targets[:, None], np.float32(0), presence[row])  # (T, n)
        p = all_states(weights.room_bias(room) + v @ W[classes], self._states)
        shape = len(targets), p.shape[1], self._states - 1
        raised = np.exp(W[targets]).reshape(shape)
        log_odds = _hidden_changes(p, raised, raised[:0])[0]
        bias = weights["b"] + weights.room_couplings(room) + weights["kappa"][-1]
        log_odds += bias[targets]
        if weights.spec.profiles:
            of_source = weights.source_weights(classes, v, profile)
            log_odds += (of_source * weights["a"][:, targets].T).sum(1).astype(np.float32)
        if weights.spec.coupled:
            log_odds += (v * weights["L"][targets[:, None], classes]).sum(1)
        return log_odds

    def reasons_for_absent(
        self, scene: EncodedScene, profile: int | None, candidates: Int[NDArray, " N"]
    ) -> Float[NDArray, "N n"]:
        """Return the change of the log-odds of unlisted candidates by each listed class."""
        bias, rows = self._weights["b"], candidates[:0]
        return self._explained(bias, scene, profile, rows, candidates, explained=True)[1]

    def _explained(
        self,
        bias: Float[NDArray, " V"],
        scene: EncodedScene,
        profile: int | None,
        rows: Int[NDArray, " N|0"],
        targets: Int[NDArray, " N"],
        *,
        explained: bool,
    ) -> tuple[Float[NDArray, " N"], Float[NDArray, "N n|0"]]:
        """Return the log-odds of N target classes given the listed classes, and their changes.

        The change by class j is the log-odds minus their value without class j. `rows` are the
        indices of listed targets among the listed classes: a class is not evidence for itself.
        """
        weights, coupled = self._weights, self._weights.spec.coupled
        possible = slice(None) if profile is None else slice(profile, profile + 1)
        return _explained_log_odds(
            bias,
            weights["W"],
            weights["L"] if coupled else weights["W"][:0],
            weights["f"][possible],
            weights["a"][possible],
            scene.x,
            scene.contributions,
            scene.classes,
            scene.presence,
            rows,
            targets,
            self._states,
            explained,
        )

    def increases(self, i: int) -> tuple[Float[NDArray, " V"], Float[NDArray, " V"]]:
        """Return how much the presence of class i increases the log-odds of each class j.

        In a scene without other objects, it raises them by

            increase_ij = hidden(W_j) at x = c1 + W_i - hidden(W_j) at x = c1 + L_ij

        The increase is symmetric in i and j. It leaves out room type and data source. The second
        result is the increase times the probability of each class in this scene. The scorer keeps
        both results of each class, at most 8 V² bytes.
        """
        kept = self._increases.get(i)
        if kept is None:
            weights = self._weights
            alone, empty = self.hidden(np.stack([weights["c1"] + weights["W"][i], weights["c1"]]))
            if weights.spec.coupled:
                alone += weights["L"][i]
            increase = alone - empty
            kept = self._increases[i] = increase, increase * sigmoid(weights["b"] + alone)
        return kept

    def room_evidence(
        self,
        x: Float[NDArray, "N H1"],
        classes: Int[NDArray, " n"],
        presence: Float[NDArray, "N n"],
    ) -> Float[NDArray, "N C"]:
        """Return log p(v | t) of the listed classes v of N scenes, up to a constant of each t."""
        # The sum has float64 digits, so that listed structure, whose terms are 0, changes none.
        evidence = self.hidden_of_rooms(x).astype(np.float64)
        if self._weights.spec.coupled:
            Y = self._weights["Y"][:, classes].astype(np.float64)
            evidence += presence.astype(np.float64) @ Y.T
        return evidence

    def room_log_p(
        self,
        x: Float[NDArray, "N H1"],
        classes: Int[NDArray, " n"],
        presence: Float[NDArray, "N n"],
        profile: int | None,
    ) -> Float[NDArray, "N C"]:
        """Return log p(t | listed classes) of each room type t, for a data source or for all."""
        weights = self._weights
        logits = weights["e"] + self.room_evidence(x, classes, presence)
        if not weights.spec.profiles:
            return log_softmax(logits)
        by_source = softmax(logits[:, None] + weights["y"])
        p = weights.source_weights(classes, presence, profile)[:, None] @ by_source
        return np.log(np.maximum(p[:, 0], _SMALLEST))


@compiled
def _hidden_log_odds(
    p: Float[NDArray, "B units states"],
    factors: Float[NDArray, "tiles units states-1 width"],
    group: int,
    rows: int,
) -> Float[NDArray, "B rows"]:
    """Return hidden(w), defined in the module, for each row w of weights at B probabilities p.

    After each `group` of sums, the function splits the product into mantissa and exponent, and adds
    the exponent to an integer. So one log at the end is enough. `factors` are exponentials of the
    weights, in tiles of `width` rows. t is a tile, i is a row in it, and z is a state of unit m.
    """
    tiles, units, others, width = factors.shape
    log_odds = np.empty((len(p), rows), np.float32)
    product, exponents = np.empty(width, np.float32), np.empty(width, np.int32)
    total = np.empty(width, np.float32)
    for t in range(tiles):
        for b in range(len(p)):
            product[:], exponents[:] = np.float32(1.0), np.int32(0)
            for m in range(units):
                total[:] = p[b, m, 0]
                for z in range(0, others - 1, 2):
                    # The loop takes two states at a time. This halves the reads and writes.
                    p1, row1 = p[b, m, z + 1], factors[t, m, z]
                    p2, row2 = p[b, m, z + 2], factors[t, m, z + 1]
                    for i in range(width):
                        total[i] += p1 * row1[i] + p2 * row2[i]
                if others % 2:
                    p1, row1 = p[b, m, others], factors[t, m, others - 1]
                    for i in range(width):
                        total[i] += p1 * row1[i]
                for i in range(width):
                    product[i] *= total[i]
                if (m + 1) % group == 0 or m + 1 == units:
                    for i in range(width):
                        exponents[i] += exponent(product[i])
                        product[i] = mantissa(product[i])
            row = log_odds[b, t * width :]
            for i in range(min(width, rows - t * width)):
                row[i] = log(product[i]) + LN2 * np.float32(exponents[i])
    return log_odds


@compiled_in_any_order
def _hidden_changes(
    p: Float[NDArray, "N|1 units states"],
    raised: Float[NDArray, "N units states-1"],
    removed: Float[NDArray, "n units states-1"],
) -> tuple[Float[NDArray, " N"], Float[NDArray, "N n"]]:
    """Return hidden(W_c) of N classes c, and its changes by n listed classes j.

    p is one row for all classes, or one for each. `raised` is exp(W_c). `removed` is
    exp(-contribution) of each listed class: this factor removes class j from the probabilities p.
    """
    (N, units, others), n = raised.shape, len(removed)
    total, change = np.zeros(N, np.float32), np.zeros((N, n), np.float32)
    hidden, ratio = np.empty(units, np.float32), np.empty(units, np.float32)
    for c in range(N):
        states = p[min(c, len(p) - 1)]
        for m in range(units):
            hidden[m] = states[m, 0]
            for z in range(others):
                hidden[m] += states[m, z + 1] * raised[c, m, z]
        for m in range(units):
            total[c] += log(hidden[m])
        for j in range(n):
            for m in range(units):
                # Without class j, the sum of the unit is after / before.
                row, factors, without = states[m], raised[c, m], removed[j, m]
                before, after = row[0], row[0]
                for z in range(others):
                    product = row[z + 1] * without[z]
                    before += product
                    after += product * factors[z]
                ratio[m] = before * hidden[m] / after
            for m in range(units):
                change[c, j] += log(ratio[m])
    return total, change


@compiled
def _explained_log_odds(
    bias: Float[NDArray, " V"],
    W: Float[NDArray, "V H1"],
    L: Float[NDArray, "V|0 V|H1"],  # empty without couplings
    f: Float[NDArray, " Q"],  # of the possible data sources
    a: Float[NDArray, "Q V"],
    x: Float[NDArray, " H1"],
    contributions: Float[NDArray, "listed H1"],
    classes: Int[NDArray, " listed"],
    presence: Float[NDArray, " listed"],
    rows: Int[NDArray, " N|0"],
    targets: Int[NDArray, " N"],
    states: int,
    explained: bool,
) -> tuple[Float[NDArray, " N"], Float[NDArray, "N n"]]:
    """Return the log-odds of N target classes i, and their changes by each listed class j.

    `rows` are the indices of listed targets among the listed classes, empty for unlisted targets.
    The logits x of a listed target leave out its own contribution.
    """
    N, n, H1, others = len(targets), len(classes) if explained else 0, len(x), states - 1
    without = np.empty((max(len(rows), 1), H1), np.float32)
    raised, removed = np.empty((N, H1), np.float32), np.empty((n, H1), np.float32)
    for i in range(len(without)):
        for k in range(H1):
            without[i, k] = x[k] - contributions[rows[i], k] if len(rows) else x[k]
    for i in range(N):
        for k in range(H1):
            raised[i, k] = exp(W[targets[i], k])
    for j in range(n):
        for k in range(H1):
            removed[j, k] = exp(-contributions[j, k])
    by_unit = H1 // others, others
    log_odds, change = _hidden_changes(
        all_states(without, states), raised.reshape(N, *by_unit), removed.reshape(n, *by_unit)
    )
    mean, of_source = _source_effects(f, a, classes, presence, rows, targets, n)
    for i in range(N):
        coupled = np.float32(0.0)
        for j in range(len(classes) if len(L) else 0):
            coupling = L[targets[i], classes[j]] * presence[j]
            coupled += coupling
            if j < n:
                change[i, j] += coupling
        log_odds[i] += bias[targets[i]] + mean[i] + coupled
        for j in range(n):
            change[i, j] += of_source[i, j]
        if n and len(rows):
            change[i, rows[i]] = np.float32(0.0)
    return log_odds, change


@compiled
def _source_effects(
    f: Float[NDArray, " Q"],
    a: Float[NDArray, "Q V"],
    classes: Int[NDArray, " listed"],
    presence: Float[NDArray, " listed"],
    rows: Int[NDArray, " N|0"],
    targets: Int[NDArray, " N"],
    n: int,
) -> tuple[Float[NDArray, " N"], Float[NDArray, "N n"]]:
    """Return the effect of the unknown data source on N target classes, and its changes.

    The effect on a class i is the mean base rate sum_q p_q a_qi over the Q data sources. p_q is the
    probability of source q given the listed classes. The changes are those by the first n classes.
    `rows` are the indices of listed targets among the listed classes; no class affects itself.
    """
    Q = len(f)
    # Part of each listed class in the logit of each source, and e^-part.
    parts, without = np.empty((len(classes), Q), np.float32), np.empty((n, Q), np.float32)
    logits, p = f.copy(), np.empty(Q, np.float32)
    for j in range(len(classes)):
        for q in range(Q):
            parts[j, q] = a[q, classes[j]] * presence[j]
            logits[q] += parts[j, q]
    for j in range(n):
        for q in range(Q):
            without[j, q] = exp(-parts[j, q])
    mean, change = np.zeros(len(targets), np.float32), np.zeros((len(targets), n), np.float32)
    for i in range(len(targets) if Q else 0):
        top, total, weighted = np.float32(-np.inf), np.float32(0.0), np.float32(0.0)
        for q in range(Q):
            p[q] = logits[q] - parts[rows[i], q] if len(rows) else logits[q]
            top = max(top, p[q])
        for q in range(Q):
            p[q] = exp(p[q] - top)
            total += p[q]
            weighted += p[q] * a[q, targets[i]]
        mean[i] = weighted / total
        for j in range(n):
            total, weighted = np.float32(0.0), np.float32(0.0)
            for q in range(Q):
                weight = p[q] * without[j, q]
                total += weight
                weighted += weight * a[q, targets[i]]
            change[i, j] = mean[i] - weighted / total
    return mean, change
