"""Compiled loops for relations that are given: what they say of the context, and of each other.

Formulas in `closed_form` and `implications`. Given units are lists (E,): relation a, places i and j
of their classes in the scene, value r (0 or 1) and gate g, the presence of both ends.
"""

from __future__ import annotations

import numpy as np

from app.boltzmann.elementary import logistic
from app.boltzmann.relation_kernels import means, residual, to_log_odds
from app.compiling import compiled, compiled_in_any_order

_DAMPING = np.float32(0.8)
_MOST = np.float32(3.0)


@compiled_in_any_order
def _units(w, classes, log_counts, a, i, j):
    """z_e = S_i * O_j, (E, K), and what of ℓ_e does not depend on h1, (E,)."""
    E, K = len(a), w.S.shape[1]
    z, base = np.empty((E, K), np.float32), np.empty(E, np.float32)
    for e in range(E):
        b, s, o = a[e], classes[i[e]], classes[j[e]]
        S, O, R, row = w.S[s], w.O[o], w.R[b], z[e]  # noqa: E741
        total = w.d[b] + w.s[b, s] + w.n[b, 0] * log_counts[i[e]]
        total += w.o[b, o] + w.n[b, 1] * log_counts[j[e]] + residual(w, b, s, o)
        for k in range(K):
            row[k] = S[k] * O[k]
        for k in range(K):
            total += row[k] * R[k]
        base[e] = total
    return z, base


@compiled_in_any_order
def _mean_logits(mean, w, a, z, base, out):
    A, K, H1 = w.M.shape
    shared, bias = np.empty((A, K), np.float32), np.empty(A, np.float32)
    for b in range(A):
        M, P, total = w.M[b], w.P[b], np.float32(0.0)
        for h in range(H1):
            total += P[h] * mean[h]
        bias[b] = total
        for k in range(K):
            row, total = M[k], np.float32(0.0)
            for h in range(H1):
                total += row[h] * mean[h]
            shared[b, k] = total
    for e in range(len(a)):
        row, through, total = z[e], shared[a[e]], base[e] + bias[a[e]]
        for k in range(K):
            total += row[k] * through[k]
        out[e] = total


@compiled_in_any_order
def _pull(w, a, z, weight, out):
    """sum_e weight_e U_e into out (H1,)."""
    A, K, H1 = w.M.shape
    factors, count = np.zeros((A, K), np.float32), np.zeros(A, np.float32)
    for e in range(len(a)):
        row, into, value = z[e], factors[a[e]], weight[e]
        if value != 0.0:
            count[a[e]] += value
            for k in range(K):
                into[k] += value * row[k]
    for h in range(H1):
        out[h] = np.float32(0.0)
    for b in range(A):
        if count[b] != 0.0 or np.any(factors[b]):
            M, P, into, value = w.M[b], w.P[b], factors[b], count[b]
            for h in range(H1):
                out[h] += value * P[h]
            for k in range(K):
                row, value = M[k], into[k]
                for h in range(H1):
                    out[h] += value * row[h]


@compiled
def fixed_point(x, w, classes, log_counts, a, i, j, r, g, sweeps):
    """The mean field given relations: logits of h1 (H1,), and the slopes (E,) at its end."""
    E = len(a)
    z, base = _units(w, classes, log_counts, a, i, j)
    y, pull = x.copy(), np.empty(len(x), np.float32)
    logits, slopes = np.empty(E, np.float32), np.zeros(E, np.float32)
    for sweep in range(sweeps):
        _mean_logits(means(y), w, a, z, base, logits)
        kept = _DAMPING if sweep else np.float32(0.0)
        for e in range(E):
            slope = g[e] * (r[e] - logistic(logits[e]))
            slopes[e] = kept * slopes[e] + (np.float32(1.0) - kept) * slope
        _pull(w, a, z, slopes, pull)
        for h in range(len(x)):
            y[h] = x[h] + pull[h]
    return y, slopes


@compiled_in_any_order
def _own_row(w, b, z, out):
    """U_e into out (H1,)."""
    K, H1 = w.M.shape[1:]
    P, M = w.P[b], w.M[b]
    for h in range(H1):
        out[h] = P[h]
    for k in range(K):
        row, value = M[k], z[k]
        for h in range(H1):
            out[h] += value * row[h]


@compiled_in_any_order
def _normal_logit(mean, U, base):
    total, variance = base, np.float32(0.0)
    for h in range(len(U)):
        total += U[h] * mean[h]
        variance += U[h] * U[h] * (mean[h] * (np.float32(1.0) - mean[h]))
    return total, np.sqrt(np.float32(3.0) * variance)


@compiled
def without_itself(y, w, classes, log_counts, a, i, j, slopes, shift):
    """Log-odds of each given unit, its own slope taken out of y, (E,); shift (A, n, n)."""
    E, H1 = len(a), len(y)
    z, base = _units(w, classes, log_counts, a, i, j)
    U, rest = np.empty(H1, np.float32), np.empty(H1, np.float32)
    found, spreads = np.empty(E, np.float32), np.empty(E, np.float32)
    for e in range(E):
        _own_row(w, a[e], z[e], U)
        slope = slopes[e]
        for h in range(H1):
            rest[h] = y[h] - slope * U[h]
        mean, spreads[e] = _normal_logit(means(rest), U, base[e])
        found[e] = mean + shift[a[e], i[e], j[e]]
    to_log_odds(found, spreads)
    return found


@compiled
def shares(w, classes, log_counts, a, i, j, slopes):
    """What the relations of each class add to y, (n, H1)."""
    n, E = len(classes), len(a)
    z, _ = _units(w, classes, log_counts, a, i, j)
    found, weight = np.empty((n, w.M.shape[2]), np.float32), np.empty(E, np.float32)
    for c in range(n):
        for e in range(E):
            weight[e] = slopes[e] if i[e] == c or j[e] == c else np.float32(0.0)
        _pull(w, a, z, weight, found[c])
    return found


@compiled
def common_shares(w, classes, log_counts, a, i, j, slopes, rows):
    """What the relations between two classes add to y, (N, n, H1) for the classes in rows (N,)."""
    n, H1 = len(classes), w.M.shape[2]
    z, _ = _units(w, classes, log_counts, a, i, j)
    found, U = np.zeros((len(rows), n, H1), np.float32), np.empty(H1, np.float32)
    place = np.full(n, -1)
    for c in range(len(rows)):
        place[rows[c]] = c
    for e in range(len(a)):
        one, other, slope = i[e], j[e], slopes[e]
        if one != other and (place[one] >= 0 or place[other] >= 0):
            _own_row(w, a[e], z[e], U)
            if place[one] >= 0:
                into = found[place[one], other]
                for h in range(H1):
                    into[h] += slope * U[h]
            if place[other] >= 0:
                into = found[place[other], one]
                for h in range(H1):
                    into[h] += slope * U[h]
    return found


@compiled
def implied(gamma, z, n, a, i, j, r):
    """What the given relations that hold imply for all others, (A, n, n); see `implications`.

    Args:
        gamma: (1 + G, A, F).
        z: (1 + G,) 1 and what the context says of how strictly the rules hold.
        n: classes of the scene.
    """
    A = gamma.shape[1]
    steps = 2 * A
    weight = np.zeros(gamma.shape[1:], np.float32)
    for q in range(len(z)):
        for b in range(A):
            for f in range(gamma.shape[2]):
                weight[b, f] += z[q] * gamma[q, b, f]
    for b in range(A):
        weight[b, b] = np.float32(0.0)
    both = np.zeros((steps, n, n), np.bool_)
    for e in range(len(a)):
        if r[e] > 0 and i[e] != j[e]:
            both[a[e], i[e], j[e]] = True
            both[A + a[e], j[e], i[e]] = True
    shift = np.zeros((A, n, n), np.float32)
    outgoing, incoming = both.sum(2), both.sum(1)
    first = steps + steps * steps
    for c in range(steps):
        for x in range(n):
            for y in range(n):
                held = both[c, x, y]
                out = min(np.float32(outgoing[c, x] - held), _MOST)
                into = min(np.float32(incoming[c, y] - held), _MOST)
                for b in range(A):
                    if held:
                        shift[b, x, y] += weight[b, c]
                    shift[b, x, y] += weight[b, first + c] * out
                    shift[b, x, y] += weight[b, first + steps + c] * into
    seen = np.zeros((n, n), np.bool_)
    for c in range(steps):
        for d in range(steps):
            seen[:] = False
            feature = steps + c * steps + d
            for x in range(n):
                for k in range(n):
                    if both[c, x, k]:
                        for y in range(n):
                            if both[d, k, y]:
                                seen[x, y] = True
                for y in range(n):
                    if seen[x, y]:
                        for b in range(A):
                            shift[b, x, y] += weight[b, feature]
    return shift
