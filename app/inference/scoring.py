"""Scores of all objects of one machine, fast: exp(W) kept ready, one log for many factors.

The context's part of an object's log-odds is a sum of logs,

    gain_i = sum_k [softplus(x_k + W_ik) - softplus(x_k)]
           = sum_k log(sigmoid(-x_k) + sigmoid(x_k) exp(W_ik))

and every factor lies between 1 and exp(W_ik). So a group of factors can be multiplied before one
log is taken, as long as the group's product stays within float32. Both terms of a factor are
positive: nothing cancels, unlike in 1 + sigmoid(x) (exp(W) - 1), which is 0 for large x and a
weight below -17. Weights in float64, or too large for float32, are summed log by log instead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import exponent, log, logistic, mantissa

Floats = NDArray[np.floating[Any]]

# Of log of a product: float32 spans exp(±87).
_LOG_RANGE = 80.0
# Beyond it sigmoid(x) can underflow to 0 where sigmoid(x) exp(W) still counts.
_LARGEST_WEIGHT = 64.0
# More factors a log gain nothing: by then the products take all the time.
_LARGEST_GROUP = 25
# Objects are taken in tiles of so many, whose factors stay in the first-level cache.
_TILE = 64
_LN2 = np.float32(0.6931471805599453)


def group_size(W: Floats) -> int:
    """How many factors between 1 and exp(W) may be multiplied before a log must be taken.

    0 where products of float32 are not safe at all.
    """
    largest = float(np.abs(W).max()) if W.size else 0.0
    if W.dtype == np.float64 or largest > _LARGEST_WEIGHT:
        return 0
    return min(_LARGEST_GROUP, max(1, int(_LOG_RANGE / max(largest, 1.0))))


class ContextScorer:
    """The gain of every object from hidden logits, for a machine whose weights do not change.

    Every row is computed by itself with the same operations, so a row's result does not depend, to
    the bit, on what it is batched with.

    Args:
        W: (V, H1).

    Raises:
        ValueError: W holds NaN or infinity.
    """

    def __init__(self, W: Floats) -> None:
        if not np.isfinite(W).all():
            raise ValueError("W must be finite to score with")
        self.V, self.H1 = W.shape
        self._dtype = W.dtype
        self._group = group_size(W)
        self._weights = None if self._group else W.astype(np.float64)
        tiles = -(-self.V // _TILE)
        self._exp = np.ones((tiles if self._group else 0, self.H1, _TILE), dtype=np.float32)
        for number, tile in enumerate(self._exp):
            rows = W[number * _TILE : (number + 1) * _TILE]
            tile[:, : len(rows)] = np.exp(rows.T)

    def gain(self, x: Floats) -> Floats:
        """sum_k [softplus(x_k + W_ik) - softplus(x_k)], (V,) in W's precision, for x (H1,).

        Raises:
            ValueError: x is not (H1,).
        """
        if x.shape != (self.H1,):
            raise ValueError(f"x must be ({self.H1},), not {x.shape}")
        if self._weights is not None:
            return _sum_of_logs(x, self._weights).astype(self._dtype)
        gain = np.empty(self.V, dtype=np.float32)
        _gain(np.ascontiguousarray(x, dtype=np.float32), self._exp, self._group, gain)
        return gain

    def rows_gain(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same for some rows (M, H1), (M, V); to rounding, not to the bit."""
        if self._weights is not None:
            return np.stack([self.gain(row).astype(np.float32) for row in x])
        gains = np.empty((len(x), self.V), dtype=np.float32)
        _gains(x, self._exp, self._group, gains)
        return gains


def _sum_of_logs(x: Floats, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same by one log a factor, in float64, for weights (V, H1)."""
    off = -np.logaddexp(0.0, x.astype(np.float64))
    total: NDArray[np.float64] = np.logaddexp(off, x + off + weights).sum(1)
    return total


@compiled
def _gain(x, exp_w, group, out):
    """One row: x (H1,), exp_w (tiles, H1, objects of a tile), out (V,)."""
    tiles, units, width = exp_w.shape
    on, off = np.empty(units, np.float32), np.empty(units, np.float32)
    for k in range(units):
        on[k] = logistic(x[k])
        off[k] = logistic(-x[k])
    product, total = np.empty(width, np.float32), np.empty(width, np.float32)
    for t in range(tiles):
        tile = exp_w[t]
        for i in range(width):
            total[i] = np.float32(0.0)
        for start in range(0, units, group):
            for i in range(width):
                product[i] = np.float32(1.0)
            for k in range(start, min(start + group, units)):
                a, b, row = off[k], on[k], tile[k]
                for i in range(width):
                    product[i] *= a + b * row[i]
            for i in range(width):
                total[i] += log(product[i])
        first = t * width
        for i in range(min(width, len(out) - first)):
            out[first + i] = total[i]


@compiled
def _gains(x, exp_w, group, out):
    """The same of rows x (M, H1), out (M, V), tile by tile.

    Of a group's product only the exponent is set aside, and one log is taken in the end.
    """
    (tiles, units, width), rows = exp_w.shape, len(x)
    on, off = np.empty((rows, units), np.float32), np.empty((rows, units), np.float32)
    for m in range(rows):
        for k in range(units):
            on[m, k] = logistic(x[m, k])
        for k in range(units):
            off[m, k] = logistic(-x[m, k])
    product, exponents = np.empty(width, np.float32), np.empty(width, np.int32)
    for t in range(tiles):
        tile, first = exp_w[t], t * width
        for m in range(rows):
            ons, offs, into = on[m], off[m], out[m]
            for i in range(width):
                product[i], exponents[i] = np.float32(1.0), np.int32(0)
            for start in range(0, units, group):
                for k in range(start, min(start + group, units)):
                    a, b, row = offs[k], ons[k], tile[k]
                    for i in range(width):
                        product[i] *= a + b * row[i]
                for i in range(width):
                    exponents[i] += exponent(product[i])
                for i in range(width):
                    product[i] = mantissa(product[i])
            for i in range(min(width, len(out[m]) - first)):
                into[first + i] = log(product[i]) + _LN2 * np.float32(exponents[i])
