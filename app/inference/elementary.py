"""Elementary functions of numpy arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]


def sigmoid(x: Floats) -> Floats:
    """Compute 1 / (1 + e^-x). Replace x below -80 by -80, because e^89 would overflow float32."""
    y: Floats = np.exp(np.minimum(-x, 80))
    y += 1
    return np.reciprocal(y, out=y)


def softplus(x: Floats) -> Floats:
    """Compute log(1 + e^x)."""
    return np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))


def softmax(x: NDArray[Any]) -> NDArray[Any]:
    """Compute e^x / sum e^x over the last axis, which may be empty."""
    y: NDArray[Any] = np.exp(x - x.max(-1, keepdims=True, initial=-np.inf))
    return y / y.sum(-1, keepdims=True)


def log_softmax(x: NDArray[Any]) -> NDArray[Any]:
    """Compute log softmax(x) over the last axis, which may be empty."""
    shifted = x - x.max(-1, keepdims=True, initial=-np.inf)
    return shifted - np.log(np.exp(shifted).sum(-1, keepdims=True))
