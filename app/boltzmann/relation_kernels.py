"""Compiled loops of the relation part: log-odds of units whose logits are normal.

Formulas in `closed_form`. Units go from subject classes (n,) to object classes (m,), in that order.
"""

from __future__ import annotations

import numpy as np

from app.boltzmann.elementary import exp, log, logistic
from app.compiling import compiled, compiled_in_any_order, inlined

NO_UNIT = np.float32(-30.0)
"""No log-odds of a relation is below."""

_ROOT_3 = np.float32(3.0**0.5)
# Where three nodes are enough, as √3 σ.
_NARROW = np.float32(0.75 * 3.0**0.5)


@inlined
def _dot(a, b):
    total = np.float32(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled_in_any_order
def _moments(mean, w, first, last):
    """What all units of relations first to last - 1 share: R + M m, d + P·m, and C."""
    A, K, H1 = w.M.shape
    r = w.F.shape[1]
    shared, bias = np.empty((A, K), np.float32), np.empty(A, np.float32)
    C, spread = np.empty((A, r, r), np.float32), np.empty(H1, np.float32)
    for a in range(first, last):
        M_a, F_a = w.M[a], w.F[a]
        for k in range(K):
            shared[a, k] = w.R[a, k] + _dot(M_a[k], mean)
        bias[a] = w.d[a] + _dot(w.P[a], mean)
        for p in range(r):
            row = F_a[p]
            for h in range(H1):
                spread[h] = row[h] * (mean[h] * (np.float32(1.0) - mean[h]))
            for q in range(p + 1):
                C[a, p, q] = _dot(spread, F_a[q])
    return shared, bias, C


@inlined
def residual(w, a, i, j):
    """w' of (a, i, j), 0 where there is none."""
    row = a * len(w.S) + i
    low, high = w.start[row], w.start[row + 1]
    while low < high:
        middle = (low + high) // 2
        if w.column[middle] < j:
            low = middle + 1
        else:
            high = middle
    if low < w.start[row + 1] and w.column[low] == j:
        return w.residual[low]
    return np.float32(0.0)


@inlined
def _log_odds(mean, spread):
    """log-odds of E[sigmoid(ℓ)] for a normal ℓ, by three nodes: 0 and ±√3 σ with weights 4 : 1 : 1.

    Off by .0003 at most in p where √3 σ < `_NARROW`.
    """
    on = np.float32(4.0) * logistic(mean) + logistic(mean + spread) + logistic(mean - spread)
    off = np.float32(4.0) * logistic(-mean) + logistic(-mean - spread) + logistic(spread - mean)
    return log(on) - log(off)


@compiled
def _log_odds_of_wide(mean, spread):
    """The same by the trapezoidal rule, for any σ up to 10 and more."""
    on, off = np.float32(0.0), np.float32(0.0)
    for node in range(-20, 21):
        t = np.float32(0.25) * np.float32(node)
        weight = exp(np.float32(-0.5) * t * t)
        logit = mean + t * spread / _ROOT_3
        on += weight * logistic(logit)
        off += weight * logistic(-logit)
    return log(on) - log(off)


@compiled_in_any_order
def _normal(moments, w, first, subjects, log_subjects, objects, log_objects, mean, spread):
    """Mean and √3 σ of the logits of all units from subjects to objects, (relations, n, m)."""
    shared, bias, C = moments
    K, r = shared.shape[1], C.shape[1]
    z, y = np.empty(K, np.float32), np.empty(r, np.float32)
    # Rows by name: an index that may be negative keeps the compiler from taking eight at a time.
    for a in range(first, first + len(mean)):
        shared_a, C_a, Y_a, Y0_a = shared[a], C[a], w.Y[a], w.Y0[a]
        for i in range(len(subjects)):
            subject = subjects[i]
            S_i = w.S[subject]
            base = bias[a] + w.s[a, subject] + w.n[a, 0] * log_subjects[i]
            for j in range(len(objects)):
                other = objects[j]
                total = base + w.o[a, other] + w.n[a, 1] * log_objects[j]
                total += residual(w, a, subject, other)
                dot = np.float32(0.0)
                O_j = w.O[other]
                for k in range(K):
                    z[k] = S_i[k] * O_j[k]
                for k in range(K):
                    dot += z[k] * shared_a[k]
                mean[a - first, i, j] = total + dot
                variance = np.float32(0.0)
                for p in range(r):
                    dot, row = Y0_a[p], Y_a[p]
                    for k in range(K):
                        dot += z[k] * row[k]
                    y[p] = dot
                    cross = np.float32(0.0)
                    for q in range(p):
                        cross += C_a[p, q] * y[q]
                    variance += dot * (np.float32(2.0) * cross + C_a[p, p] * dot)
                spread[a - first, i, j] = np.sqrt(np.float32(3.0) * max(variance, np.float32(0.0)))


@compiled
def to_log_odds(means, spreads):
    """Log-odds of E[sigmoid] in place of the means (E,) of logits, for their √3 σ."""
    # All of them without a branch, many at a time; then the few wide ones again.
    narrow = np.empty(len(means), np.float32)
    for e in range(len(means)):
        narrow[e] = _log_odds(means[e], spreads[e])
    for e in range(len(means)):
        if spreads[e] >= _NARROW:
            narrow[e] = _log_odds_of_wide(means[e], spreads[e])
    for e in range(len(means)):
        means[e] = max(narrow[e], NO_UNIT)


@compiled
def _fill(moments, w, first, subjects, log_subjects, objects, log_objects, out):
    """Log-odds of all units from subjects to objects into out (relations, n, m)."""
    spread = np.empty(out.shape, np.float32)
    _normal(moments, w, first, subjects, log_subjects, objects, log_objects, out, spread)
    to_log_odds(out.reshape(-1), spread.reshape(-1))


@inlined
def means(x):
    """sigmoid(x)."""
    mean = np.empty(len(x), np.float32)
    for k in range(len(x)):
        mean[k] = logistic(x[k])
    return mean


@compiled
def relation_log_odds(x, w, classes, log_counts, shift):
    """Log-odds of E[sigmoid(ℓ_e + shift_e)] between the classes of a scene, (A, n, n)."""
    n = len(classes)
    mean, spread = np.empty((len(w.d), n, n), np.float32), np.empty((len(w.d), n, n), np.float32)
    moments = _moments(means(x), w, 0, len(w.d))
    _normal(moments, w, 0, classes, log_counts, classes, log_counts, mean, spread)
    logits, shifts = mean.reshape(-1), shift.reshape(-1)
    for e in range(len(shifts)):
        logits[e] += shifts[e]
    to_log_odds(mean.reshape(-1), spread.reshape(-1))
    return mean


@compiled
def placement_log_odds(x, W, w, candidates, anchors, log_counts):
    """Relations of absent candidates to anchors and back, (N, A, m) both, were they there."""
    A, m = len(w.d), len(anchors)
    forward = np.empty((len(candidates), A, 1, m), np.float32)
    backward = np.empty((len(candidates), A, m, 1), np.float32)
    one = np.zeros(1, np.float32)
    for c in range(len(candidates)):
        # p(h1 | v and the candidate): as factorial as without it.
        moments = _moments(means(x + W[candidates[c]]), w, 0, A)
        candidate = candidates[c : c + 1]
        _fill(moments, w, 0, candidate, one, anchors, log_counts, forward[c])
        _fill(moments, w, 0, anchors, log_counts, candidate, one, backward[c])
    return forward[:, :, 0], backward[:, :, :, 0]


@compiled
def placed_log_odds(x, W, w, candidates, anchor, relation, one, log_count, outgoing):
    """One relation of absent candidates to one anchor, or back, (N,)."""
    out, unit = np.empty(len(candidates), np.float32), np.empty((1, 1, 1), np.float32)
    for c in range(len(candidates)):
        moments = _moments(means(x + W[candidates[c]]), w, relation, relation + 1)
        candidate = candidates[c : c + 1]
        if outgoing:
            _fill(moments, w, relation, candidate, one, anchor, log_count, unit)
        else:
            _fill(moments, w, relation, anchor, log_count, candidate, one, unit)
        out[c] = unit[0, 0, 0]
    return out
