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

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from app.boltzmann.machine import BoltzmannMachine

# Of log of a product: float32 spans exp(±87).
_LOG_RANGE = 80.0
# Beyond it sigmoid(x) can underflow to 0 where sigmoid(x) exp(W) still counts.
_LARGEST_WEIGHT = 64.0
# More factors a log gain nothing: by then the products take all the time.
_LARGEST_GROUP = 25


class ContextScorer:
    """The gain of every object from hidden logits, for a machine whose weights do not change.

    Every row is computed by itself with the same operations, so a row's result does not depend, to
    the bit, on what it is batched with.

    Args:
        machine: its W (V, H1) is copied; later changes to it are not seen.

    Raises:
        ValueError: W holds NaN or infinity.
    """

    def __init__(self, machine: BoltzmannMachine) -> None:
        W = machine.W.detach()
        self._dtype = W.dtype
        if not bool(W.isfinite().all()):
            raise ValueError("W must be finite to score with")
        self.V, self.H1 = W.shape
        largest = float(W.abs().max())
        exact = W.dtype == torch.float64 or largest > _LARGEST_WEIGHT
        self._weights = W.T.double() if exact else None
        limit = min(_LARGEST_GROUP, max(1, int(_LOG_RANGE / max(largest, 1.0))))
        groups = -(-self.H1 // limit)
        self._group = -(-self.H1 // groups)
        # A divisor of H1 needs no padding, which costs more than some further logs.
        divisor = max(size for size in range(1, limit + 1) if self.H1 % size == 0)
        if 2 * divisor >= self._group:
            self._group, groups = divisor, self.H1 // divisor
        # Units that fill up the last group have W = 0, so their factor is 1.
        self._padding = groups * self._group - self.H1
        self._exp = torch.ones(self.H1 + self._padding, self.V)
        torch.exp(W.T, out=self._exp[: self.H1])

    def gain(self, x: Tensor) -> Tensor:
        """sum_k [softplus(x_k + W_ik) - softplus(x_k)], (B, V) in W's dtype, for x (B, H1).

        Raises:
            ValueError: x is not (B, H1).
        """
        if x.dim() != 2 or x.shape[1] != self.H1:
            raise ValueError(f"x must be (B, {self.H1}), not {tuple(x.shape)}")
        gains = torch.empty(len(x), self.V, dtype=self._dtype)
        with torch.inference_mode():
            for row, gain in zip(x.detach().to(self._dtype), gains, strict=True):
                if self._weights is None:
                    self._multiply(row, gain)
                else:
                    _add_logs(row, self._weights, gain)
        return gains

    def _multiply(self, row: Tensor, gain: Tensor) -> None:
        row = (pad(row, (0, self._padding)) if self._padding else row).unsqueeze(1)
        factors = torch.mul(self._exp, row.sigmoid()).add_((-row).sigmoid())
        products = factors.view(self._group, -1).prod(0).log_()
        torch.sum(products.view(-1, self.V), 0, out=gain)


def _add_logs(row: Tensor, weights: Tensor, gain: Tensor) -> None:
    """The same by one log a factor, in float64, for weights (H1, V)."""
    row = row.double().unsqueeze(1)
    gain.copy_(torch.logaddexp(logsigmoid(-row), logsigmoid(row) + weights).sum(0))
