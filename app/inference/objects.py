"""Fast log-odds of classes.

The gain of class i is the contribution of the hidden units k to the log-odds of the class. x are
the logits of the hidden units, and W are the weights between classes and hidden units:

    gain_i = sum_k [softplus(x_k + W_ik) - softplus(x_k)]
           = sum_k log(sigmoid(-x_k) + sigmoid(x_k) exp(W_ik))

The module computes exp(W) once. A factor is the argument of a log in the second line. Each factor
lies between 1 and exp(W_ik). The module multiplies a group of factors and takes one log of the
product. The group is small enough to keep the product within float32. Both terms of a factor are
positive, so their sum loses no digits. The equivalent form 1 + sigmoid(x) (exp(W) - 1) would be 0
for large x and W below -17. If the weights are float64 or too large for float32, the module
computes the first line directly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference.elementary import exp, exponent, log, mantissa, softplus

Floats = NDArray[np.floating[Any]]
Singles = NDArray[np.float32]
Indices = NDArray[np.int64]

# Maximum |log| of a product of factors; float32 covers exp(±87).
_LOG_RANGE = 80.0
# Maximum |W| for products of factors. With a larger W, sigmoid(x) can underflow to 0 although
# sigmoid(x) exp(W) is still large.
_LARGEST_WEIGHT = 64.0
# Maximum number of factors per log. With more factors, the products take most of the time.
_LARGEST_GROUP = 25
# Maximum number of classes per tile. A tile is a block of classes whose exp(W) fits into the
# second-level cache.
_TILE = 800
# The width of a tile is a multiple of this number, so that it fills whole vector registers.
_LANES = 16
# Number of products that `_gain` computes in parallel. Each product takes every 32nd factor.
_SIDE_BY_SIDE = 32
_LN2 = np.float32(0.6931471805599453)
_ONE = np.float32(1.0)
# Maximum |logit| for which float32 can represent the odds, p and 1 - p as normal numbers.
_MOST_LOGIT = np.float32(80.0)


def group_size(W: Floats) -> int:
    """Return the maximum number of factors in one float32 product; see the module.

    The result is 0 if W is float64 or too large for products in float32.
    """
    largest = float(np.abs(W).max()) if W.size else 0.0
    if W.dtype == np.float64 or largest > _LARGEST_WEIGHT:
        return 0
    return min(_LARGEST_GROUP, max(1, int(_LOG_RANGE / max(largest, 1.0))))


class ContextScorer:
    """Compute the gains of all classes for a machine with constant weights.

    The scorer computes each row of the result separately with the same operations. So the bits of
    a row do not depend on the other rows.

    Args:
        W: (V, H1) weights between classes and hidden units.

    Attributes:
        group: maximum number of factors per product; see `group_size`.
        exp_w: (tiles, H1, classes per tile) exp(W), split into tiles of classes. The attribute
            exists only if ``group`` is not 0.

    Raises:
        ValueError: W contains NaN or infinity.
    """

    exp_w: Singles

    def __init__(self, W: Floats) -> None:
        if not np.isfinite(W).all():
            raise ValueError("W contains NaN or infinity; all weights must be finite")
        self.V, self.H1 = W.shape
        self._W, self.group = W, group_size(W)
        if self.group:
            tiles = -(-self.V // _TILE)
            width = -(-self.V // (tiles * _LANES)) * _LANES
            # The padding of the last tile is 1, which leaves the products unchanged.
            exp_w = np.ones((tiles * width, self.H1), dtype=np.float32)
            np.exp(W, out=exp_w[: self.V])
            tiled = exp_w.reshape(tiles, width, self.H1).swapaxes(1, 2)
            self.exp_w = np.ascontiguousarray(tiled)

    def gain(self, x: Floats) -> Floats:
        """Return the gain of each class, sum_k [softplus(x_k + W_ik) - softplus(x_k)], (..., V).

        The result has the precision of W.

        Args:
            x: (..., H1) logits of the hidden units.

        Raises:
            ValueError: the shape of x is not (..., H1).
        """
        if x.shape[-1:] != (self.H1,):
            raise ValueError(f"x must have the shape (..., {self.H1}), not {x.shape}")
        rows = x.reshape(-1, self.H1)
        if self.group:
            gain: Floats = gains(rows.astype(np.float32), self.exp_w, self.group, self.V)
        else:
            logits = rows.astype(np.float64)[:, None]
            terms = softplus(logits + self._W) - softplus(logits)
            gain = terms.sum(2).astype(self._W.dtype)
        return gain.reshape(*x.shape[:-1], self.V)


@inlined
def _set_halves(x, off, on):
    """Set off = sigmoid(-x) and on = sigmoid(x).

    The function computes both from one exponential. The difference 1 - sigmoid(x) would lose
    digits.
    """
    for k in range(len(x)):
        fall = exp(min(-x[k], _MOST_LOGIT))
        on[k] = _ONE / (_ONE + fall)
        off[k] = fall * on[k]


@compiled
def gains(x, exp_w, group, classes):
    """Return the gains of all V classes for M rows of logits, (M, V).

    After each group of factors, the function splits the product into mantissa and exponent, and
    adds the exponent to an integer. So one log at the end is enough.

    x (M, H1) are the logits of the hidden units; for ``exp_w`` and ``group``, see `ContextScorer`.
    """
    (tiles, units, width), M = exp_w.shape, len(x)
    gain, off, on = np.empty((M, classes), np.float32), np.empty_like(x), np.empty_like(x)
    for m in range(M):
        _set_halves(x[m], off[m], on[m])
    product, exponents = np.empty(width, np.float32), np.empty(width, np.int32)
    for t in range(tiles):
        tile = exp_w[t]
        for m in range(M):
            off_m, on_m, gain_m = off[m], on[m], gain[m, t * width :]
            product[:], exponents[:] = _ONE, np.int32(0)
            for start in range(0, units, group):
                end = min(start + group, units)
                # The loop takes two factors at a time. This halves the reads and writes of the
                # product.
                for k in range(start, end - 1, 2):
                    a1, b1, row1 = off_m[k], on_m[k], tile[k]
                    a2, b2, row2 = off_m[k + 1], on_m[k + 1], tile[k + 1]
                    for i in range(width):
                        product[i] *= (a1 + b1 * row1[i]) * (a2 + b2 * row2[i])
                if (end - start) % 2:
                    a1, b1, row1 = off_m[end - 1], on_m[end - 1], tile[end - 1]
                    for i in range(width):
                        product[i] *= a1 + b1 * row1[i]
                for i in range(width):
                    exponents[i] += exponent(product[i])
                    product[i] = mantissa(product[i])
            for i in range(min(width, classes - t * width)):
                gain_m[i] = log(product[i]) + _LN2 * np.float32(exponents[i])
    return gain


@compiled
def _gain(off, on, growth, group, product):
    """Return the gain of one class: sum_k log((off_k + on_k growth_k) / (off_k + on_k)).

    Args:
        off, on: (H1,) sigmoid(-x) and sigmoid(x) of the logits x of the hidden units. Only the
            ratio on / off matters, so both may have a common factor.
        growth: (H1,) e^W of the class.
        group: maximum number of factors per product; see `ContextScorer`.
        product: (32,) buffer for intermediate products.
    """
    size, total = len(off), np.float32(0.0)
    for first in range(0, size, group * _SIDE_BY_SIDE):
        product[:] = _ONE
        last = min(first + group * _SIDE_BY_SIDE, size)
        for start in range(first, last, _SIDE_BY_SIDE):
            # The loop runs over slices, because the compiler vectorises loops that begin at 0.
            end = min(start + _SIDE_BY_SIDE, last)
            a, b, c = off[start:end], on[start:end], growth[start:end]
            for lane in range(len(a)):
                product[lane] *= (a[lane] + b[lane] * c[lane]) / (a[lane] + b[lane])
        for lane in range(_SIDE_BY_SIDE):
            product[lane] = log(product[lane])
        for lane in range(_SIDE_BY_SIDE):
            total += product[lane]
    return total


@compiled
def gains_without(y, share, W, group):
    """Return the gain of each class i at the logits y without the share of class i, (n,).

    Args:
        y: (H1,) logits of the hidden units.
        share: (n, H1) contribution of each class and its relations to y.
        W: (n, H1) weights between each class and the hidden units.
        group: maximum number of factors per product; see `ContextScorer`.
    """
    gain, growth = np.empty(len(W), np.float32), _exps(W)
    off, on, product = np.empty_like(y), np.empty_like(y), np.empty(_SIDE_BY_SIDE, np.float32)
    for i in range(len(W)):
        _set_halves(y - share[i], off, on)
        gain[i] = _gain(off, on, growth[i], group, product)
    return gain


@compiled
def gains_without_others(y, share, W, rows, common, index, group):
    """Return the gain of class i at the logits y without the shares of classes i and j, (N, n).

    Rows are classes i of ``rows``, columns are classes j. Entries with j = i have no meaning.

    Args:
        y, share, W, group: see `gains_without`.
        rows: (N,) row of each class i in ``share`` and W.
        common: (P, H1) contribution to y of the relations between two classes, for P pairs.
        index: (n, n) row of each pair of classes in ``common``, or -1 for a pair without relations.
    """
    n, size = share.shape
    gain, off, on = np.zeros((len(rows), n), np.float32), np.empty_like(y), np.empty_like(y)
    on_without_both, product = np.empty_like(y), np.empty(_SIDE_BY_SIDE, np.float32)
    # To subtract a share from y is to multiply on / off by exp(-share).
    fall, rise, growth = _exps(-share), _exps(common), _exps(W)
    _set_halves(y, off, on)
    for c in range(len(rows)):
        i = rows[c]
        on_without_i = on * fall[i]
        for j in range(n):
            fall_j = fall[j]
            for k in range(size):
                on_without_both[k] = on_without_i[k] * fall_j[k]
            if index[i, j] >= 0:
                # The relations between i and j are part of both shares, so they were subtracted
                # twice. Add them once.
                rise_ij = rise[index[i, j]]
                for k in range(size):
                    on_without_both[k] *= rise_ij[k]
            gain[c, j] = _gain(off, on_without_both, growth[i], group, product)
    return gain


@compiled
def reasons_for_absent(y, share, W, group):
    """Return how much each of n present classes changes the gain of each absent class, (N, n).

    The change is the absent class's gain with the present class minus its gain without the present
    class.

    Args:
        y, share, group: see `gains_without`.
        W: (N, H1) weights between each absent class and the hidden units.
    """
    n, growth = len(share), _exps(W)
    change, full_gain = np.empty((len(W), n), np.float32), np.empty(len(W), np.float32)
    off, on, product = np.empty_like(y), np.empty_like(y), np.empty(_SIDE_BY_SIDE, np.float32)
    _set_halves(y, off, on)
    for c in range(len(W)):
        full_gain[c] = _gain(off, on, growth[c], group, product)
    for j in range(n):
        _set_halves(y - share[j], off, on)
        for c in range(len(W)):
            change[c, j] = full_gain[c] - _gain(off, on, growth[c], group, product)
    return change


@compiled
def _exps(x):
    """Compute e^x for x (N, H1)."""
    powers = np.empty_like(x)
    for n in range(len(x)):
        exponents, row = x[n], powers[n]
        for k in range(len(row)):
            row[k] = exp(exponents[k])
    return powers


@compiled
def resampled(weight, against, classes, presence, closed, count):
    """Select M of N stored samples by their weights for a scene (systematic resampling).

    Args:
        weight: (N,) log weights of the samples for a scene without listed classes.
        against: (V, N) odds against each class in each sample. For log-odds l, they are e^-l.
        classes: (n,) indices of the listed classes.
        presence: (n,) probability that each listed class is present.
        closed: 1 - c. The coverage c is the probability that a present class is listed.
        count: number M of samples to select.

    Returns:
        (M,) indices of the selected samples, in ascending order.
    """
    weight, cumulative = weight.copy(), np.empty(len(weight))
    for i in range(len(classes)):
        odds, p_present = against[classes[i]], presence[i]
        # log σ(l) - log(1 - c σ(l)) = -log(1 - c + e^-l)
        for n in range(len(odds)):
            weight[n] -= p_present * log(closed + odds[n])
    largest = weight.max()
    for n in range(len(weight)):
        weight[n] = exp(weight[n] - largest)
    cumulative[:] = np.cumsum(weight.astype(np.float64))
    samples, n = np.empty(count, np.int64), 0
    for m in range(count):
        quantile = (m + 0.5) / count * cumulative[-1]
        while n < len(cumulative) - 1 and cumulative[n] < quantile:
            n += 1
        samples[m] = n
    return samples


@compiled
def completed_log_odds(y, samples, against, limits, usable, bias, W, exp_w, group):
    """Average the probability of each class over M completions and return its log-odds, (V,).

    A completion is the scene with some unlisted classes added. Each completion belongs to one
    stored sample. The completion adds a usable class if the odds against this class in the sample
    are below its limit.

    Args:
        y: (H1,) logits of h1 without unlisted classes.
        samples: (M,) index of the sample of each completion.
        against: (V, N) odds against each class in each sample.
        limits: (V, M) limit of ``against`` for each class and completion.
        usable: (V,) bool, classes that a completion may add.
        bias: (V,) log-odds of each class without the hidden units.
        W, exp_w, group: see `ContextScorer`.
    """
    (V, size), M = W.shape, len(samples)
    completed, added = np.empty((M, size), np.float32), np.zeros((M, V), np.bool_)
    completed[:] = y
    for i in range(V):
        if usable[i]:
            for m in range(M):
                if against[i, samples[m]] < limits[i, m]:
                    added[m, i] = True
                    completed[m] += W[i]
    gain = gains(completed, exp_w, group, V)
    sum_present, sum_absent = np.zeros(V, np.float32), np.zeros(V, np.float32)
    off, on, fall = np.empty_like(y), np.empty_like(y), np.empty_like(y)
    product = np.empty(_SIDE_BY_SIDE, np.float32)
    for m in range(M):
        _set_halves(completed[m], off, on)
        for i in range(V):
            if added[m, i]:
                # `completed` already contains W[i]. The gain of the class is therefore
                # softplus(y) - softplus(y - W).
                row = W[i]
                for k in range(size):
                    fall[k] = exp(-row[k])
                gain[m, i] = -_gain(off, on, fall, group, product)
        for i in range(V):
            # One exponential gives p and 1 - p = odds * p. Computing 1 - p as a difference would
            # lose digits.
            odds = exp(min(max(-bias[i] - gain[m, i], -_MOST_LOGIT), _MOST_LOGIT))
            p = _ONE / (_ONE + odds)
            sum_present[i] += p
            sum_absent[i] += odds * p
    log_odds = np.empty(V, np.float32)
    for i in range(V):
        log_odds[i] = log(sum_present[i]) - log(sum_absent[i])
    return log_odds
