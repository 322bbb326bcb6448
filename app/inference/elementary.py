"""Elementary functions of arrays and of float32 numbers, and the mean of sigmoid by quadrature."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Float
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from app.compiling import compiled, inlined

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


# ---------------------------------------------------------------------------- in compiled loops
#
# Functions of the C library take one number at a time. These functions consist of arithmetic
# operations, so the compiler can apply them to a whole vector register. Their errors are below 2
# units in the last place (`tests/machines/test_elementary.py`).
#
# Source: range reduction and minimax polynomials of Moshier's Cephes library (`expf`, `logf`).

_intrinsic: Any = intrinsic
_f = np.float32
_i = np.int32

# exp() clips its argument to these limits, so that its result is positive and finite.
_LEAST, _LARGEST = _f(-87.0), _f(88.0)
# The sum of both constants is ln 2. _LN2_HIGH has few binary digits, so that its products with
# small integers are exact.
_LN2_HIGH, _LN2_LOW = _f(0.693359375), _f(-2.12194440e-4)
_SQRT_HALF_BITS = _i(0x3F3504F3)
_MANTISSA_BITS = _i(0x007FFFFF)
_ONE_BITS = _i(0x3F800000)
LN2 = _f(0.6931471805599453)


@_intrinsic
def _float_of_bits(_, bits):  # noqa: ARG001 - the compiler passes ``bits``
    def generate(_context, builder, _signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@_intrinsic
def _bits_of_float(_, value):  # noqa: ARG001
    def generate(_context, builder, _signature, args):
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), generate


@inlined
def exp(x):
    """Compute e^x = 2^n e^r for float32, with x clipped to [-87, 88]; p approximates e^r."""
    x = min(max(x, _LEAST), _LARGEST)
    n = np.floor(x * _f(1.44269504) + _f(0.5))
    r = x - n * _LN2_HIGH
    r = r - n * _LN2_LOW
    p = _f(1.9875691500e-4)
    p = p * r + _f(1.3981999507e-3)
    p = p * r + _f(8.3334519073e-3)
    p = p * r + _f(4.1665795894e-2)
    p = p * r + _f(1.6666665459e-1)
    p = p * r + _f(5.0000001201e-1)
    p = p * r * r + r + _f(1.0)
    return p * _float_of_bits((_i(n) + _i(127)) << _i(23))  # 2^n


@inlined
def log(x):
    """Compute ln x = exponent · ln 2 + ln(1 + m) for positive, normal float32; 1 + m >= √½."""
    bits = _bits_of_float(x) - _SQRT_HALF_BITS
    exponent = _f(bits >> _i(23))
    # m + p is the polynomial for ln(1 + m).
    m = _float_of_bits((bits & _MANTISSA_BITS) + _SQRT_HALF_BITS) - _f(1.0)
    p = _f(7.0376836292e-2)
    p = p * m + _f(-1.1514610310e-1)
    p = p * m + _f(1.1676998740e-1)
    p = p * m + _f(-1.2420140846e-1)
    p = p * m + _f(1.4249322787e-1)
    p = p * m + _f(-1.6668057665e-1)
    p = p * m + _f(2.0000714765e-1)
    p = p * m + _f(-2.4999993993e-1)
    p = p * m + _f(3.3333331174e-1)
    p = p * m * m * m + exponent * _LN2_LOW - _f(0.5) * m * m
    return (m + p) + exponent * _LN2_HIGH


@inlined
def exponent(x):
    """Return the exponent e (int32) of x = m 2^e, for positive, normal float32."""
    return (_bits_of_float(x) >> _i(23)) - _i(127)


@inlined
def mantissa(x):
    """Return the mantissa m in [1, 2) of x = m 2^e, for positive, normal float32."""
    return _float_of_bits((_bits_of_float(x) & _MANTISSA_BITS) | _ONE_BITS)


@inlined
def logistic(x):
    """Compute 1 / (1 + e^-x)."""
    return _f(1.0) / (_f(1.0) + exp(-x))


# ------------------------------------------------------------------------------- by quadrature

NO_UNIT: Final = np.float32(-30.0)
"""Lower limit of the log-odds of a relation."""

_ROOT_3: Final = np.float32(3.0**0.5)
_WIDE: Final = np.float32(0.75 * 3.0**0.5)  # least √3 σ of the trapezoidal rule
# Distance of the nodes of the trapezoidal rule in units of σ, and weights of the positive nodes
# relative to the weight of node 0.
_STEP: Final = np.float32(0.25)
_TAIL: Final = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


def to_log_odds(mean: Float[NDArray, "*E"], spread: Float[NDArray, "*E"]) -> Float[NDArray, "*E"]:
    """Return the log-odds of the mean of sigmoid(ℓ) for a normal logit ℓ, at least `NO_UNIT`.

    `spread` is √3 σ, where σ is the standard deviation of ℓ. For σ < 0.75, the quadrature has three
    nodes, 0 and ±√3 σ, with weights 4 : 1 : 1. The error in the probability is at most 0.0004. With
    u = e^-|mean| and q = e^(√3 σ), the sigmoids at the nodes are u/(1 + u), uq/(1 + uq) and
    u/(q + u). These forms cannot overflow. For σ of at least 0.75, the nodes are those of the
    trapezoidal rule. docs/decisions/inference.md has the errors.
    """
    log_odds = mean.ravel().astype(np.float32)
    # ravel() makes the arrays contiguous. For another layout, numba would compile the loop again.
    _to_log_odds(log_odds, spread.ravel())
    return log_odds.reshape(mean.shape)


@compiled
def _to_log_odds(means: Float[NDArray, " E"], spreads: Float[NDArray, " E"]) -> None:
    """Replace the means of normal logits ℓ by the log-odds of E[sigmoid(ℓ)], given √3 σ.

    The loops compute the log-odds for |mean|, and give them the sign of the mean. `wide` are the W
    logits of the trapezoidal rule; all others have three nodes.
    """
    one, four, wide, W = np.float32(1.0), np.float32(4.0), np.empty(len(means), np.int64), 0
    for e in range(len(means)):
        if spreads[e] >= _WIDE:
            wide[W] = e
            W += 1
    # With u = e^-|mean| and q = e^(distance of a node), plus sums sigmoid(ℓ) over the nodes, and
    # minus sums sigmoid(-ℓ) / u. Short loops let the compiler use vector instructions.
    u, q, step = np.empty(W, np.float32), np.ones(W, np.float32), np.empty(W, np.float32)
    minus, plus = np.empty(W, np.float32), np.empty(W, np.float32)
    for k in range(W):
        u[k], step[k] = -abs(means[wide[k]]), _STEP / _ROOT_3 * spreads[wide[k]]
    for k in range(W):
        u[k], step[k] = exp(u[k]), exp(step[k])
        minus[k] = plus[k] = one / (one + u[k])
    for weight in _TAIL:
        for k in range(W):
            q[k] = min(q[k] * step[k], np.float32(1e30))
            up, down = one / (one + u[k] * q[k]), one / (q[k] + u[k])
            minus[k] += weight * (q[k] * up + down)
            plus[k] += weight * (up + q[k] * down)
    for k in range(W):
        step[k] = log(minus[k] / plus[k])
    for k in range(W):
        log_odds = abs(means[wide[k]]) - step[k]
        plus[k] = log_odds if means[wide[k]] >= 0.0 else -log_odds
    # sigmoid(ℓ) is 1/a, 1/b and root/c at the three nodes, and sigmoid(-ℓ) is ratio times 1/a,
    # root/b and 1/c. The sums have the common denominator a b c.
    for e in range(len(means)):
        size, root = abs(means[e]), exp(spreads[e])
        ratio = exp(-size)
        a, b, c = one + ratio, one + ratio * root, root + ratio
        middle = four * b * c
        log_odds = size - log((middle + a * (root * c + b)) / (middle + a * (c + root * b)))
        means[e] = max(log_odds if means[e] >= 0.0 else -log_odds, NO_UNIT)
    for k in range(W):
        means[wide[k]] = max(plus[k], NO_UNIT)
