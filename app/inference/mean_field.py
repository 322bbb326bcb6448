"""The hidden layers given objects, the second one at its mean field.

    x = c1 + Q[t] + v'W + J m2,   m1 = sigmoid(beta x),   m2 = sigmoid(beta (c2 + m1'J))

from m2 = sigmoid(beta c2) on, in turn; beta is one over the temperature. With one layer x is exact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from app.inference.weights import Weights

Floats = NDArray[np.floating[Any]]

# Enough to settle on the machines we ship; fixed, so that answers repeat.
SWEEPS: Final = 10


def sigmoid(x: Floats) -> Floats:
    """1 / (1 + e^-x); below -80 as there, since e^88 is the largest float32."""
    found: Floats = np.exp(np.minimum(-x, 80))
    found += 1
    return np.reciprocal(found, out=found)


def softplus(x: Floats) -> Floats:
    """log(1 + e^x)."""
    found: Floats = np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))
    return found


def with_second_layer(weights: Weights, base: Floats, beta: float = 1.0) -> tuple[Floats, Floats]:
    """x (B, H1) and m2 (B, H2) for base = c1 + Q[t] + v'W (B, H1)."""
    if not weights.spec.H2:
        return base, np.zeros((len(base), 0), base.dtype)
    J, c2 = weights["J"], weights["c2"]
    m2 = np.broadcast_to(sigmoid(beta * c2), (len(base), len(c2)))
    for _ in range(SWEEPS):
        m1 = sigmoid(beta * (base + m2 @ J.T))
        m2 = sigmoid(beta * (c2 + m1 @ J))
    return base + m2 @ J.T, m2
