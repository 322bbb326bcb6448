"""Log-odds of classes and room types in closed form.

The gain of a row w of weights is the contribution of the hidden units m to the log-odds of a class
(row of W) or of a room type (row of Q). x are the logits of h1, see `weights`:

    gain = sum_m log sum_z p_m(z) exp(w[m, z]),   p_m = softmax over the states of unit m

The first state of a unit has the weight 0. The log-odds of class i given the other classes are

    b_i + sum_q p_q a_qi + sum_j presence_j L_ij + gain_i,   p = softmax(f + a v)

at the logits x without class i, with the presence v of the other classes. p_q is the probability of
the data source q. If a request names its profile q, p_q is 1.

Both factors of a product p_m(z) exp(w) are positive, so their sum loses no digits. A kernel
multiplies the sums of several units and takes one log of the product. The group is small enough to
keep the product within float32.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import exponent, log, mantissa, softmax
from app.inference.weights import SHARES, Weights

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

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
_LN2 = np.float32(0.6931471805599453)
_ONE = np.float32(1.0)
# Listed share in the middle of each bin of kappa. The last bin lists all classes but one.
_MIDDLES: Final = (0.15, 0.45, 0.8, 1.0)


class Gains:
    """Compute the gains of fixed rows of weights, such as W.

    The object computes each row of a result separately with the same operations. So the bits of a
    row do not depend on the other rows.

    Args:
        weights: (rows, H1) weights between h1 and each class or room type.
        states: number of states of a hidden unit.

    Raises:
        ValueError: a weight is NaN, or its absolute value is above `LARGEST_WEIGHT`.
    """

    def __init__(self, weights: Floats, states: int) -> None:
        largest = float(np.abs(weights).max(initial=0))
        if not largest <= LARGEST_WEIGHT:
            raise ValueError(f"weights must be between -{LARGEST_WEIGHT} and {LARGEST_WEIGHT}")
        self._rows, self._states = len(weights), states
        self._group = min(_LARGEST_GROUP, max(1, int(_LOG_RANGE / max(largest, 1.0))))
        tiles = max(1, -(-self._rows // _TILE))
        width = -(-self._rows // (tiles * _LANES)) * _LANES
        # The padding of the last tile is 1, which leaves the products near 1.
        factors = np.ones((tiles * width, weights.shape[1]), np.float32)
        np.exp(weights, out=factors[: self._rows])
        by_state = factors.reshape(tiles, width, weights.shape[1] // (states - 1), states - 1)
        self._factors = np.ascontiguousarray(by_state.transpose(0, 2, 3, 1))

    def __call__(self, x: Floats) -> Floats:
        """Return the gain of each row of weights, (B, rows), at the logits x of h1, (B, H1)."""
        first, others = all_states(x, self._states)
        gain: Floats = _gains(first, others, self._factors, self._group, self._rows)
        return gain


def all_states(x: NDArray[Any], states: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the probabilities of all states of the hidden units with the logits x, (..., H1).

    Returns:
        The probability of the first state of each unit, (..., units), and those of its other
        states, (..., units, states - 1).
    """
    logits = x.reshape(*x.shape[:-1], -1, states - 1)
    top = np.maximum(logits.max(-1), 0)
    others = np.exp(logits - top[..., None])
    first = np.exp(-top)
    total = first + others.sum(-1)
    return first / total, others / total[..., None]


@compiled
def _gains(first, others, factors, group, rows):
    """Return the gain of each row of weights, (B, rows); see `Gains`.

    After each group of sums, the function splits the product into mantissa and exponent, and adds
    the exponent to an integer. So one log at the end is enough.

    Args:
        first: (B, units) probability of the first state of each unit.
        others: (B, units, states - 1) probabilities of the other states.
        factors: (tiles, units, states - 1, rows per tile) exponentials of the weights.
        group: maximum number of sums in a product.
        rows: number of rows of weights.
    """
    tiles, units, states, width = factors.shape
    gain = np.empty((len(first), rows), np.float32)
    product, exponents = np.empty(width, np.float32), np.empty(width, np.int32)
    total = np.empty(width, np.float32)
    for t in range(tiles):
        for b in range(len(first)):
            product[:], exponents[:] = _ONE, np.int32(0)
            for m in range(units):
                total[:] = first[b, m]
                for z in range(0, states - 1, 2):
                    # The loop takes two states at a time. This halves the reads and writes.
                    p1, row1 = others[b, m, z], factors[t, m, z]
                    p2, row2 = others[b, m, z + 1], factors[t, m, z + 1]
                    for i in range(width):
                        total[i] += p1 * row1[i] + p2 * row2[i]
                if states % 2:
                    p1, row1 = others[b, m, states - 1], factors[t, m, states - 1]
                    for i in range(width):
                        total[i] += p1 * row1[i]
                for i in range(width):
                    product[i] *= total[i]
                if (m + 1) % group == 0 or m + 1 == units:
                    for i in range(width):
                        exponents[i] += exponent(product[i])
                        product[i] = mantissa(product[i])
            gain_b = gain[b, t * width :]
            for i in range(min(width, rows - t * width)):
                gain_b[i] = log(product[i]) + _LN2 * np.float32(exponents[i])
    return gain


class ObjectScorer:
    """The log-odds of classes and room types of a machine with constant weights.

    Attributes:
        gains, room_gains: gains of the classes, and of the room types.

    Raises:
        ValueError: a weight is NaN or too large; see `Gains`.
    """

    def __init__(self, weights: Weights) -> None:
        self._weights, self._states = weights, weights.spec.states
        self.gains = Gains(weights["W"], self._states)
        self.room_gains = Gains(weights["Q"], self._states)

    def absent(
        self, x: Floats, classes: Indices, presence: Floats, profile: int | None, coverage: float
    ) -> Floats:
        """Return the log-odds of each class given the listed classes, (V,).

        Entries of listed classes have no meaning.

        Args:
            x: (H1,) logits of h1 given the listed classes.
            classes, presence: (n,) indices of the listed classes, and the probabilities that they
                are present.
            profile: index of a data source, whose base rates apply, or None.
            coverage: listed share of the scene. 1 means that all classes but one are listed.
        """
        bias = self._weights.class_bias(classes, presence, profile)
        log_odds: Floats = bias + self.gains(x[None])[0] + self.kappa(coverage)
        if self._weights.spec.coupled:
            log_odds += _row_sum(self._weights["L"][classes], presence)
        return log_odds

    def kappa(self, coverage: float) -> Floats:
        """Return the bias of each class for a listed share, interpolated between the bins, (V,)."""
        kappa = self._weights["kappa"]
        position = float(np.interp(coverage, _MIDDLES, range(len(_MIDDLES))))
        low = min(int(position), len(SHARES) - 1)
        weight = np.float32(position - low)
        mixed: Floats = (1 - weight) * kappa[low] + weight * kappa[low + 1]
        return mixed

    def given_rest(
        self, x: Floats, shares: Floats, classes: Indices, presence: Floats, profile: int | None
    ) -> Floats:
        """Return the log-odds of each listed class given the other listed classes, (n,).

        Args:
            x: (H1,) logits of h1 given all listed classes.
            shares: (n, H1) contribution of each class to x.
            classes, presence, profile: see `absent`.
        """
        weights = self._weights
        log_odds = weights["b"][classes] + weights["kappa"][-1, classes]
        log_odds += self._gains_of_rows(x - shares, weights["W"][classes])
        a = weights["a"][:, classes].T
        if profile is None:
            logits = weights.source_logits(classes, presence) - a * presence[:, None]
            log_odds += (softmax(logits) * a).sum(1)
        else:
            log_odds += a[:, profile]
        if self._weights.spec.coupled:
            log_odds += _row_sum(self._weights["L"][np.ix_(classes, classes)], presence)
        return log_odds

    def reasons(
        self,
        x: Floats,
        shares: Floats,
        classes: Indices,
        presence: Floats,
        profile: int | None,
        rows: Indices,
    ) -> Floats:
        """Return how much each class j changes the log-odds of each listed class i, (N, n).

        Each row is one of the N classes i of ``rows``. Each column is one of the n listed classes
        j. An entry is the log-odds of i with class j, minus the log-odds of i without class j. An
        entry with i = j is 0.
        """
        change = self._changes(x - shares[rows], shares, self._weights["W"][classes[rows]])
        if self._weights.spec.coupled:
            change += self._weights["L"][np.ix_(classes[rows], classes)] * presence
        if profile is None:
            change += self._changes_by_source(classes, presence, rows, classes[rows])
        change[np.arange(len(rows)), rows] = 0
        return change

    def reasons_for_absent(
        self,
        x: Floats,
        shares: Floats,
        classes: Indices,
        presence: Floats,
        profile: int | None,
        candidates: Indices,
    ) -> Floats:
        """Return how much each listed class changes the log-odds of N unlisted classes, (N, n)."""
        logits = np.broadcast_to(x, (len(candidates), len(x)))
        change = self._changes(logits, shares, self._weights["W"][candidates])
        if self._weights.spec.coupled:
            change += self._weights["L"][np.ix_(candidates, classes)] * presence
        if profile is None:
            change += self._changes_by_source(classes, presence, None, candidates)
        return change

    def _changes_by_source(
        self, classes: Indices, presence: Floats, rows: Indices | None, targets: Indices
    ) -> Floats:
        """Return how much each listed class changes sum_q p_q a_qi of N classes i, (N, n).

        Args:
            rows: (N,) position of each class i among the listed classes, which is not evidence for
                itself; None if the classes i are not listed.
            targets: (N,) the classes i.
        """
        a = self._weights["a"]
        logits = self._weights.source_logits(classes, presence)[None]
        shares = a[:, classes].T * presence[:, None]
        if rows is not None:
            logits = logits - shares[rows]
        # p with class j minus p without class j, (N or 1, n, sources).
        change = softmax(logits)[:, None] - softmax(logits[:, None] - shares)
        effect: Floats = (change * a[:, targets].T[:, None]).sum(2)
        return effect

    def room_logits(self, x: Floats) -> Floats:
        """Return log p(t | listed classes) of each room type t, plus a constant, (C,)."""
        logits: Floats = self._weights["e"] + self.room_gains(x[None])[0]
        return logits

    def _gains_of_rows(self, x: Floats, weights: Floats) -> Floats:
        """Return the gain of each row of weights, (N, H1), at its row of logits x, (N, H1)."""
        first, others = all_states(x, self._states)
        factors = np.exp(weights).reshape(others.shape)
        gain: Floats = np.log(first + (others * factors).sum(-1)).sum(-1)
        return gain

    def _changes(self, x: Floats, shares: Floats, weights: Floats) -> Floats:
        """Return gain_c(x_c) - gain_c(x_c - share_j) for N rows c and n shares j, (N, n).

        Args:
            x: (N, H1) logits of h1.
            shares: (n, H1) contribution of each listed class to the logits.
            weights: (N, H1) weights of the class of each row.
        """
        # float64 covers the products of the exponentials.
        first, others = all_states(x.astype(np.float64), self._states)
        by_unit = (*others.shape[1:],)
        removed = np.exp(-shares.astype(np.float64)).reshape(-1, *by_unit).transpose(1, 2, 0)
        raised = others * np.exp(weights.astype(np.float64)).reshape(others.shape)
        with_class = np.log(first + raised.sum(-1)).sum(-1)
        # (units, N, states) by (units, states, n): the products sum over the states of each unit.
        start = first.T[:, :, None]
        total = start + others.transpose(1, 0, 2) @ removed
        weighted = start + raised.transpose(1, 0, 2) @ removed
        change: Floats = (with_class[:, None] - np.log(weighted / total).sum(0)).astype(np.float32)
        return change


def _row_sum(rows: Floats, presence: Floats) -> Floats:
    """Return presence @ rows. Rows of zeros, such as those of structure, do not change a digit."""
    total: Floats = (presence[:, None] * rows).sum(0)
    return total
