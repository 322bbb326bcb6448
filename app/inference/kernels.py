"""All compiled loops: arrays in, arrays out.

numba compiles a loop at its first call and stores it on disk. It compiles the stored loops again if
this file changes, but not if another file changes. So this file has all constants and named tuples
of the loops, and it imports no other module with a part in them.

The modules in the titles of the sections call the loops and explain the formulas.
"""

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from app.compiling import FOLDER

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

KERNELS: Final[list[Any]] = []
"""Every loop that numba stores on disk."""


def _kernel(function: Callable[..., Any], **options: Any) -> Any:
    options |= {"cache": FOLDER is not None, "nogil": True, "error_model": "numpy"}
    # Only Python calls the loops, so they need no wrapper for C.
    kernel = njit(no_cfunc_wrapper=True, **options)(function)
    KERNELS.append(kernel)
    return kernel


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function. In compiled code, division by zero gives infinity or NaN."""
    return _kernel(function)


def compiled_in_any_order(function: Callable[..., Any]) -> Any:
    """Compile a function, and let the compiler reorder sums to use vector instructions.

    The compiler chooses the order of the terms once, so results are reproducible. The function must
    not call `exp` and `log` of this file, which depend on the order of operations.
    """
    return _kernel(function, fastmath={"reassoc", "contract"})


def inlined(function: Callable[..., Any]) -> Any:
    """Inline a function into each compiled function that calls it, with its compiler options."""
    return njit(inline="always", error_model="numpy")(function)


# ---------------------------------------------------------------------------- elementary functions
#
# These functions take float32 numbers. Functions of the C library take one number at a time. The
# exp and log of this file consist of arithmetic operations, so the compiler can apply them to a
# whole vector register. Their errors are below 2 units in the last place
# (`tests/machines/test_elementary.py`).
#
# Source: range reduction and minimax polynomials of Moshier's Cephes library (`expf`, `logf`).

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
_LN2 = _f(0.6931471805599453)


@intrinsic
def _float_of_bits(_, bits):  # noqa: ARG001 - the compiler passes ``bits``
    def generate(_context, builder, _signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@intrinsic
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


@compiled
def _find(keys, key):
    """Return the row of a key in ascending keys (N,), or -1 without such a key."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1


# ----------------------------------------------------------- hidden units: weights.py, objects.py


@compiled
def all_states(x, states):
    """Return the probabilities of all states of the hidden units, (B, units, states).

    Args:
        x: (B, H1) logits of all states but the first of each unit.
        states: number of states of a unit.
    """
    p = _with_first(x, states)
    for b in range(len(p)):
        for m in range(p.shape[1]):
            row = p[b, m]
            top = _largest(row)
            # The square of e^(x/2) covers subnormal numbers.
            for z in range(states):
                row[z] = exp((row[z] - top) * _f(0.5))
                row[z] *= row[z]
            scale = np.float32(1.0) / _total(row)
            for z in range(states):
                row[z] *= scale
    return p


@compiled
def odds(x, states):
    """Return e^x of all states of the hidden units, (B, units, states). See `all_states`."""
    p = _with_first(x, states)
    flat = p.reshape(-1)
    for k in range(len(flat)):
        flat[k] = exp(flat[k])
    return p


@compiled
def _with_first(x, states):
    """Return x (B, H1) with a 0 for the first state of each unit, (B, units, states)."""
    p = np.zeros((len(x), x.shape[1] // (states - 1), states), np.float32)
    for b in range(len(p)):
        for m in range(p.shape[1]):
            for z in range(1, states):
                p[b, m, z] = x[b, m * (states - 1) + z - 1]
    return p


@compiled_in_any_order
def _largest(row):
    largest = row[0]
    for z in range(1, len(row)):
        largest = max(largest, row[z])
    return largest


@compiled_in_any_order
def _total(row):
    total = np.float32(0.0)
    for z in range(len(row)):
        total += row[z]
    return total


@compiled
def gains(p, factors, group, rows):
    """Return the gain of each row of weights, (B, rows); see `Gains`.

    After each group of sums, the function splits the product into mantissa and exponent, and adds
    the exponent to an integer. So one log at the end is enough.

    Args:
        p: (B, units, states) probabilities of the states of h1.
        factors: (tiles, units, states - 1, rows per tile) exponentials of the weights.
        group: maximum number of sums in a product.
        rows: number of rows of weights.
    """
    tiles, units, states, width = factors.shape
    gain = np.empty((len(p), rows), np.float32)
    product, exponents = np.empty(width, np.float32), np.empty(width, np.int32)
    total = np.empty(width, np.float32)
    for t in range(tiles):
        for b in range(len(p)):
            product[:], exponents[:] = _f(1.0), _i(0)
            for m in range(units):
                total[:] = p[b, m, 0]
                for z in range(0, states - 1, 2):
                    # The loop takes two states at a time. This halves the reads and writes.
                    p1, row1 = p[b, m, z + 1], factors[t, m, z]
                    p2, row2 = p[b, m, z + 2], factors[t, m, z + 1]
                    for i in range(width):
                        total[i] += p1 * row1[i] + p2 * row2[i]
                if states % 2:
                    p1, row1 = p[b, m, states], factors[t, m, states - 1]
                    for i in range(width):
                        total[i] += p1 * row1[i]
                for i in range(width):
                    product[i] *= total[i]
                if (m + 1) % group == 0 or m + 1 == units:
                    for i in range(width):
                        exponents[i] += exponent(product[i])
                        product[i] = mantissa(product[i])
            gain_b = gain[b, t * width :]
            for i in range(min(width, rows - t * width)):
                gain_b[i] = log(product[i]) + _LN2 * np.float32(exponents[i])
    return gain


@compiled_in_any_order
def gain_factors(p, raised, removed):
    """Return the factors of e^gain, (N, units), and of e^-change, (N, n, units).

    A factor is the effect of one hidden unit; see `explained_log_odds`.

    Args:
        p: (N or 1, units, states) probabilities of the states of h1.
        raised: (N, units, states) exponentials of the weights of the classes c.
        removed: (n, units, states) exponentials of the contributions of classes j, negated.
    """
    (N, units, states), n = raised.shape, len(removed)
    gain, ratio = np.empty((N, units), np.float32), np.empty((N, n, units), np.float32)
    for c in range(N):
        for m in range(units):
            row, factors = p[min(c, len(p) - 1), m], raised[c, m]
            with_class = np.float32(0.0)
            for z in range(states):
                with_class += row[z] * factors[z]
            gain[c, m] = with_class
            for j in range(n):
                without, before, after = removed[j, m], np.float32(0.0), np.float32(0.0)
                for z in range(states):
                    product = row[z] * without[z]
                    before += product
                    after += product * factors[z]
                ratio[c, j, m] = after / (before * with_class)
    return gain, ratio


@compiled
def source_weights(f, a, classes, presence):
    """Return softmax(f + a v) of the data sources in N scenes, (N, profiles).

    The sums have float64 digits, so that listed structure, whose terms are 0, changes none. See
    `weights.Weights.source_weights` for the arguments.
    """
    p = np.empty((len(presence), len(f)), np.float64)
    for s in range(len(presence)):
        top, total = -np.inf, 0.0
        for q in range(len(f)):
            p[s, q] = f[q]
            for j in range(len(classes)):
                p[s, q] += np.float64(a[q, classes[j]]) * presence[s, j]
            top = max(top, p[s, q])
        for q in range(len(f)):
            p[s, q] = math.exp(p[s, q] - top)
            total += p[s, q]
        for q in range(len(f)):
            p[s, q] /= total
    return p


@compiled
def class_log_odds(gain, bias, p, a, L, classes, presence):
    """Return gain + bias + sum_q p_q a_q + sum_j presence_j L_j, (V,).

    Args:
        gain, bias: (V,) terms of the classes.
        p, a: (profiles,) probabilities of the data sources, and (profiles, V) their base rates.
        L: (V, V) couplings, or (0, V) without couplings.
        classes, presence: (n,) listed classes j, and the probabilities that they are present.
    """
    log_odds = np.empty(len(gain), np.float32)
    for i in range(len(gain)):
        log_odds[i] = gain[i] + bias[i]
    for q in range(len(p)):
        weight, row = np.float32(p[q]), a[q]
        for i in range(len(gain)):
            log_odds[i] += weight * row[i]
    for j in range(len(classes) if len(L) else 0):
        weight, row = presence[j], L[classes[j]]
        for i in range(len(gain)):
            log_odds[i] += weight * row[i]
    return log_odds


@compiled
def log_sums(x):
    """Return the sum of ln x over the last axis, (N,), for positive x (N, units)."""
    total = np.zeros(len(x), np.float32)
    for i in range(len(x)):
        row = x[i]
        for m in range(len(row)):
            total[i] += log(row[m])
    return total


@compiled
def explained_log_odds(
    x, shares, W, bias, L, f, a, states, classes, presence, rows, targets, explained
):
    """Return the log-odds of N target classes i given the listed classes, and their changes.

    The log-odds are bias_i + gain_i + sum_q p_q a_qi + sum_j presence_j L_ij; see `objects`. The
    change by class j is their value minus their value without class j.

    Args:
        x: (H1,) logits of h1 given the n listed classes.
        shares: (n, H1) contribution of each listed class to x.
        W, bias, L: (V, H1) weights of h1, (V,) biases, and (V, V) couplings, or (0, V) without
            couplings.
        f, a: (Q,) and (Q, V) weights of the Q possible data sources; see `weights.layout`.
        states: number of states of a hidden unit.
        classes, presence: (n,) the listed classes; see `ObjectScorer.absent`.
        rows: (N,) index of each target among the listed classes. A class is not evidence for
            itself. `rows` is empty if the targets are not listed.
        targets: (N,) the target classes.
        explained: whether to compute the changes.

    Returns:
        The log-odds, (N,), and the changes, (N, n). The changes are (N, 0) if not `explained`.
    """
    N, n, coupled = len(targets), len(classes) if explained else 0, len(L) > 0
    base = np.empty((max(len(rows), 1), len(x)), np.float32)
    base[0] = x
    for i in range(len(rows)):
        base[i] = x - shares[rows[i]]
    p, raised = all_states(base, states), odds(W[targets], states)
    factors, ratios = gain_factors(p, raised, odds(-shares[:n], states))
    log_odds, change = log_sums(factors), np.empty((N, n), np.float32)
    mean, of_source = _source_effects(f, a, classes, presence, rows, targets, n)
    for i in range(N):
        total, change[i] = np.float32(0.0), -log_sums(ratios[i])
        for j in range(len(classes) if coupled else 0):
            total += presence[j] * L[classes[j], targets[i]]
        log_odds[i] = bias[targets[i]] + log_odds[i] + mean[i] + total
        for j in range(n):
            if coupled:
                change[i, j] += L[targets[i], classes[j]] * presence[j]
            change[i, j] += of_source[i, j]
        if n and len(rows):
            change[i, rows[i]] = np.float32(0.0)
    return log_odds, change


@compiled
def _source_effects(f, a, classes, presence, rows, targets, n):
    """Return the effect of the unknown data source on N target classes, and its changes.

    The effect on a class i is the mean base rate sum_q p_q a_qi over the Q data sources. p_q is the
    probability of source q given the listed classes.

    Args:
        n: number of listed classes whose changes are computed. For the others, see
            `explained_log_odds`.

    Returns:
        The effects, (N,), and the change of each effect due to each listed class, (N, n).
    """
    Q = len(f)
    # Part of each listed class in the logit of each source, and e^-part.
    parts, without = np.empty((len(classes), Q), np.float32), np.empty((n, Q), np.float32)
    logits, p = f.copy(), np.empty(Q, np.float32)
    for j in range(len(classes)):
        for q in range(Q):
            parts[j, q] = a[q, classes[j]] * presence[j]
            logits[q] += parts[j, q]
    for j in range(n):
        for q in range(Q):
            without[j, q] = exp(-parts[j, q])
    mean, change = np.zeros(len(targets), np.float32), np.zeros((len(targets), n), np.float32)
    for i in range(len(targets) if Q else 0):
        top, total, weighted = np.float32(-np.inf), np.float32(0.0), np.float32(0.0)
        for q in range(Q):
            p[q] = logits[q] - parts[rows[i], q] if len(rows) else logits[q]
            top = max(top, p[q])
        for q in range(Q):
            p[q] = exp(p[q] - top)
            total += p[q]
            weighted += p[q] * a[q, targets[i]]
        mean[i] = weighted / total
        for j in range(n):
            total, weighted = np.float32(0.0), np.float32(0.0)
            for q in range(Q):
                weight = p[q] * without[j, q]
                total += weight
                weighted += weight * a[q, targets[i]]
            change[i, j] = mean[i] - weighted / total
    return mean, change


# ------------------------------------------------------------------- relation units: relations.py

SPREAD, SHIFT = 2654435761, 16
"""Constants of a hash table: bucket of a pair = (key * SPREAD) >> SHIFT, modulo the table size."""

NO_UNIT: Final = np.float32(-30.0)
"""Lower limit of the log-odds of a relation."""

# `draw_in_groups` samples the relations in 2 * _GROUPS groups.
_GROUPS = 4
# Limit of a degree feature. This feature counts the relations of one kind that a class has. More
# than three relations add little information.
_MOST = np.float32(3.0)

# Number of float32 in a vector register. Rows of whole registers are faster.
_VECTOR: Final = 8
_ROOT_3 = np.float32(3.0**0.5)
# Limit of √3 σ. Below this limit, a quadrature with three nodes is accurate enough.
_NARROW = np.float32(0.75 * 3.0**0.5)
# Constants of the trapezoidal rule for larger σ. _STEP is the distance between two nodes in units
# of σ. _TAIL contains the weights of the positive nodes, relative to the weight of node 0.
_STEP = np.float32(0.25)
_TAIL = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


class SharedArrays(NamedTuple):
    """Weights of a Triway's units for the compiled kernels.

    Attributes:
        S, O: (V, K + 1) factors of each class as subject and as object. The last column is 1.
        s, o: (V, A) weights of each class as subject and as object of each relation.
        n: (A, 2) weights of the log number of instances of subject and object class.
        start, key: look-up table of `pair_rows`.
        residual: (pairs + 1, A) residual weight w' of each pair of classes and each relation. The
            last row is 0.
    """

    S: Floats
    O: Floats  # noqa: E741
    s: Floats
    o: Floats
    n: Floats
    start: NDArray[np.int32]
    key: NDArray[np.int32]
    residual: Floats


class Ends(NamedTuple):
    """Subject and object classes of some pairs. All arrays have the same shape.

    Attributes:
        i, j: class indices of the subjects and of the objects.
        log_i, log_j: log of the number of instances of each class in i and in j.
        p_i, p_j: probability that each class in i and in j is present.
    """

    i: Indices
    j: Indices
    log_i: Floats
    log_j: Floats
    p_i: Floats
    p_j: Floats


@compiled
def pair_rows(start, keys, pairs):
    """Return the row of each pair of classes in the table of residual weights, (E,).

    Args:
        start: first row of each bucket of the hash table.
        keys: keys of the pairs in the table. A pair (i, j) of V classes has the key i V + j.
        pairs: (E,) keys to look up. A key outside the table gets the last row, which is zero.
    """
    # Buckets are faster than binary search, because the processor cannot predict its branches.
    rows = np.empty(len(pairs), np.int64)
    for e in range(len(pairs)):
        pair = pairs[e]
        bucket = (pair * SPREAD >> SHIFT) & (len(start) - 2)
        rows[e] = len(keys)
        for row in range(start[bucket], start[bucket + 1]):
            if keys[row] == pair:
                rows[e] = row
    return rows


@compiled
def placement_ends(candidates, classes, log_counts, presence):
    """Return the `Ends` of N candidate classes and m anchor classes, (N, 2 m) each.

    In the first m columns, the candidate is the subject. In the others, the anchor is. Candidates
    are present, with one instance.
    """
    N, m = len(candidates), len(classes)
    i, j = np.empty((N, 2 * m), np.int64), np.empty((N, 2 * m), np.int64)
    log_i, log_j = np.empty((N, 2 * m), np.float32), np.empty((N, 2 * m), np.float32)
    p_i, p_j = np.empty((N, 2 * m), np.float32), np.empty((N, 2 * m), np.float32)
    for c in range(N):
        for k in range(m):
            i[c, k] = j[c, m + k] = candidates[c]
            j[c, k] = i[c, m + k] = classes[k]
            log_i[c, k] = log_j[c, m + k] = np.float32(0.0)
            log_j[c, k] = log_i[c, m + k] = log_counts[k]
            p_i[c, k] = p_j[c, m + k] = np.float32(1.0)
            p_j[c, k] = p_i[c, m + k] = presence[k]
    return Ends(i, j, log_i, log_j, p_i, p_j)


@compiled_in_any_order
def normal_logits(w, first, ends, U, Y, C, f):
    """Return the means and √3 σ of the logits of R relations for P pairs in B batches, (B, R, P).

    The mean of a logit is base + U z, and its variance σ² is q'C q - sum_u (f_u'q)² with q = Y z.
    z are the factors of the pair, and base are the terms that do not depend on the hidden units;
    see `relations.SharedUnits`.

    Args:
        w: weights of the units; see `relations.SharedArrays`.
        first: index of the first of the R consecutive relations.
        ends: subject and object classes of the pairs, (B, P); see `relations.Ends`.
        U: (B, R, K) weights of the factors.
        Y: (R, r, K) matrix Y of each relation. σ is 0 if r is 0.
        C: (B, R, r (r + 1) / 2) lower half of each symmetric r x r matrix C. Entries off the
            diagonal are doubled. The function subtracts the products of f from C, in place.
        f: (units u, B, R, r) vectors f_u.
    """
    # Local names are faster: each access through the tuple would change a reference count.
    S, O, s, o, n, residual = w.S, w.O, w.s, w.o, w.n, w.residual  # noqa: E741
    (B, P), (R, r, K) = ends.i.shape, Y.shape
    width = -(-P // _VECTOR) * _VECTOR
    z, q = np.zeros((K, B * width), np.float32), np.empty((r, B * width), np.float32)
    mean, spread = np.empty((B, R, P), np.float32), np.empty((B, R, P), np.float32)
    row, variance = np.empty(width, np.float32), np.empty(width, np.float32)
    for b in range(B):
        subjects, objects, log_i, log_j = ends.i[b], ends.j[b], ends.log_i[b], ends.log_j[b]
        pairs = pair_rows(w.start, w.key, subjects * len(S) + objects)
        for p in range(P):
            i, j = subjects[p], objects[p]
            for k in range(K):
                z[k, b * width + p] = S[i, k] * O[j, k]
            for c in range(R):
                a = first + c
                of_counts = n[a, 0] * log_i[p] + n[a, 1] * log_j[p]
                mean[b, c, p] = s[i, a] + o[j, a] + of_counts + residual[pairs[p], a]
    for c in range(R):
        for d in range(r):
            _weighted_sum(Y[c, d], z, 0, q[d])
        for b in range(B):
            _weighted_sum(U[b, c], z, b * width, row)
            for p in range(P):
                mean[b, c, p] += row[p]
            lower, t = C[b, c], 0
            for u in range(len(f)):
                _subtract_product(f[u, b, c], lower)
            variance[:] = np.float32(0.0)
            for d in range(r):
                _weighted_sum(lower[t : t + d + 1], q, b * width, row)
                t, q_d = t + d + 1, q[d, b * width : (b + 1) * width]
                for p in range(width):
                    variance[p] += row[p] * q_d[p]
            for p in range(P):
                spread[b, c, p] = np.sqrt(np.float32(3.0) * max(variance[p], np.float32(0.0)))
    return mean, spread


@compiled_in_any_order
def _weighted_sum(weights, rows, start, total):
    """Write sum_k weights_k rows_k (P,) to total. P columns of the rows begin at column start."""
    K, P = len(weights), len(total)
    total[:] = np.float32(0.0)
    # Two rows at a time halve the reads and writes of the sum.
    for k in range(0, K - 1, 2):
        weight, row = weights[k], rows[k, start : start + P]
        next_weight, next_row = weights[k + 1], rows[k + 1, start : start + P]
        for p in range(P):
            total[p] += weight * row[p] + next_weight * next_row[p]
    if K % 2:
        weight, row = weights[K - 1], rows[K - 1, start : start + P]
        for p in range(P):
            total[p] += weight * row[p]


@compiled_in_any_order
def _subtract_product(f, lower):
    """Subtract f f' from a symmetric matrix, in place; see `normal_logits` for its lower half."""
    t = 0
    for d in range(len(f)):
        double = f[d] + f[d]
        for e in range(d):
            lower[t + e] -= double * f[e]
        lower[t + d] -= f[d] * f[d]
        t += d + 1


@compiled
def log_odds(means, spreads, least):
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


@compiled
def _empty_steps(relations, n):
    """Return the empty step tables of a scene of n classes without relations.

    A step leads from one class to another class along a relation that holds. A step of kind a leads
    from the subject to the object of relation a. A step of kind A + a leads from the object to the
    subject of relation a.

    Returns:
        degree: (2A kinds, n classes) number of steps of each kind that start at each class.
        near: (2A kinds, n classes, n) end classes of these steps.
        path_kinds: (n, n, 2A) paths of two steps from one class to another. The last axis is the
            kind of the first step. Each value is a bit set of the kinds of the second step.
        paths: (n, n, A) change of the logit of each relation by the paths between its two classes.
    """
    steps = 2 * relations
    degree, near = np.zeros((steps, n), np.int64), np.empty((steps, n, n), np.int64)
    path_kinds = np.zeros((n, n, steps), np.uint64)
    return degree, near, path_kinds, np.zeros((n, n, relations), np.float32)


@compiled
def _add_relation(tables, weight, a, i, j):
    """Add the steps of relation a between classes i and j, and the new paths, to the tables."""
    # The loops use plain indices, because a slice would cost more time.
    degree, near, path_kinds, paths = tables
    steps = len(degree)
    directions = (a, i, j), (steps // 2 + a, j, i)
    for c, x, y in directions:
        near[c, x, degree[c, x]] = y
        degree[c, x] += 1
    for c, x, y in directions:
        for d in range(steps):
            for step in range(degree[d, y]):
                _add_path(path_kinds, paths, weight, x, near[d, y, step], c, d)
            # If a step of kind d leads from x to another class, then a step of the opposite kind
            # leads from the other class to x.
            back = (d + steps // 2) % steps
            for step in range(degree[d, x]):
                _add_path(path_kinds, paths, weight, near[d, x, step], y, back, c)


@inlined
def _add_path(path_kinds, paths, weight, x, y, first, second):
    """Add a path of two steps (kinds first, second) from x to y, unless it is in the tables."""
    steps, bit = path_kinds.shape[2], np.uint64(1) << np.uint64(second)
    if not path_kinds[x, y, first] & bit:
        path_kinds[x, y, first] |= bit
        for b in range(paths.shape[2]):
            paths[x, y, b] += weight[steps + first * steps + second, b]


@compiled
def _shifts(tables, weight, direct):
    """Return how much the relations that hold change the logit of each relation, (n, n, A).

    Args:
        tables: step tables of the relations that hold; see `_empty_steps`.
        weight: (F, A) weights of the F features of relations that hold; see
            `RelationUnits.implication_weights`.
        direct: True if relations between the same two classes change each other's logits.
    """
    degree, near, _, paths = tables
    (steps, n), A = degree.shape, weight.shape[1]
    shift, degrees = paths.copy(), weight[steps + steps * steps :]
    out_shift, in_shift = np.zeros((n, A), np.float32), np.zeros((n, A), np.float32)
    for c in range(steps):
        # Each step of kind c that ends at a class has an opposite step that starts at this class.
        back = (c + A) % steps
        for x in range(n):
            for b in range(A):
                out_shift[x, b] += degrees[c, b] * min(np.float32(degree[c, x]), _MOST)
                in_shift[x, b] += degrees[steps + c, b] * min(np.float32(degree[back, x]), _MOST)
    for x in range(n):
        for y in range(n):
            for b in range(A):
                shift[x, y, b] += out_shift[x, b] + in_shift[y, b]
    for c in range(steps):
        back = (c + A) % steps
        for x in range(n):
            for step in range(degree[c, x]):
                y = near[c, x, step]
                for b in range(A):
                    if direct:
                        shift[x, y, b] += weight[c, b]
                    # The degree features for the pair (x, y) must not count the step from x to y.
                    if degree[c, x] <= _MOST:
                        shift[x, y, b] -= degrees[c, b]
                    if degree[back, y] <= _MOST:
                        shift[x, y, b] -= degrees[steps + c, b]
    return shift


@compiled
def implication_shifts(weight, n, a, i, j):
    """Return how much the relations that hold change the logit of each relation, twice (n, n, A).

    The first array has the changes by all relations that hold. In the second one, relations between
    the same two classes do not change each other's logits.

    Args:
        weight: see `_shifts`.
        n: number of classes in the scene.
        a, i, j: (E,) indices of the relations that hold, of their subject classes and of their
            object classes. Subject and object class differ.
    """
    tables = _empty_steps(weight.shape[1], n)
    for e in range(len(a)):
        _add_relation(tables, weight, a[e], i[e], j[e])
    return _shifts(tables, weight, True), _shifts(tables, weight, False)


@compiled
def draw_in_groups(weight, logits, free, uniform, group_numbers, r):
    """Sample relations that change each other's logits, group after group.

    Each group is sampled given the relations of all earlier groups. The function assigns relations
    to groups at random. But a(i, j) and a(j, i) are always in different groups.

    Args:
        weight: see `_shifts`.
        logits: (A, n, n) logits of the relations without the changes by other relations.
        free: (A, n, n) bool, True for relations to sample. Other relations keep their value.
        uniform: (A, n, n) random numbers in [0, 1) that decide whether each relation holds.
        group_numbers: (A, n, n) random numbers in [0, 1) that select the group of each relation.
        r: (A, n, n) bool, True for relations that hold. The function writes the samples into r.
    """
    A, n, _ = r.shape
    tables, group = _empty_steps(A, n), np.empty(r.shape, np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                group[a, i, j] = -1
                if free[a, i, j]:
                    # a(i, j) and a(j, i) share one random number, which decides whether a(i, j) or
                    # a(j, i) is sampled first.
                    first_is_late = group_numbers[a, min(i, j), max(i, j)] < 0.5
                    half = _GROUPS if first_is_late == (i < j) else 0
                    number = np.int64(2 * _GROUPS * group_numbers[a, i, j]) % _GROUPS
                    group[a, i, j] = half + number
    # Turn -1 only adds the relations that are on and not free.
    for turn in range(-1, 2 * _GROUPS):
        if turn >= 0:
            shift = _shifts(tables, weight, True)
            for a in range(A):
                for i in range(n):
                    for j in range(n):
                        if group[a, i, j] == turn:
                            p = logistic(logits[a, i, j] + shift[i, j, a])
                            r[a, i, j] = uniform[a, i, j] < p
        for a in range(A):
            for i in range(n):
                for j in range(n):
                    if group[a, i, j] == turn and r[a, i, j] and i != j:
                        _add_relation(tables, weight, a, i, j)


# ------------------------------------------------------------------------ Gibbs chains: chains.py


class ChainArrays(NamedTuple):
    """Weights for the compiled kernel. `weights.layout` explains the attributes not listed here.

    Attributes:
        WT: (H1, V), transpose of W.
        L: (V, V) couplings, or (0, V) for a machine without couplings.
        b: (V,) biases of the classes.
    """

    W: Floats
    WT: Floats
    L: Floats
    b: Floats


@compiled
def _add_rows(rows, on, total):
    """Add each row with on[row] = 1 to total. on has the shape (n,)."""
    for i in range(len(on)):
        if on[i]:
            row = rows[i]
            for k in range(len(total)):
                total[k] += row[k]


@compiled
def _draw_state(logits, beta, uniform):
    """Draw the state of a hidden unit: 0 for the first state, whose logit is 0."""
    top = np.float32(0.0)
    for z in range(len(logits)):
        top = max(top, beta * logits[z])
    total = exp(-top)
    for z in range(len(logits)):
        total += exp(beta * logits[z] - top)
    threshold = uniform * total
    cumulative = exp(-top)
    if threshold < cumulative:
        return 0
    for z in range(len(logits)):
        cumulative += exp(beta * logits[z] - top)
        if threshold < cumulative:
            return z + 1
    return len(logits)  # rounding


@compiled
def sweeps(w, bias, always, beta, uniform, on, h1):
    """Run Gibbs sweeps that change the arrays on and h1 in place.

    A sweep draws h1 given the classes, and then the classes. Coupled classes are drawn one after
    another, each given all others.

    Args:
        w: `ChainArrays`.
        bias: (H1,) bias of h1.
        always: (V,) uint8, 1 for classes that stay present.
        beta: 1 / temperature.
        uniform: (sweeps, units + V) random numbers.
        on: (V,) uint8, presence of the classes.
        h1: (units,) state of each unit of h1.
    """
    V, H1 = w.W.shape
    units = len(h1)
    states = H1 // units
    x, coupled = np.empty(H1, np.float32), len(w.L) > 0
    field, from_classes = np.empty(V, np.float32), np.zeros(V, np.float32)
    if coupled:
        _add_rows(w.L, on, from_classes)
    for t in range(len(uniform)):
        row = uniform[t]
        x[:] = bias
        _add_rows(w.W, on, x)
        for m in range(units):
            h1[m] = _draw_state(x[m * states : (m + 1) * states], beta, row[m])
        field[:] = w.b
        for m in range(units):
            if h1[m]:
                from_h1 = w.WT[m * states + h1[m] - 1]
                for i in range(V):
                    field[i] += from_h1[i]
        for i in range(V):
            logit = beta * (field[i] + from_classes[i])
            drawn = max(always[i], np.uint8(row[units + i] < logistic(logit)))
            if coupled and drawn != on[i]:
                sign, changed = np.float32(1.0 if drawn else -1.0), w.L[i]
                for j in range(V):
                    from_classes[j] += sign * changed[j]
            on[i] = drawn


# ---------------------------------------------------------------- rectangles: scene/footprints.py

# Maximum deviation in radians from a multiple of 90 degrees at which two rectangles count as
# parallel. Parallel rectangles can share an edge, and clipping would count such an edge twice.
_PARALLEL: Final = 1e-6
# This length replaces an edge length of 0, to avoid division by zero.
_SHORTEST: Final = 1e-150
_QUARTER: Final = math.pi / 2


@compiled
def measure_pairs(centre_a, size_a, yaw_a, centre_b, size_b, yaw_b, share, gap):
    """Write overlap and gap of P pairs of rectangles to share (P,) and gap (P,)."""
    for p in range(len(share)):
        share[p], gap[p] = measure(
            centre_a[p], size_a[p], yaw_a[p], centre_b[p], size_b[p], yaw_b[p]
        )


@compiled
def measure(centre_a, size_a, yaw_a, centre_b, size_b, yaw_b):
    """Compute overlap and gap of one pair of rectangles; see `overlap_and_gap`.

    Centres and sizes may have a third component, which the function ignores.
    """
    # In its own axes, rectangle b is |x| <= half_b[0], |y| <= half_b[1].
    offset = _turn_back(
        (centre_a[0] - centre_b[0], centre_a[1] - centre_b[1]), math.cos(yaw_b), math.sin(yaw_b)
    )
    yaw = yaw_a - yaw_b
    half_a, half_b = (size_a[0] / 2, size_a[1] / 2), (size_b[0] / 2, size_b[1] / 2)
    quarters = np.rint(yaw / _QUARTER)
    if not abs(yaw - quarters * _QUARTER) < _PARALLEL:
        area, gap = _skew(offset, half_a, math.cos(yaw), math.sin(yaw), half_b)
    elif quarters / 2 != np.rint(quarters / 2):
        # A rotation by 90 degrees exchanges the extents.
        area, gap = _parallel(offset, (half_a[1], half_a[0]), half_b)
    else:
        area, gap = _parallel(offset, half_a, half_b)
    smaller = min(size_a[0] * size_a[1], size_b[0] * size_b[1])
    if smaller > 0.0:
        return area / smaller, gap
    # If a rectangle has an area of 0, the overlap is 1 for touching rectangles and 0 for others.
    return 1.0 if gap == 0.0 else 0.0, gap


@compiled
def _parallel(offset, half_a, half_b):
    """Compute the area of the intersection and the gap of two parallel rectangles.

    Along each axis, the intervals of a and b have a gap, or overlap if the gap is negative. The
    overlap is at most the shorter interval.
    """
    gap_x = abs(offset[0]) - half_a[0] - half_b[0]
    gap_y = abs(offset[1]) - half_a[1] - half_b[1]
    overlap_x = max(min(-gap_x, 2 * min(half_a[0], half_b[0])), 0.0)
    overlap_y = max(min(-gap_y, 2 * min(half_a[1], half_b[1])), 0.0)
    return overlap_x * overlap_y, math.hypot(max(gap_x, 0.0), max(gap_y, 0.0))


@compiled
def _skew(offset, half_a, cos, sin, half_b):
    """Compute the area of the intersection and the gap of two rectangles that are not parallel."""
    # By Green's theorem, the area follows from the border of the intersection. The border consists
    # of the parts of edges of a inside b, and of edges of b inside a. A part from p to q adds
    # cross(p, q) / 2 to the area, with the centre of b as origin.
    swept_a, swept_b, gap = 0.0, 0.0, math.inf
    for k in range(4):
        start, end = _corner(half_a, k), _corner(half_a, k + 1)
        start = _moved(_turn(start, cos, sin), offset)
        end = _moved(_turn(end, cos, sin), offset)
        p, q = _clipped(start, end, half_b)
        swept_a += p[0] * q[1] - p[1] * q[0]
        # The shortest line between two separate convex polygons has an end at a corner.
        gap = min(gap, _distance(start, half_b))
    back = (-offset[0], -offset[1])
    for k in range(4):
        start, end = _corner(half_b, k), _corner(half_b, k + 1)
        # Convert the corners of b to the axes of a.
        start = _turn_back(_moved(start, back), cos, sin)
        end = _turn_back(_moved(end, back), cos, sin)
        p, q = _clipped(start, end, half_a)
        p = _moved(_turn(p, cos, sin), offset)
        q = _moved(_turn(q, cos, sin), offset)
        swept_b += p[0] * q[1] - p[1] * q[0]
        gap = min(gap, _distance(start, half_a))
    area = max(swept_a / 2 + swept_b / 2, 0.0)
    return area, 0.0 if area > 0.0 else gap


@compiled
def _corner(half, k):
    """Return corner k of a rectangle around the origin, counting counter-clockwise."""
    k = k % 4
    return (half[0] if k in (0, 3) else -half[0], half[1] if k < 2 else -half[1])


@compiled
def _moved(point, offset):
    return offset[0] + point[0], offset[1] + point[1]


@compiled
def _turn(point, cos, sin):
    return cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]


@compiled
def _turn_back(point, cos, sin):
    return cos * point[0] + sin * point[1], cos * point[1] - sin * point[0]


@compiled
def _clipped(start, end, half):
    """Clip an edge to a rectangle around the origin (Liang & Barsky 1984).

    The function returns both ends of the clipped edge. They are equal if the edge lies outside the
    rectangle.
    """
    # Edges are never parallel to the axes of the rectangle. So x or y is 0 only if rounding has
    # reduced the edge to a point. Such an edge adds no area.
    x, y = end[0] - start[0] or _SHORTEST, end[1] - start[1] or _SHORTEST
    # A point of the edge is start + t (x, y). The sides of the rectangle have these values of t.
    low_x, high_x = (-half[0] - start[0]) / x, (half[0] - start[0]) / x
    low_y, high_y = (-half[1] - start[1]) / y, (half[1] - start[1]) / y
    enter = max(min(low_x, high_x), min(low_y, high_y), 0.0)
    leave = min(max(low_x, high_x), max(low_y, high_y), 1.0)
    leave = max(enter, leave)
    return (
        (start[0] + enter * x, start[1] + enter * y),
        (start[0] + leave * x, start[1] + leave * y),
    )


@compiled
def _distance(point, half):
    """Return the distance from a point to a rectangle around the origin."""
    return math.hypot(max(abs(point[0]) - half[0], 0.0), max(abs(point[1]) - half[1], 0.0))


# ----------------------------------------------------------------- roles of boxes: scene/roles.py

ON, UNDER, IN = 0, 1, 2
"""Roles of the smaller object: on-top of, under, or inside the larger object."""

SAME: Final = 0.01  # footprints or volumes count as equal up to this share of the larger one
LEAST_RISE: Final = 0.2  # minimum height of an object on the larger, as a share of its height
MAX_RISE: Final = 0.10  # height in metres above the bottom of the larger that counts as the floor
MAX_HEIGHT: Final = 1.2  # maximum height of an object in the larger, as a share of its height
LEAST_WEIGHT: Final = 0.5  # minimum smoothed count of a role that decides
LEAST_SHARE: Final = 0.8  # minimum share of a role among the possible roles of a pair
# Weight of the roles at the larger class, in counts. They decide for pairs that were never seen.
_OF_ANCHOR: Final = 2.0


@compiled
def is_smaller(size_i, size_j):
    """Return whether box i is smaller than box j.

    The function compares the areas of the footprints. If these are equal up to the share `SAME`, it
    compares the volumes. If the volumes are also equal, no box is smaller than the other.

    Args:
        size_i, size_j: extents of the boxes in x, y and z, in metres, (3,).
    """
    extent_i, extent_j = size_i[0] * size_i[1], size_j[0] * size_j[1]  # areas in m²
    if abs(extent_i - extent_j) <= SAME * max(extent_i, extent_j):
        extent_i, extent_j = extent_i * size_i[2], extent_j * size_j[2]  # volumes in m³
    return extent_i < extent_j - SAME * max(extent_i, extent_j)


@compiled
def possible_roles(rise, height, larger_height):
    """Return which roles the heights of two boxes allow, (3,) bool.

    Args:
        rise: bottom of the smaller box above the bottom of the larger box, in metres.
        height: height of the smaller box in metres.
        larger_height: height of the larger box in metres.
    """
    possible = np.empty(3, np.bool_)
    possible[ON] = rise >= LEAST_RISE * larger_height
    possible[UNDER] = rise <= max(MAX_RISE, LEAST_RISE * larger_height)
    possible[IN] = height <= MAX_HEIGHT * larger_height
    return possible


@compiled
def likely_role(roles, i, j, possible):
    """Return the role of a smaller object of class i at a larger object of class j, or -1.

    The result is -1 if no role has `LEAST_SHARE` of the smoothed counts, and at least
    `LEAST_WEIGHT`.

    Args:
        roles: see `RoleCounts`.
        i, j: class indices. -1 means an unknown class.
        possible: (3,) bool, True for the roles that the boxes allow.
    """
    pair, counts, anchor = roles
    if i < 0 or j < 0:
        return -1
    row, likeliest, largest, total = _find(pair, i * len(anchor) + j), -1, 0.0, 0.0
    of_anchor = anchor[j, 0] + anchor[j, 1] + anchor[j, 2]
    for role in range(3):
        weight = 0.0
        if possible[role]:
            if of_anchor > 0:
                weight += _OF_ANCHOR * anchor[j, role] / of_anchor
            if row >= 0:
                weight += counts[row, role]
        total += weight
        if weight > largest:
            likeliest, largest = role, weight
    return likeliest if largest >= max(LEAST_WEIGHT, LEAST_SHARE * total) else -1


# ---------------------------------------------------------- relations of boxes: scene/geometry.py

LEFT, FRONT, ON_TOP, ABOVE, INSIDE = 0, 1, 2, 3, 4
"""Indices of the canonical relations."""
_NONE: Final = -1  # index for "no relation"

MIN_OVERLAP: Final = 0.30  # minimum overlap as a share of the smaller footprint
CONTACT: Final = 0.05  # maximum distance in metres between bottom and top for *on-top*
NEIGHBOUR_GAP: Final = 1.0  # maximum distance in metres between the footprints of neighbours
NEIGHBOUR_DISTANCE: Final = 1.5  # maximum distance in metres between centres if a size is unknown
MIN_OFFSET: Final = 0.10  # minimum |dx| or |dy| in metres for *front* or *left*


@compiled
def relate_all(points, extents, turns, horizontal, classes, roles, holds, observed):
    """Write the relations of all pairs of boxes to ``holds`` and ``observed``."""
    n = len(points)
    has_position, has_size = np.empty(n, np.bool_), np.empty(n, np.bool_)
    radius = np.empty(n)
    for i in range(n):
        has_position[i], has_size[i] = _is_known(points[i]), _is_known(extents[i])
        radius[i] = math.hypot(extents[i, 0], extents[i, 1]) / 2
    for i in range(n):
        for j in range(i + 1, n):
            if not (has_position[i] and has_position[j]):
                continue
            distance = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            have_sizes, overlap = has_size[i] and has_size[j], False
            if not have_sizes:
                neighbours = distance <= NEIGHBOUR_DISTANCE
            # The distance between the circles around the footprints is a fast first check, because
            # `measure` is slower.
            elif distance - radius[i] - radius[j] <= NEIGHBOUR_GAP:
                share, gap = measure(
                    points[i], extents[i], turns[i], points[j], extents[j], turns[j]
                )
                neighbours, overlap = gap <= NEIGHBOUR_GAP, share >= MIN_OVERLAP
            else:
                neighbours = False
            # The order of relation indices is left, front, on-top, above, inside.
            first = LEFT if neighbours and horizontal else ON_TOP
            last = INSIDE if have_sizes else FRONT
            for relation in range(first, last + 1):
                observed[relation, i, j] = observed[relation, j, i] = True
            if overlap and _stack(points, extents, i, j, classes, roles, holds, observed):
                continue
            if neighbours and horizontal:
                for subject, anchor in ((i, j), (j, i)):
                    relation = _horizontal(points, subject, anchor)
                    if relation != _NONE:
                        holds[relation, subject, anchor] = True


@compiled
def _is_known(row):
    return not (math.isnan(row[0]) or math.isnan(row[1]) or math.isnan(row[2]))


@compiled
def _stack(points, extents, i, j, classes, roles, holds, observed):
    """Set the stacked relations of two boxes by rules 1 to 3. Return whether a rule applies.

    The footprints must overlap.
    """
    for subject, anchor in ((i, j), (j, i)):
        relation = _vertical(points, extents, subject, anchor)
        if relation != _NONE:
            holds[relation, subject, anchor] = True
            return True
    nested = _surrounds(points, extents, i, j) or _surrounds(points, extents, j, i)
    lowest = max(_lift(points, extents, i, j), _lift(points, extents, j, i))
    if lowest >= -CONTACT and not nested:
        return False  # two thin boxes at the same height
    for smaller, larger in ((i, j), (j, i)):
        if is_smaller(extents[smaller], extents[larger]):
            _choose_role(points, extents, smaller, larger, classes, roles, holds, observed)
            return True
    for relation in (ON_TOP, INSIDE):
        observed[relation, i, j] = observed[relation, j, i] = False
    return True


@compiled
def _choose_role(points, extents, smaller, larger, classes, roles, holds, observed):
    """Set the relation of a role by rule 3, or leave the relations of possible roles unobserved."""
    height, larger_height = extents[smaller, 2], extents[larger, 2]
    rise = points[smaller, 2] - height / 2 - (points[larger, 2] - larger_height / 2)
    possible = possible_roles(rise, height, larger_height)
    role = likely_role(roles, classes[smaller], classes[larger], possible)
    if role == ON:
        holds[ON_TOP, smaller, larger] = True
    elif role == UNDER:
        holds[ON_TOP, larger, smaller] = True
    elif role == IN:
        holds[INSIDE, smaller, larger] = True
    else:
        observed[ON_TOP, smaller, larger] = not possible[ON]
        observed[ON_TOP, larger, smaller] = not possible[UNDER]
        observed[INSIDE, smaller, larger] = not possible[IN]


@compiled
def _vertical(points, extents, i, j):
    """Return the vertical relation of box i to box j. Their footprints must overlap."""
    lift = _lift(points, extents, i, j)
    if lift > CONTACT:
        return ABOVE
    if abs(lift) <= CONTACT and points[i, 2] > points[j, 2]:
        return _NONE if _surrounds(points, extents, i, j) else ON_TOP
    return _NONE


@compiled
def _surrounds(points, extents, i, j):
    """Return whether box i surrounds box j; see rule 1. Their footprints must overlap."""
    half, half_j = extents[i, 2] / 2, extents[j, 2] / 2
    is_lower = points[i, 2] - half < points[j, 2] - half_j
    is_higher = points[i, 2] + half > points[j, 2] + half_j
    is_high = extents[i, 2] > 2 * CONTACT
    return is_lower and is_higher and is_high and is_smaller(extents[j], extents[i])


@compiled
def _lift(points, extents, i, j):
    """Return the height in metres of the bottom of box i above the top of box j."""
    return (points[i, 2] - extents[i, 2] / 2) - (points[j, 2] + extents[j, 2] / 2)


@compiled
def _horizontal(points, i, j):
    """Return the horizontal relation of box i to its neighbour j."""
    to_front, to_left = points[j, 0] - points[i, 0], points[i, 1] - points[j, 1]
    if abs(to_left) >= abs(to_front):
        return LEFT if to_left >= MIN_OFFSET else _NONE
    return FRONT if to_front >= MIN_OFFSET else _NONE


@compiled
def pool_classes(classes, confidence):
    """Return the n distinct classes of N instances; classes (N,) int64, confidence (N,) float64.

    Returns:
        Class indices in ascending order, (n,).
        Index of the first instance of each class, (n,).
        For each instance, index of its class in the first array, (N,).
        Number of instances of each class, (n,).
        Probability that at least one instance of each class exists, (n,).
    """
    distinct, row = np.empty(len(classes), np.int64), np.empty(len(classes), np.int64)
    counts, first = np.zeros(len(classes), np.int64), np.empty(len(classes), np.int64)
    absent, n = np.ones(len(classes), np.float64), 0
    order = np.empty(len(classes), np.int64)
    for k in range(len(classes)):  # insertion sort
        place = k
        while place and classes[order[place - 1]] > classes[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    for k in range(len(classes)):
        instance = order[k]
        if n == 0 or distinct[n - 1] != classes[instance]:
            distinct[n], first[n] = classes[instance], instance
            n += 1
        row[instance] = n - 1
        counts[n - 1] += 1
        absent[n - 1] *= 1.0 - confidence[instance]
    return distinct[:n], first[:n], row, counts[:n], 1.0 - absent[:n]


@compiled
def pool_relations(row, n, holds, observed):
    """Pool the relations of instances (A, N, N) into relations of classes (A, n, n), all bool.

    ``row`` (N,) is the index of each instance's class, from 0 to n - 1. The results are the pooled
    ``holds`` and ``observed``.
    """
    A, size, _ = holds.shape
    class_holds, class_observed = np.zeros((A, n, n), np.bool_), np.zeros((A, n, n), np.bool_)
    for a in range(A):
        for i in range(size):
            for j in range(size):
                if i != j and (holds[a, i, j] or observed[a, i, j]):
                    class_observed[a, row[i], row[j]] = True
                    class_holds[a, row[i], row[j]] |= holds[a, i, j]
    return class_holds, class_observed


# ------------------------------------------------------------- calibration and ranking: questions

EXCLUDED = np.float32(-1.0)
"""Evidence that a relation cannot hold."""
MOST_EXCLUDED = np.float32(0.01)
"""Maximum probability of a relation that cannot hold."""


@compiled
def relation_probability(slopes, log_odds, log_count):
    """Return the probability that each relation holds between two objects, (B, A, N).

    The shape is (B candidate classes, A relations, N pairs of classes). B is 1 without candidates.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        log_odds: (B, A, N) log-odds of the relation between classes.
        log_count: (N,) log of the number of object pairs with these two classes.
    """
    p = np.empty_like(log_odds)
    for a in range(p.shape[1]):
        intercept, slope, weight = slopes[a, 0], slopes[a, 1], slopes[a, 2]
        for b in range(len(p)):
            row, logits = log_odds[b, a], p[b, a]
            for j in range(len(row)):
                logits[j] = intercept + slope * row[j] + weight * log_count[j]
    # One loop over all rows is faster than one loop per row, because a row may be short.
    flat = p.reshape(-1)
    for e in range(len(flat)):
        flat[e] = logistic(np.float32(flat[e]))
    return p


@inlined
def exclusive(forward, backward):
    """Scale p(a(x,y)) and p(a(y,x)) so that their sum is at most 1.

    The reason is that a relation a cannot hold in both directions between the same two objects.
    """
    total = np.maximum(forward + backward, np.float32(1.0))
    return forward / total, backward / total


@inlined
def with_evidence(p, evidence, opposite):
    """Return the probability of a relation a(x, y), given the evidence about it and about a(y, x).

    A relation cannot hold in both directions.
    """
    if evidence > EXCLUDED:
        return evidence
    if opposite > EXCLUDED:
        return min(p, MOST_EXCLUDED, max(np.float32(1.0) - opposite, np.float32(0.0)))
    return min(p, MOST_EXCLUDED) if evidence == EXCLUDED else p


@compiled
def best(values, usable, count):
    """Return the indices of the `count` largest usable values, largest first.

    Of equal values, the value with the lower index comes first. The time is O(N log count).

    Args:
        values: (N,) values to compare.
        usable: (N,) bool, True for values that the result may contain.
        count: maximum number of indices.

    Returns:
        At most `count` indices.
    """
    size, kept = 0, min(count, len(values))
    # The heap contains the best indices so far. Its root is the worst of these indices: the index
    # with the smallest value, and of several equal values the largest index.
    heap = np.empty(kept, np.int64)
    for position in range(len(values)):
        if not usable[position]:
            continue
        if size < kept:
            node = size
            size += 1
            while node and not _worse(values, heap[(node - 1) // 2], position):
                heap[node] = heap[(node - 1) // 2]
                node = (node - 1) // 2
            heap[node] = position
        elif values[position] > values[heap[0]]:
            _sink(values, heap, size, position)
    ranked = heap[:size]
    for last in range(size - 1, 0, -1):
        worst, moved = heap[0], heap[last]
        _sink(values, heap, last, moved)
        ranked[last] = worst
    return ranked


@compiled
def _worse(values, one, other):
    """Return whether the value at index `one` ranks after the value at index `other`."""
    return values[one] < values[other] or (values[one] == values[other] and one > other)


@compiled
def _sink(values, heap, size, position):
    """Replace the root of the heap by the index `position`, and restore the heap order."""
    node = 0
    while 2 * node + 1 < size:
        child = 2 * node + 1
        if child + 1 < size and _worse(values, heap[child + 1], heap[child]):
            child += 1
        if not _worse(values, heap[child], position):
            break
        heap[node] = heap[child]
        node = child
    heap[node] = position


@compiled
def likeliest_relations(
    slopes, log_odds, log_counts, row, judged, evidence, least, opposites, count
):
    """Return the `count` likeliest relations between N objects, likeliest first.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        log_odds: (A, n, n) log-odds of the A relations between the n classes of the scene.
        log_counts: (n,) log of the number of instances of each class.
        row: (N,) index of each object's class among the n classes.
        judged: (N, N) bool, True for the ordered pairs of objects to judge.
        evidence: (A, N, N) probability of each observed relation, `EXCLUDED` for a relation that
            cannot hold, and NaN for other relations. It is empty if the scene shows no relations.
        least: minimum probability of a relation in the result.
        opposites: whether the result also contains opposite relations. The opposite of relation a
            has the number A + a.
        count: maximum number k of relations.

    Returns:
        Five arrays (k,): subjects, objects, relations, probabilities, and the probabilities without
        the evidence.
    """
    (A, n), size = log_odds.shape[:2], len(row)
    counts = np.empty((n, n), log_counts.dtype)
    for i in range(n):
        for j in range(n):
            counts[i, j] = log_counts[i] + log_counts[j]
    log_odds = log_odds.reshape(1, A, n * n)
    p = relation_probability(slopes, log_odds, counts.reshape(-1)).reshape(A, n, n)
    names = 2 * A if opposites else A
    grid, usable = np.zeros((size, size, names), p.dtype), np.zeros((size, size, names), np.bool_)
    expected = np.zeros((size, size, names), p.dtype)
    for x in range(size):
        for y in range(size):
            if judged[x, y]:
                i, j = row[x], row[y]
                for a in range(A):
                    to, back = exclusive(p[a, i, j], p[a, j, i])
                    expected[x, y, a] = to
                    if opposites:
                        expected[x, y, A + a] = back
                    if len(evidence):
                        shown, opposite = evidence[a, x, y], evidence[a, y, x]
                        to = with_evidence(to, shown, opposite)
                        back = with_evidence(back, opposite, shown)
                    grid[x, y, a], usable[x, y, a] = to, to >= least
                    if opposites:
                        grid[x, y, A + a], usable[x, y, A + a] = back, back >= least
    values = grid.reshape(-1)
    indices = best(values, usable.reshape(-1), count)
    pair = indices // names
    of_model = expected.reshape(-1)[indices].astype(np.float64)
    probabilities = values[indices].astype(np.float64)
    return pair // size, pair % size, indices % names, probabilities, of_model


@compiled
def likeliest_places(slopes, forward, backward, log_counts, count, first, share, least):
    """Return the likeliest places of each of N candidate classes, likeliest first.

    A place is a relation a to an anchor j, which is a class of the scene. The number of the place
    is (d A + a) m + j. The candidate is the relation's subject if d = 0, and the anchor is the
    subject if d = 1.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        forward: (N, A, m) log-odds of relations with a candidate as subject and an anchor as
            object.
        backward: (N, A, m) log-odds of relations with an anchor as subject and a candidate as
            object.
        log_counts: (m,) log of the number of instances of each anchor's class.
        count: maximum number of places of a candidate.
        first: number of a place that comes first even if other places are likelier, or if it is
            unlikely. -1 means that the order depends only on the probabilities.
        share, least: minimum probability of a place, as a share of the candidate's first place, and
            as a number.

    Returns:
        Five arrays (k,) with the places of candidate 0, then of candidate 1 and so on: index of the
        candidate, relation, True if the candidate is the subject, index of the anchor, and
        probability.
    """
    N, A, m = forward.shape
    size = A * m
    to = relation_probability(slopes, forward, log_counts)
    back = relation_probability(slopes, backward, log_counts)
    p, usable = np.empty(2 * size, forward.dtype), np.ones(2 * size, np.bool_)
    kept, begin, at = min(count, 2 * size), 0, 0
    if first >= 0:
        usable[first], begin = False, 1
    candidate, relation = np.empty(N * kept, np.int64), np.empty(N * kept, np.int64)
    outgoing, anchor = np.empty(N * kept, np.bool_), np.empty(N * kept, np.int64)
    probabilities = np.empty(N * kept, np.float64)
    for c in range(N):
        p_to, p_back = to[c].reshape(-1), back[c].reshape(-1)
        for e in range(size):
            p[e], p[size + e] = exclusive(p_to[e], p_back[e])
        indices = best(p, usable, kept - begin)
        enough = max(share * p[first if begin else indices[0]], least)
        for k in range(kept):
            place = first if k < begin else indices[k - begin]
            if k < begin or p[place] >= enough:
                candidate[at], relation[at], anchor[at] = c, place // m % A, place % m
                outgoing[at], probabilities[at] = place < size, p[place]
                at += 1
    return candidate[:at], relation[:at], outgoing[:at], anchor[:at], probabilities[:at]


@compiled
def strongest(change, rows, count):
    """Return the indices and values of the k <= `count` largest absolute changes, each (N, k).

    The result leaves out the change of a class by itself.

    Args:
        change: (N, n) change of each explained class's log-odds by each of the n classes of the
            scene.
        rows: (N,) index of each explained class among the n classes. It is empty if the explained
            classes are absent.
        count: maximum of k.
    """
    N, n = change.shape
    kept = min(count, n - (len(rows) > 0))
    places, values = np.empty((N, kept), np.int64), np.empty((N, kept), np.float64)
    usable = np.ones(n, np.bool_)
    for c in range(N):
        if len(rows):
            usable[rows[c]] = False
        indices = best(np.abs(change[c]), usable, kept)
        if len(rows):
            usable[rows[c]] = True
        for k in range(kept):
            places[c, k], values[c, k] = indices[k], change[c, indices[k]]
    return places, values


@compiled
def observed_pairs(triples, row, judged, classes, relations):
    """Return the pairs of objects with at least one observed relation, and their relations.

    A bit set contains the relations of a pair. Bit a stands for relation a from subject to object.
    Bit A + a stands for relation a from object to subject.

    Args:
        triples: (T, 3) observed relations, each as (relation, subject, object).
        row: (N,) index of each object's class among the n classes.
        judged: (N, N) bool, True for the ordered pairs of objects to judge. The result contains a
            pair if one of its two orders is True.
        classes: number n of classes in the scene.
        relations: number A of canonical relations.

    Returns:
        Four arrays (P,): subject, object, bit set of the relations between these two objects, and
        bit set of the relations between any two objects of their classes.
    """
    size = len(row)
    holds, of_classes = np.zeros((size, size), np.int64), np.zeros((classes, classes), np.int64)
    for t in range(len(triples)):
        a, x, y = triples[t, 0], triples[t, 1], triples[t, 2]
        holds[x, y] |= 1 << a
        holds[y, x] |= 1 << (relations + a)
        of_classes[row[x], row[y]] |= 1 << a
        of_classes[row[y], row[x]] |= 1 << (relations + a)
    columns = np.empty((4, min(len(triples), size * size)), np.int64)
    pairs, forward = 0, (1 << relations) - 1
    for x in range(size):
        for y in range(x + 1, size):
            if holds[x, y] and (judged[x, y] or judged[y, x]):
                # The subject of the pair is the subject of its observed relation with the lowest
                # number. n & -n is the lowest bit of n.
                from_x, from_y = holds[x, y] & forward, holds[y, x] & forward
                y_is_lower = from_y != 0 and (from_y & -from_y) < (from_x & -from_x)
                swapped = from_x == 0 or y_is_lower
                subject, object_ = (y, x) if swapped else (x, y)
                columns[0, pairs], columns[1, pairs] = subject, object_
                columns[2, pairs] = holds[subject, object_]
                columns[3, pairs] = of_classes[row[subject], row[object_]]
                pairs += 1
    return columns[0, :pairs], columns[1, :pairs], columns[2, :pairs], columns[3, :pairs]


@compiled
def disagreeing(slopes, forward, backward, log_counts, holds, of_classes, least, count):
    """Return the `count` pairs whose observed relations differ most from the expected relation.

    The expected relation of a pair is its likeliest relation. The observed probability is the
    probability of the likeliest observed relation. Pairs are ranked by the probability of the
    expected relation divided by the observed probability. The result contains a pair only if its
    expected relation is not observed between any two objects of its classes.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        forward: (A, P) log-odds of the relations from subject to object.
        backward: (A, P) log-odds of the relations from object to subject.
        log_counts: (P,) log of the number of object pairs with these two classes.
        holds, of_classes: (P,) bit sets of the relations of the pair and of its classes; see
            `observed_pairs`.
        least: minimum probability of an expected relation.
        count: maximum number k of pairs.

    Returns:
        Four arrays (k,): index of the pair, number of the expected relation, probability of the
        expected relation, and observed probability.
    """
    A, P = forward.shape
    to = relation_probability(slopes, forward.reshape(1, A, P), log_counts)[0]
    back = relation_probability(slopes, backward.reshape(1, A, P), log_counts)[0]
    expected, ratio = np.empty(P, np.int64), np.empty(P, np.float64)
    likely, usable = np.empty((2, P), np.float64), np.zeros(P, np.bool_)
    p = np.empty(2 * A, forward.dtype)
    for k in range(P):
        for a in range(A):
            p[a], p[A + a] = exclusive(to[a, k], back[a, k])
        top, observed = -1, np.float64(0.0)
        for name in range(2 * A):
            log_odds = forward[name, k] if name < A else backward[name - A, k]
            if log_odds > NO_UNIT and (top < 0 or p[name] > p[top]):
                top = name
            if holds[k] >> name & 1:
                observed = max(observed, np.float64(p[name]))
        if top >= 0 and not of_classes[k] >> top & 1 and p[top] > observed and p[top] >= least:
            usable[k], expected[k] = True, top
            likely[0, k], likely[1, k] = p[top], observed
            ratio[k] = likely[0, k] / observed
    indices = best(ratio, usable, count)
    return indices, expected[indices], likely[0][indices], likely[1][indices]


# ------------------------------------------------------ numbers of instances: questions/counts.py

INTERCEPT, SINGLE, SEVERAL, ROOM = 0, 1, 2, 3
"""Columns of `Counts.weights`: intercept, 1 if one object is listed, 1 if another class is listed
several times, and the first of C room types. The last V columns are those of the other classes."""


@compiled
def count_distributions(
    known, most, log_share, weights, classes, listed, room, first, log_unlisted
):
    """Return the classes and the distributions of `distribution`, (k,) and (k, M).

    Args:
        known, most, log_share, weights: see `Counts`. Column `first` of the weights is class 0.
        classes, listed: (n,) listed classes, and numbers of listed objects.
        room: index of the room type, or -1.
        log_unlisted: log ρ of the formula.
    """
    n, M = len(classes), log_share.shape[1]
    p, rows, k = np.empty((n, M), np.float64), np.empty(n, np.int64), 0
    exponents, several, entry = np.empty(2), 0, np.empty(n, np.int64)
    for i in range(n):
        several += listed[i] > 1
        entry[i] = _find(known, classes[i])
        if entry[i] >= 0 and listed[i] <= most[entry[i]]:
            rows[k] = i
            k += 1
    for row in range(k):
        e, number = entry[rows[row]], listed[rows[row]]
        for x in range(2):
            exponents[x] = 0.0
            # The effect of a class on itself is 0, so the sum over all listed classes is correct.
            for j in range(n):
                exponents[x] += weights[e, x, first + classes[j]]
            exponents[x] /= math.sqrt(max(n - 1, 1))
            exponents[x] += weights[e, x, INTERCEPT]
            if number == 1:
                exponents[x] += weights[e, x, SINGLE]
            if several > (number > 1):
                exponents[x] += weights[e, x, SEVERAL]
            if room >= 0:
                exponents[x] += weights[e, x, ROOM + room]
        largest, total = -np.inf, 0.0
        for m in range(number, M + 1):
            log = math.log(m)
            value = log_share[e, m - 1] + exponents[0] * log + (m - number) * log_unlisted
            p[row, m - 1] = value + exponents[1] * log * (math.log(M) - log)
            largest = max(largest, p[row, m - 1])
        for m in range(number, M + 1):
            p[row, m - 1] = math.exp(p[row, m - 1] - largest)
            total += p[row, m - 1]
        for m in range(M):
            p[row, m] = p[row, m] / total if m + 1 >= number else 0.0
    return rows[:k], p[:k]


# --------------------------------------------------------- offsets and counts of places: registry

UNOBSERVED: Final = -1
"""Number of scenes for a relation that never occurs in training, so that an offset is unknown."""
_PER_METRE: Final = 1000.0  # offsets are rounded to millimetres


@compiled
def look_up_offsets(tables, relation, subject, other):
    """See `Offsets.find`."""
    relation_offset, relation_scenes, subjects, objects, pair, pair_offset, pair_scenes = tables
    n, V = len(relation), subjects.shape[1]
    offset, scenes = np.empty((n, 6)), np.empty(n, np.int64)
    for k in range(n):
        a, i, j = relation[k], subject[k], other[k]
        key = (a * V + i) * V + j
        row = _find(pair, key)
        if row >= 0:
            for axis in range(6):
                offset[k, axis] = pair_offset[row, axis]
            scenes[k] = pair_scenes[row]
            continue
        scenes[k] = 0 if relation_scenes[a] > 0 else UNOBSERVED
        for axis in range(6):
            value = np.float64(relation_offset[a, axis])
            value = value + subjects[a, i, axis] + objects[a, j, axis]
            offset[k, axis] = value if axis < 3 else math.sqrt(value)
    return offset, scenes


@compiled
def rotated_offsets(tables, relation, missing, anchor, outgoing, axes, has_axes):
    """Return the offset from each of n anchors to its missing object, in metres.

    Args:
        tables: `Offsets.tables`.
        relation, missing, anchor: (n,) indices of the canonical relations, of the classes of the
            missing objects, and of the classes of the anchors.
        outgoing: (n,) bool, True if the missing object is the relation's subject.
        axes: (3, 3) float64, the viewer's axes in the frame of the offsets.
        has_axes: False if the viewing direction is unknown. The relations left and front then have
            no offset. The means of other offsets are then vertical.

    Returns:
        Mean (n, 3) and standard deviation (n, 3) along x, y and z. Then the number of training
        scenes that contain the two classes in this relation, (n,). It is `UNOBSERVED` for an
        unknown offset.
    """
    n = len(relation)
    subject, object_ = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        subject[k], object_[k] = missing[k], anchor[k]
        if not outgoing[k]:
            subject[k], object_[k] = anchor[k], missing[k]
    offset, scenes = look_up_offsets(tables, relation, subject, object_)
    mean, variance, std = np.zeros((n, 3)), np.zeros((n, 3)), np.empty((n, 3))
    for k in range(n):
        if has_axes:
            for axis in range(3):
                axis_mean, axis_variance = offset[k, axis], offset[k, 3 + axis] ** 2
                for to in range(3):
                    mean[k, to] += axes[axis, to] * axis_mean
                    variance[k, to] += axes[axis, to] ** 2 * axis_variance
        else:
            if relation[k] == LEFT or relation[k] == FRONT:
                scenes[k] = UNOBSERVED
            mean[k, 2], variance[k, 2] = offset[k, 2], offset[k, 5] ** 2
            # Any horizontal direction is equally likely, so x and y share E[x²] + E[y²] equally.
            for axis in range(2):
                half = (offset[k, axis] ** 2 + offset[k, 3 + axis] ** 2) / 2
                variance[k, 0] += half
                variance[k, 1] += half
        for axis in range(3):
            value = mean[k, axis] if outgoing[k] else -mean[k, axis]
            # Adding 0.0 turns -0.0 into 0.0.
            mean[k, axis] = np.rint(value * _PER_METRE) / _PER_METRE + 0.0
            millimetres = np.rint(math.sqrt(variance[k, axis]) * _PER_METRE)
            std[k, axis] = max(millimetres, 1.0) / _PER_METRE
    return mean, std, scenes


@compiled
def add_unseen(shown, change, candidates, classes, forward, backward):
    """Add the changes of stacked relations that training never shows to log-odds, in place.

    Args:
        shown: (V, V) stacked relations of two classes that training shows. Bit a is relation a.
        change: (3, V) change for each subject class.
        candidates, classes: (N,) and (m,) classes.
        forward, backward: (N, A, m) log-odds with the candidate and with the other class as
            subject. The last A - 2 relations are the stacked ones.
    """
    for c in range(len(candidates)):
        for a in range(forward.shape[1] - ON_TOP):
            for k in range(len(classes)):
                i, j = candidates[c], classes[k]
                if not shown[i, j] >> a & 1:
                    forward[c, ON_TOP + a, k] += change[a, i]
                if not shown[j, i] >> a & 1:
                    backward[c, ON_TOP + a, k] += change[a, j]


@compiled
def triple_counts(triple, held, V, relation, subject, other):
    """Return the counts of the triples (relation, subject, other), (N, M); 0 without an entry."""
    counts = np.zeros((len(subject), len(other)))
    for i in range(len(subject)):
        for j in range(len(other)):
            row = _find(triple, (relation * V + subject[i]) * V + other[j])
            if row >= 0:
                counts[i, j] = held[row]
    return counts


# ------------------------------------------------------------ drawn scenes: questions/generate.py

# Direction of each relation: 1 for left, 2 for front, and 0 (up) for on-top, above and inside.
# Their subjects are higher than their objects, or in their objects.
_DIRECTION: Final = np.array([1, 2, 0, 0, 0])


@compiled
def select_consistent(relation, ends, order, fixed, count):
    """Select relations that contradict neither the evidence nor each other, as a bool mask (m,).

    Args:
        relation: (fixed + m,) canonical relations. The relations of the evidence come first.
        ends: (fixed + m, 2) indices of the subject and object classes, from 0 to count - 1.
        order: indices from 0 to m - 1 of the drawn relations to try, likeliest first.
        fixed: number of relations in the evidence.
        count: number of classes.
    """
    # reaches[d, x, y] is True if relations of direction d lead from x to y, directly or through
    # other classes.
    reaches = np.zeros((3, count, count), np.bool_)
    related, supported = np.zeros((count, count), np.bool_), np.zeros(count, np.bool_)
    stay = np.zeros(len(relation) - fixed, np.bool_)
    for turn in range(fixed + len(order)):
        e = turn if turn < fixed else fixed + order[turn - fixed]
        x, y, reached = ends[e, 0], ends[e, 1], reaches[_DIRECTION[relation[e]]]
        on_top = relation[e] == ON_TOP
        if turn >= fixed:
            if reached[y, x] or related[x, y] or (on_top and supported[x]):
                continue
            stay[e - fixed] = True
        related[x, y] = related[y, x] = True
        supported[x] |= on_top
        # Each class that leads to x now also leads to y and to all classes after y.
        for k in range(count):
            if k == x or reached[k, x]:
                reached[k] |= reached[y]
                reached[k, y] = True
    return stay


# -------------------------------------------------------------------- digits: questions/answer.py

DIGITS: Final = 6
"""Significant digits of probabilities, log-odds and metres."""
# Doubles represent these powers of ten exactly. So an integer divided by such a power is the double
# that is nearest to the decimal number.
_POWERS: Final = np.array([10.0**power for power in range(23)])


@compiled
def round_to_digits(values):
    """Round float64 numbers (n,) to `DIGITS` significant digits in place.

    Returns:
        False if a number is too small or too large for exact powers of ten. Such numbers stay
        unchanged.
    """
    exact = True
    for k in range(len(values)):
        size = np.abs(values[k])
        if 1e-16 < size < 1e5:
            # A number with d digits before the point keeps DIGITS - d decimal places.
            places = DIGITS - 1 - np.int64(np.floor(np.log10(size)))
            scale = _POWERS[places]
            values[k] = np.rint(values[k] * scale) / scale
        elif size != 0.0:
            exact = False
    return exact
