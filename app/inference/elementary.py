"""Elementary functions: of numpy arrays, and of float32 numbers in compiled loops."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from app.compiling import inlined

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
    """Compute e^x for float32, with x clipped to [-87, 88]."""
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
    return p * _float_of_bits((_i(n) + _i(127)) << _i(23))


@inlined
def log(x):
    """Compute ln x for positive, normal float32."""
    bits = _bits_of_float(x) - _SQRT_HALF_BITS
    exponent = _f(bits >> _i(23))
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
