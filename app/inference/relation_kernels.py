"""Compiled loops of the relation part: log-odds of units whose logits are normal.

Formulas in `closed_form`. A pair is a subject class and an object class; it has one unit a
relation. Inner loops run over a fixed number of pairs, or over four rows of weights at a time, so
that the compiler keeps vector registers full however small a scene is.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled, compiled_in_any_order, inlined
from app.inference.elementary import exp, log, logistic
from app.inference.matrix_kernels import ROWS, add_products

NO_UNIT = np.float32(-30.0)
"""No log-odds of a relation is below."""

SPREAD, SHIFT = 2654435761, 16
"""A pair's key times the first, shifted by the second, is the number of its bucket."""

_PAIRS = 32
_CANDIDATES = 16

_ROOT_3 = np.float32(3.0**0.5)
# Where three nodes are enough, as √3 σ.
_NARROW = np.float32(0.75 * 3.0**0.5)
# The trapezoidal rule beyond: positive nodes, in units of σ, and their weights against that of 0.
_STEP = np.float32(0.25)
_TAIL = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


@compiled
def set_means(x, out):
    """sigmoid(x) into out."""
    for k in range(len(x)):
        out[k] = logistic(x[k])


@compiled
def means(x):
    """sigmoid(x)."""
    mean = np.empty(len(x), np.float32)
    set_means(x, mean)
    return mean


@compiled_in_any_order
def _moments(mean, w, first, last):
    """Of relations first to last - 1, in N contexts with means (N, H1): (R, d) + G m, and C."""
    N = len(mean)
    through = np.empty((N, *w.g.shape), np.float32)
    C = np.zeros((N, *w.FF.shape[:2]), np.float32)
    spread = np.empty(mean.shape, np.float32)
    for n in range(N):
        for h in range(mean.shape[1]):
            spread[n, h] = mean[n, h] * (np.float32(1.0) - mean[n, h])
    for a in range(first, last):
        for n in range(N):
            through[n, a] = w.g[a]
        add_products(w.G[a], mean, through[:, a])
        add_products(w.FF[a], spread, C[:, a])
    return through, C


@compiled
def residual_row(start, keys, pair):
    """Which row of w' is that of a pair; the last, of zeros, where it has none."""
    # A search by halves costs more: nobody can guess its branches.
    bucket = (pair * SPREAD >> SHIFT) & (len(start) - 2)
    for row in range(start[bucket], start[bucket + 1]):
        if keys[row] == pair:
            return row
    return len(keys)


@inlined
def _log_odds(mean, spread):
    """log-odds of E[sigmoid(ℓ)] for a normal ℓ, by three nodes: 0 and ±√3 σ with weights 4 : 1 : 1.

    Off by .0003 at most in p where √3 σ < `_NARROW`. With u = e^-|mean| and q = e^spread the nodes
    are u/(1 + u), uq/(1 + uq) and u/(q + u), and nothing can overflow.
    """
    u, q = exp(-abs(mean)), exp(spread)
    a, b, c = np.float32(1.0) + u, np.float32(1.0) + u * q, q + u
    on = np.float32(4.0) * b * c + a * (q * c + b)
    off = np.float32(4.0) * b * c + a * (c + q * b)
    away = abs(mean) - log(on / off)
    return away if mean >= np.float32(0.0) else -away


@compiled
def _wide_log_odds(mean, spread, out):
    """The same of many (E,), by the trapezoidal rule: for any σ up to 10 and more."""
    E = len(mean)
    u, step, q = np.empty(E, np.float32), np.empty(E, np.float32), np.empty(E, np.float32)
    on, off = np.empty(E, np.float32), np.empty(E, np.float32)
    for e in range(E):
        u[e] = exp(-abs(mean[e]))
        step[e] = exp(_STEP / _ROOT_3 * spread[e])
        q[e] = np.float32(1.0)
        on[e] = off[e] = np.float32(1.0) / (np.float32(1.0) + u[e])
    for node in range(len(_TAIL)):
        weight = _TAIL[node]
        for e in range(E):
            q[e] = min(q[e] * step[e], np.float32(1e30))
            up = np.float32(1.0) / (np.float32(1.0) + u[e] * q[e])
            down = np.float32(1.0) / (q[e] + u[e])
            on[e] += weight * (q[e] * up + down)
            off[e] += weight * (up + q[e] * down)
    for e in range(E):
        away = abs(mean[e]) - log(on[e] / off[e])
        out[e] = away if mean[e] >= np.float32(0.0) else -away


@compiled
def to_log_odds(means, spreads):
    """Log-odds of E[sigmoid] in place of the means (E,) of logits, for their √3 σ."""
    # All of them without a branch, many at a time; then the few wide ones again.
    wide = 0
    for e in range(len(means)):
        wide += spreads[e] >= _NARROW
    where = np.empty(wide, np.int64)
    some, some_spreads = np.empty(wide, np.float32), np.empty(wide, np.float32)
    if wide:
        wide = 0
        for e in range(len(means)):
            if spreads[e] >= _NARROW:
                where[wide], some[wide], some_spreads[wide] = e, means[e], spreads[e]
                wide += 1
        _wide_log_odds(some, some_spreads, some)
    for e in range(len(means)):
        means[e] = max(_log_odds(means[e], spreads[e]), NO_UNIT)
    for k in range(wide):
        means[where[k]] = max(some[k], NO_UNIT)


@compiled_in_any_order
def _rows(through, C, w, first, last):
    """Mean and coordinates of a logit as rows (A, 1 + r, K) on S_i * O_j and constants (A, 1 + r).

    With C = L L' the variance q'C q is |L'q|²: the coordinates are L'q.
    """
    A, r, K = len(w.g), w.Y.shape[1], w.Y.shape[2]
    R = -(-(1 + r) // ROWS) * ROWS
    rows, constants = np.zeros((A, R, K), np.float32), np.zeros((A, R), np.float32)
    L = np.zeros((r, r), np.float32)
    for a in range(first, last):
        t = 0
        for p in range(r):
            for q in range(p + 1):
                total = C[a, t]
                for k in range(q):
                    total -= L[p, k] * L[q, k]
                # Directions that nothing varies in have no root to divide by.
                if p == q:
                    L[p, p] = np.sqrt(max(total, np.float32(0.0)))
                else:
                    L[p, q] = total / L[q, q] if L[q, q] > 0.0 else np.float32(0.0)
                t += 1
        through_a, rows_a, Y_a = through[a], rows[a], w.Y[a]
        constants[a, 0] = through_a[K]
        for k in range(K):
            rows_a[0, k] = through_a[k]
        for p in range(r):
            for q in range(p + 1):
                weight, row, into = L[p, q], Y_a[p], rows_a[1 + q]
                constants[a, 1 + q] += weight * w.Y0[a, p]
                for k in range(K):
                    into[k] += weight * row[k]
    return rows, constants


@compiled_in_any_order
def _normal(functions, w, subjects, log_subjects, objects, log_objects, mean, spread):
    """Mean and √3 σ of the logits of all units of pairs (E,), into (A, E up to whole blocks)."""
    rows, constants = functions
    A, R, K = rows.shape
    # By name: to take an array from the tuple again and again is to count references to it.
    S, O, s, o, n = w.S, w.O, w.s, w.o, w.n  # noqa: E741
    start_of, keys, residual, r, V = w.start, w.key, w.residual, w.Y.shape[1], len(w.S)
    z, base = np.zeros((_PAIRS, K), np.float32), np.zeros((A, _PAIRS), np.float32)
    y = np.empty((R, _PAIRS), np.float32)
    for start in range(0, len(subjects), _PAIRS):
        for e in range(min(_PAIRS, len(subjects) - start)):
            i, j = subjects[start + e], objects[start + e]
            log_i, log_j = log_subjects[start + e], log_objects[start + e]
            S_i, O_j, z_e = S[i], O[j], z[e]
            for k in range(K):
                z_e[k] = S_i[k] * O_j[k]
            own = residual_row(start_of, keys, i * V + j)
            for a in range(A):
                total = s[i, a] + n[a, 0] * log_i + o[j, a] + n[a, 1] * log_j
                base[a, e] = total + residual[own, a]
        for a in range(A):
            for p in range(1 + r):
                y_p, constant = y[p], constants[a, p]
                for e in range(_PAIRS):
                    y_p[e] = constant
            add_products(rows[a], z, y.T)
            base_a, y_0 = base[a], y[0]
            into, variance = mean[a, start : start + _PAIRS], spread[a, start : start + _PAIRS]
            for e in range(_PAIRS):
                into[e] = base_a[e] + y_0[e]
                variance[e] = np.float32(0.0)
            for p in range(r):
                y_p = y[1 + p]
                for e in range(_PAIRS):
                    variance[e] += y_p[e] * y_p[e]
            for e in range(_PAIRS):
                variance[e] = np.sqrt(np.float32(3.0) * variance[e])


@inlined
def _whole_blocks(pairs):
    return -(-pairs // _PAIRS) * _PAIRS


@compiled
def relation_log_odds(y, w, classes, log_counts, slopes, shift):
    """Log-odds of E[sigmoid(ℓ_e + shift_e)] between the classes of a scene, (A, n, n).

    Args:
        slopes: (A, n, n) or empty; what a unit itself adds to y is taken out to first order,
            ℓ_e(m) changing by slope σ_e².
        shift: (A, n, n) or empty.
    """
    A, n = len(w.g), len(classes)
    subjects, objects = np.empty(n * n, np.int64), np.empty(n * n, np.int64)
    log_subjects, log_objects = np.empty(n * n, np.float32), np.empty(n * n, np.float32)
    for i in range(n):
        for j in range(n):
            e = i * n + j
            subjects[e], objects[e] = classes[i], classes[j]
            log_subjects[e], log_objects[e] = log_counts[i], log_counts[j]
    size = _whole_blocks(n * n)
    mean, spread = np.zeros((A, size), np.float32), np.empty((A, size), np.float32)
    through, C = _moments(means(y).reshape(1, -1), w, 0, A)
    functions = _rows(through[0], C[0], w, 0, A)
    _normal(functions, w, subjects, log_subjects, objects, log_objects, mean, spread)
    if len(slopes):
        own = slopes.reshape(A, -1)
        for a in range(A):
            for e in range(n * n):
                mean[a, e] -= own[a, e] * spread[a, e] * spread[a, e] / np.float32(3.0)
    if len(shift):
        shifts = shift.reshape(A, -1)
        for a in range(A):
            for e in range(n * n):
                mean[a, e] += shifts[a, e]
    to_log_odds(mean.reshape(-1), spread.reshape(-1))
    return mean[:, : n * n].copy().reshape(A, n, n)


@compiled
def log_odds_apart(y, w, F, classes, log_counts, slopes, shift, i, j):
    """All relations between two classes, without anything given of the two, (2, A, P).

    What is given of a pair is taken out of y to first order: ℓ_e(m) changes by

        sum_e' slope_e' cov(ℓ_e, ℓ_e'),   cov = sum_k U_ek U_e'k m_k (1 - m_k)

    over the units e' of the pair, both ways.

    Args:
        F: (A r up to whole rows, H1) the directions of all relations.
        slopes: (A, n, n) or empty.
        shift: (A, n, n) or empty, what other pairs imply.
        i, j: (P,) places of the classes; the relations from i to j come first.
    """
    A, P = len(w.g), len(i)
    subjects, objects = np.empty(2 * P, np.int64), np.empty(2 * P, np.int64)
    log_subjects, log_objects = np.empty(2 * P, np.float32), np.empty(2 * P, np.float32)
    for p in range(P):
        for way in range(2):
            one, other = (i[p], j[p]) if way == 0 else (j[p], i[p])
            e = way * P + p
            subjects[e], objects[e] = classes[one], classes[other]
            log_subjects[e], log_objects[e] = log_counts[one], log_counts[other]
    size = _whole_blocks(2 * P)
    mean, spread = np.zeros((A, size), np.float32), np.empty((A, size), np.float32)
    on = means(y)
    through, C = _moments(on.reshape(1, -1), w, 0, A)
    functions = _rows(through[0], C[0], w, 0, A)
    _normal(functions, w, subjects, log_subjects, objects, log_objects, mean, spread)
    if len(slopes):
        own = np.empty((P, 2, A), np.float32)
        for p in range(P):
            for a in range(A):
                own[p, 0, a] = slopes[a, i[p], j[p]]
                # Of a class with itself the two ways are one.
                own[p, 1, a] = slopes[a, j[p], i[p]] if i[p] != j[p] else np.float32(0.0)
        _take_out(_covariances(F, on), w, subjects, objects, own, mean)
    if len(shift):
        for a in range(A):
            for p in range(P):
                mean[a, p] += shift[a, i[p], j[p]]
                mean[a, P + p] += shift[a, j[p], i[p]]
    to_log_odds(mean.reshape(-1), spread.reshape(-1))
    found = np.empty((2, A, P), np.float32)
    for way in range(2):
        for a in range(A):
            for p in range(P):
                found[way, a, p] = mean[a, way * P + p]
    return found


@compiled_in_any_order
def _covariances(F, mean):
    """F diag(m (1 - m)) F'."""
    spread = np.empty(F.shape, np.float32)
    for q in range(len(F)):
        row, into = F[q], spread[q]
        for h in range(len(mean)):
            into[h] = row[h] * (mean[h] * (np.float32(1.0) - mean[h]))
    found = np.zeros((len(F), len(F)), np.float32)
    add_products(F, spread, found)
    return found


@compiled_in_any_order
def _take_out(covariances, w, subjects, objects, slopes, mean):
    """mean (A, 2P) -= what the units of each pair add to each other, for their slopes (P, 2, A)."""
    S, O, Y0, Y = w.S, w.O, w.Y0, w.Y  # noqa: E741
    (A, r, K), P = Y.shape, len(slopes)
    z, q = np.empty(K, np.float32), np.empty((2, A * r), np.float32)
    pull, back = np.empty(A * r, np.float32), np.empty(A * r, np.float32)
    for p in range(P):
        pull[:] = np.float32(0.0)
        for way in range(2):
            e, q_way = way * P + p, q[way]
            S_i, O_j = S[subjects[e]], O[objects[e]]
            for k in range(K):
                z[k] = S_i[k] * O_j[k]
            for a in range(A):
                slope = slopes[p, way, a]
                for t in range(r):
                    row, total = Y[a, t], Y0[a, t]
                    for k in range(K):
                        total += row[k] * z[k]
                    q_way[a * r + t] = total
                    pull[a * r + t] += slope * total
        for s in range(A * r):
            row, total = covariances[s], np.float32(0.0)
            for t in range(A * r):
                total += row[t] * pull[t]
            back[s] = total
        for way in range(2):
            for a in range(A):
                total = np.float32(0.0)
                for t in range(r):
                    total += q[way, a * r + t] * back[a * r + t]
                mean[a, way * P + p] -= total


@compiled
def placement_log_odds(y, W, w, candidates, anchors, log_counts):
    """Relations of absent candidates to anchors and back, (N, A, m) both, were they there."""
    A, N, m = len(w.g), len(candidates), len(anchors)
    found = np.empty((2, N, A, m), np.float32)
    subjects, objects = np.empty(2 * m, np.int64), np.empty(2 * m, np.int64)
    log_subjects, log_objects = np.zeros(2 * m, np.float32), np.zeros(2 * m, np.float32)
    log_objects[:m] = log_counts
    log_subjects[m:] = log_counts
    size = _whole_blocks(2 * m)
    mean, spread = np.zeros((A, size), np.float32), np.empty((A, size), np.float32)
    for start in range(0, N, _CANDIDATES):
        some = candidates[start : start + _CANDIDATES]
        through, C = _moments(_means_with(y, W, some), w, 0, A)
        for c in range(len(some)):
            subjects[:m], objects[:m] = some[c], anchors
            subjects[m:], objects[m:] = anchors, some[c]
            functions = _rows(through[c], C[c], w, 0, A)
            _normal(functions, w, subjects, log_subjects, objects, log_objects, mean, spread)
            to_log_odds(mean.reshape(-1), spread.reshape(-1))
            found[0, start + c] = mean[:, :m]
            found[1, start + c] = mean[:, m : 2 * m]
    return found[0], found[1]


@compiled
def _means_with(y, W, candidates):
    """Means of h1 once each candidate is there, (N, H1): as factorial as without it."""
    mean = np.empty((len(candidates), len(y)), np.float32)
    for c in range(len(candidates)):
        row, into = W[candidates[c]], mean[c]
        for k in range(len(y)):
            into[k] = logistic(y[k] + row[k])
    return mean


@compiled_in_any_order
def _normal_unit(functions, w, a, i, log_i, j, log_j):
    """Mean and √3 σ of the logit of one unit."""
    rows, constants = functions
    K, r = w.S.shape[1], w.Y.shape[1]
    S_i, O_j, z = w.S[i], w.O[j], np.empty(K, np.float32)
    mean = w.s[i, a] + w.n[a, 0] * log_i + w.o[j, a] + w.n[a, 1] * log_j
    mean += w.residual[residual_row(w.start, w.key, i * len(w.S) + j), a]
    for k in range(K):
        z[k] = S_i[k] * O_j[k]
    variance = np.float32(0.0)
    for p in range(1 + r):
        row, dot = rows[a, p], constants[a, p]
        for k in range(K):
            dot += row[k] * z[k]
        if p == 0:
            mean += dot
        else:
            variance += dot * dot
    return mean, np.sqrt(np.float32(3.0) * variance)


@compiled
def placed_log_odds(y, W, w, candidates, anchor, relation, log_count, outgoing):
    """One relation of absent candidates to one anchor, or back, (N,)."""
    N, a, none = len(candidates), relation, np.float32(0.0)
    mean, spread = np.empty(N, np.float32), np.empty(N, np.float32)
    for start in range(0, N, _CANDIDATES):
        some = candidates[start : start + _CANDIDATES]
        through, C = _moments(_means_with(y, W, some), w, a, a + 1)
        for c in range(len(some)):
            functions = _rows(through[c], C[c], w, a, a + 1)
            i, log_i, j, log_j = some[c], none, anchor, log_count
            if not outgoing:
                i, log_i, j, log_j = anchor, log_count, some[c], none
            found = _normal_unit(functions, w, a, i, log_i, j, log_j)
            mean[start + c], spread[start + c] = found
    to_log_odds(mean, spread)
    return mean
