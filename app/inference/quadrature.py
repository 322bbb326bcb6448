"""The log-odds of the mean of sigmoid(ℓ) for a normal logit ℓ, by quadrature.

σ is the standard deviation of ℓ. For σ < 0.75, the quadrature has three nodes, 0 and ±√3 σ, with
weights 4 : 1 : 1. The error in the probability is at most 0.0004. With u = e^-|mean| and
q = e^(√3 σ), the sigmoids at the nodes are u/(1 + u), uq/(1 + uq) and u/(q + u). These forms cannot
overflow. For σ of at least 0.75, the nodes are those of the trapezoidal rule.
docs/decisions/inference.md has the errors.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import exp, log

NO_UNIT: Final = np.float32(-30.0)
"""Lower limit of the log-odds of a relation."""

_ROOT_3: Final = np.float32(3.0**0.5)
_WIDE: Final = np.float32(0.75 * 3.0**0.5)  # least √3 σ of the trapezoidal rule
# Distance of the nodes of the trapezoidal rule in units of σ, and weights of the positive nodes
# relative to the weight of node 0.
_STEP: Final = np.float32(0.25)
_TAIL: Final = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


def to_log_odds(mean: Float[NDArray, "*E"], spread: Float[NDArray, "*E"]) -> Float[NDArray, "*E"]:
    """Return the log-odds of the mean of sigmoid(ℓ), at least `NO_UNIT`. `spread` is √3 σ of ℓ."""
    log_odds = mean.ravel().astype(np.float32)
    # ravel() makes the arrays contiguous. For another layout, numba would compile the loop again.
    _to_log_odds(log_odds, spread.ravel())
    return log_odds.reshape(mean.shape)


@compiled
def _to_log_odds(means: Float[NDArray, " E"], spreads: Float[NDArray, " E"]) -> None:
    """Replace the means of logits by log-odds, given √3 σ, by both rules of the module."""
    one, four, wide, W = np.float32(1.0), np.float32(4.0), np.empty(len(means), np.int64), 0
    for e in range(len(means)):
        if spreads[e] >= _WIDE:
            wide[W] = e
            W += 1
    u, q, step = np.empty(W, np.float32), np.ones(W, np.float32), np.empty(W, np.float32)
    on, off = np.empty(W, np.float32), np.empty(W, np.float32)
    for k in range(W):
        u[k], step[k] = -abs(means[wide[k]]), _STEP / _ROOT_3 * spreads[wide[k]]
    for k in range(W):
        u[k], step[k] = exp(u[k]), exp(step[k])
        on[k] = off[k] = one / (one + u[k])
    for weight in _TAIL:
        for k in range(W):
            q[k] = min(q[k] * step[k], np.float32(1e30))
            up, down = one / (one + u[k] * q[k]), one / (q[k] + u[k])
            on[k] += weight * (q[k] * up + down)
            off[k] += weight * (up + q[k] * down)
    for k in range(W):
        step[k] = log(on[k] / off[k])
    for k in range(W):
        log_odds = abs(means[wide[k]]) - step[k]
        on[k] = log_odds if means[wide[k]] >= 0.0 else -log_odds
    # The sums over the three nodes have the common denominator a b c.
    for e in range(len(means)):
        size, root = abs(means[e]), exp(spreads[e])
        ratio = exp(-size)
        a, b, c = one + ratio, one + ratio * root, root + ratio
        middle = four * b * c
        log_odds = size - log((middle + a * (root * c + b)) / (middle + a * (c + root * b)))
        means[e] = max(log_odds if means[e] >= 0.0 else -log_odds, NO_UNIT)
    for k in range(W):
        means[wide[k]] = max(on[k], NO_UNIT)
