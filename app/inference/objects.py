"""Log-odds of classes, fast: exp(W) kept ready, one log for many factors.

The context's part of an object's log-odds is a sum of logs,

    gain_i = sum_k [softplus(x_k + W_ik) - softplus(x_k)]
           = sum_k log(sigmoid(-x_k) + sigmoid(x_k) exp(W_ik))

and every factor lies between 1 and exp(W_ik). So a group of factors can be multiplied before one
log is taken, as long as the group's product stays within float32. Both terms of a factor are
positive: nothing cancels, unlike in 1 + sigmoid(x) (exp(W) - 1), which is 0 for large x and a
weight below -17. Weights in float64, or too large for float32, are summed log by log instead.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.inference import object_kernels as kernels
from app.inference.mean_field import softplus

Floats = NDArray[np.floating[Any]]
Singles = NDArray[np.float32]
Places = NDArray[np.int64]

# Of log of a product: float32 spans exp(±87).
_LOG_RANGE = 80.0
# Beyond it sigmoid(x) can underflow to 0 where sigmoid(x) exp(W) still counts.
_LARGEST_WEIGHT = 64.0
# More factors a log gain nothing: by then the products take all the time.
_LARGEST_GROUP = 25
# Classes are taken in tiles of so many at most, whose factors stay in the second-level cache.
_TILE = 800
# A tile is whole vector registers.
_LANES = 16


def group_size(W: Floats) -> int:
    """How many factors between 1 and exp(W) may be multiplied before a log must be taken.

    0 where products of float32 are not safe at all.
    """
    largest = float(np.abs(W).max()) if W.size else 0.0
    if W.dtype == np.float64 or largest > _LARGEST_WEIGHT:
        return 0
    return min(_LARGEST_GROUP, max(1, int(_LOG_RANGE / max(largest, 1.0))))


def halves(x: Singles) -> tuple[Singles, Singles]:
    """sigmoid(-x) and sigmoid(x), from one exponential, and neither as a difference."""
    fall: Singles = np.exp(np.minimum(-x, 80))
    on = np.reciprocal(1 + fall)
    return fall * on, on


class ContextScorer:
    """The gain of every object from hidden logits, for a machine whose weights do not change.

    Every row is computed by itself with the same operations, so a row's bits do not depend on the
    other rows.

    Args:
        W: (V, H1).

    Raises:
        ValueError: W holds NaN or infinity.
    """

    def __init__(self, W: Floats) -> None:
        if not np.isfinite(W).all():
            raise ValueError("W must be finite to score with")
        self.V, self.H1 = W.shape
        self._W, self._group = W, group_size(W)
        if self._group:
            tiles = -(-self.V // _TILE)
            width = -(-self.V // (tiles * _LANES)) * _LANES
            # What fills up the last tile gains nothing: its factors are 1.
            exp_w = np.ones((tiles * width, self.H1), dtype=np.float32)
            np.exp(W, out=exp_w[: self.V])
            tiled = exp_w.reshape(tiles, width, self.H1).swapaxes(1, 2)
            self._exp = np.ascontiguousarray(tiled)

    def gain(self, x: Floats) -> Floats:
        """sum_k [softplus(x_k + W_ik) - softplus(x_k)], (..., V) in W's precision, for x (..., H1).

        Raises:
            ValueError: x is not (..., H1).
        """
        if x.shape[-1:] != (self.H1,):
            raise ValueError(f"x must be (..., {self.H1}), not {x.shape}")
        rows = x.reshape(-1, self.H1)
        if self._group:
            found: Floats = self.gains(*halves(rows.astype(np.float32)))
        else:
            logits = rows.astype(np.float64)[:, None]
            terms = softplus(logits + self._W) - softplus(logits)
            found = terms.sum(2).astype(self._W.dtype)
        return found.reshape(*x.shape[:-1], self.V)

    def gains(self, off: Singles, on: Singles) -> Singles:
        """The same of many (M, V), from their `halves` (M, H1).

        Where products of float32 are safe.
        """
        found = np.empty((len(on), self.V), dtype=np.float32)
        kernels.gains(off, on, self._exp, self._group, found)
        return found


class ObjectPart:
    """Gains of single classes in contexts of their own, for weights W (V, H1) in float32."""

    def __init__(self, W: Singles) -> None:
        self._W, self._group = W, group_size(W)

    @cached_property
    def _fall(self) -> Singles:
        """e^-W of all classes; for many at a time."""
        return np.exp(-self._W)

    def gains_with(self, context: Places, off: Singles, on: Singles, classes: Places) -> Singles:
        """What class n gained by being in context[n], its own part in it included, (N,).

        Args:
            off, on: (M, H1) `halves` of contexts.
        """
        found: Singles = kernels.paired_gains(off, on, self._fall, context, classes, self._group)
        return -found

    def gains_without(self, y: Singles, classes: Places, share: Singles) -> Singles:
        """The gain of each class, its share (n, H1) of y (H1,) taken out, (n,)."""
        off, on = halves(y - share)
        every = np.arange(len(classes))
        found: Singles = kernels.paired_gains(
            off, on, np.exp(self._W[classes]), every, every, self._group
        )
        return found

    def gains_without_others(
        self,
        y: Singles,
        classes: Places,
        share: Singles,
        rows: Places,
        common: Singles,
        index: Places,
    ) -> Singles:
        """The gain of the classes in rows (N,), each other class of the scene taken out, (N, n).

        Args:
            common, index: see `RelationUnits.common`.
        """
        off, on = halves(y)
        fall, growth = np.exp(-share), np.exp(self._W[classes])
        found: Singles = kernels.gains_without_others(
            *(rows, off, on * fall, growth, fall, np.exp(common), index, self._group)
        )
        return found

    def reasons_for_absent(self, y: Singles, candidates: Places, share: Singles) -> Singles:
        """How the gain of absent classes (N,) changes by each that is there, (N, n)."""
        off, on = halves(np.concatenate([y[None], y - share]))
        N, M = len(candidates), len(off)
        which, context = np.divmod(np.arange(N * M), M)
        growth = np.exp(self._W[candidates])
        gains = kernels.paired_gains(off, on, growth, context, which, self._group).reshape(N, M)
        change: Singles = gains[:, :1] - gains[:, 1:]
        return change
