"""The mean of sigmoid(ℓ) for a normal logit ℓ, by quadrature.

docs/decisions/inference.md has the errors.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import exp, log

Floats = NDArray[np.float32]

NO_UNIT: Final = np.float32(-30.0)
"""Lower limit of the log-odds of a relation."""

_ROOT_3 = np.float32(3.0**0.5)
# Limit of √3 σ. Below this limit, a quadrature with three nodes is accurate enough.
_NARROW = np.float32(0.75 * 3.0**0.5)
# Constants of the trapezoidal rule for larger σ. _STEP is the distance between two nodes in units
# of σ. _TAIL contains the weights of the positive nodes, relative to the weight of node 0.
_STEP = np.float32(0.25)
_TAIL = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


def to_log_odds(mean: Floats, spread: Floats) -> Floats:
    """Return the log-odds of the mean of sigmoid(ℓ) for normal logits ℓ.

    The smallest result is `NO_UNIT`. σ is the standard deviation of ℓ. For σ < 0.75, the quadrature
    has three nodes, 0 and ±√3 σ, with weights 4 : 1 : 1. The error in the probability is at most
    0.0004. With u = e^-|mean| and q = e^spread, the sigmoids at the nodes are u/(1 + u),
    uq/(1 + uq) and u/(q + u). These forms cannot overflow. For σ of at least 0.75, the function
    uses the trapezoidal rule.

    Args:
        mean: means of the logits, an array of any shape.
        spread: √3 σ of the logits. The array has the same shape.
    """
    log_odds = mean.ravel().astype(np.float32)
    # ravel() makes the arrays contiguous. For another layout, numba would compile the kernel again.
    _to_log_odds(log_odds, spread.ravel(), NO_UNIT)
    return log_odds.reshape(mean.shape)


@compiled
def _to_log_odds(means, spreads, least):
    """Replace the means (E,) of logits by log-odds of at least ``least``; see `to_log_odds`."""
    wide, E = np.empty(len(means), np.int64), 0
    for e in range(len(means)):
        if spreads[e] >= _NARROW:
            wide[E] = e
            E += 1
    wide_means, wide_spreads = np.empty(E, np.float32), np.empty(E, np.float32)
    for k in range(E):
        wide_means[k], wide_spreads[k] = means[wide[k]], spreads[wide[k]]
    wide_log_odds = _wide_log_odds(wide_means, wide_spreads)
    one, four = np.float32(1.0), np.float32(4.0)
    # The sums over the three nodes have the common denominator a b c; see `to_log_odds`.
    for e in range(len(means)):
        size, q = abs(means[e]), exp(spreads[e])
        u = exp(-size)
        a, b, c = one + u, one + u * q, q + u
        middle = four * b * c
        log_odds = size - log((middle + a * (q * c + b)) / (middle + a * (c + q * b)))
        means[e] = max(log_odds if means[e] >= 0.0 else -log_odds, least)
    for k in range(E):
        means[wide[k]] = max(wide_log_odds[k], least)


@compiled
def _wide_log_odds(means, spreads):
    """Compute the log-odds by the trapezoidal rule, without a lower limit."""
    one, E = np.float32(1.0), len(means)
    u, step, q = np.empty(E, np.float32), np.empty(E, np.float32), np.empty(E, np.float32)
    on, off = np.empty(E, np.float32), np.empty(E, np.float32)
    for e in range(E):
        q[e] = one
        u[e], step[e] = exp(-abs(means[e])), exp(_STEP / _ROOT_3 * spreads[e])
        on[e] = off[e] = one / (one + u[e])
    for node in range(len(_TAIL)):
        weight = _TAIL[node]
        for e in range(E):
            q[e] = min(q[e] * step[e], np.float32(1e30))
            up, down = one / (one + u[e] * q[e]), one / (q[e] + u[e])
            on[e] += weight * (q[e] * up + down)
            off[e] += weight * (up + q[e] * down)
    for e in range(E):
        log_odds = abs(means[e]) - log(on[e] / off[e])
        on[e] = log_odds if means[e] >= 0.0 else -log_odds
    return on
