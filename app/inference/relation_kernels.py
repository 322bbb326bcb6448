"""Compiled kernels of relation units: residual look-up, mean field, implications.

`relations` has the formulas; `training/machines/implications.py` has those of the implications.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled, compiled_in_any_order, inlined
from app.inference.elementary import exp, log, logistic

SPREAD, SHIFT = 2654435761, 16
"""The bucket of a pair is (key * SPREAD) >> SHIFT, modulo the number of buckets."""

_DAMPING = np.float32(0.8)
# Relations that imply each other are sampled in 2 * _GROUPS groups.
_GROUPS = 4
# Maximum number of neighbours that count: further neighbours add little information.
_MOST = np.float32(3.0)


@compiled
def pair_rows(start, keys, pairs):
    """Return the row of each pair (E,), i V + j; unknown pairs get the last row, which is zero."""
    # Buckets are faster than binary search, whose branches the processor cannot predict.
    found = np.empty(len(pairs), np.int64)
    for e in range(len(pairs)):
        pair = pairs[e]
        bucket = (pair * SPREAD >> SHIFT) & (len(start) - 2)
        found[e] = len(keys)
        for row in range(start[bucket], start[bucket + 1]):
            if keys[row] == pair:
                found[e] = row
    return found


@compiled_in_any_order
def unit_terms(w, g, a, ends):
    """Return the logits of units without U_e·h1, (E,), and their factors z_e (E, K).

    Args:
        w: `relations.SharedArrays`.
        g: (A, K); the products g[a_e]·z_e are part of the logits.
        a: (E,) relations.
        ends: `relations.Ends`, (E,) each.
    """
    S, O, s, o, n, residual = w.S, w.O, w.s, w.o, w.n, w.residual  # noqa: E741
    i, j, log_i, log_j = ends.i, ends.j, ends.log_i, ends.log_j
    pairs = pair_rows(w.start, w.key, i * len(S) + j)
    base, z = np.empty(len(a), np.float32), np.empty((len(a), S.shape[1]), np.float32)
    for e in range(len(a)):
        S_i, O_j, into, row = S[i[e]], O[j[e]], z[e], g[a[e]]
        total = s[i[e], a[e]] + n[a[e], 0] * log_i[e] + o[j[e], a[e]] + n[a[e], 1] * log_j[e]
        total += residual[pairs[e], a[e]]
        for k in range(len(into)):
            into[k] = S_i[k] * O_j[k]
            total += row[k] * into[k]
        base[e] = total
    return base, z


@compiled
def pair_terms(w, first, ends, z, base):
    """Compute the parts of the logits of pairs that do not depend on the context.

    Args:
        w: `relations.SharedArrays`.
        first: first of the R relations.
        ends: `relations.Ends`, (B, P) each.
        z: (B, K, P') receives the factors z_e; P' is at least P.
        base: (B, R, P') receives the other terms.
    """
    # Local names, because each access through the tuple would count a reference.
    S, O, s, o, n, residual = w.S, w.O, w.s, w.o, w.n, w.residual  # noqa: E741
    for b in range(len(z)):
        subjects, objects, log_i, log_j = ends.i[b], ends.j[b], ends.log_i[b], ends.log_j[b]
        pairs = pair_rows(w.start, w.key, subjects * len(S) + objects)
        for p in range(len(pairs)):
            i, j = subjects[p], objects[p]
            S_i, O_j, own = S[i], O[j], residual[pairs[p]]
            for k in range(z.shape[1]):
                z[b, k, p] = S_i[k] * O_j[k]
            for c in range(base.shape[1]):
                a = first + c
                of_counts = n[a, 0] * log_i[p] + n[a, 1] * log_j[p]
                base[b, c, p] = s[i, a] + o[j, a] + of_counts + own[a]


@compiled_in_any_order
def spreads(C, q):
    """Return √3 σ = √(3 q'C q) of logits, (B, R, P).

    Args:
        C: (B, R, r (r + 1) / 2) lower half of C; entries off the diagonal are doubled.
        q: (B, R, r, P) coordinates of each pair.
    """
    B, R, r, P = q.shape
    found, row = np.empty((B, R, P), np.float32), np.empty(P, np.float32)
    for b in range(B):
        for c in range(R):
            weights, rows, variance, t = C[b, c], q[b, c], found[b, c], 0
            variance[:] = np.float32(0.0)
            for d in range(r):
                row[:], this = np.float32(0.0), rows[d]
                for u in range(d + 1):
                    weight, other = weights[t + u], rows[u]
                    for p in range(P):
                        row[p] += weight * other[p]
                t += d + 1
                for p in range(P):
                    variance[p] += row[p] * this[p]
            for p in range(P):
                variance[p] = np.sqrt(np.float32(3.0) * max(variance[p], np.float32(0.0)))
    return found


_ROOT_3 = np.float32(3.0**0.5)
# Maximum √3 σ for which three nodes are enough.
_NARROW = np.float32(0.75 * 3.0**0.5)
# Trapezoidal rule for larger σ: step of the positive nodes in units of σ, and their weights
# relative to the weight of node 0.
_STEP = np.float32(0.25)
_TAIL = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


@compiled
def log_odds(means, spreads, least):
    """Replace means (E,) by log-odds; see `relations.to_log_odds`. Spreads are √3 σ."""
    wide = np.flatnonzero(spreads >= _NARROW)
    some = _wide_log_odds(means[wide], spreads[wide])
    one, four = np.float32(1.0), np.float32(4.0)
    for e in range(len(means)):
        size, q = abs(means[e]), exp(spreads[e])
        u = exp(-size)
        a, b, c = one + u, one + u * q, q + u
        middle = four * b * c
        away = size - log((middle + a * (q * c + b)) / (middle + a * (c + q * b)))
        means[e] = max(away if means[e] >= 0.0 else -away, least)
    for k in range(len(wide)):
        means[wide[k]] = max(some[k], least)


@compiled
def _wide_log_odds(means, spreads):
    """Compute the log-odds by the trapezoidal rule, without a lower limit."""
    one, E = np.float32(1.0), len(means)
    u, step, q = np.empty(E, np.float32), np.empty(E, np.float32), np.ones(E, np.float32)
    on, off = np.empty(E, np.float32), np.empty(E, np.float32)
    for e in range(E):
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
        away = abs(means[e]) - log(on[e] / off[e])
        on[e] = away if means[e] >= 0.0 else -away
    return on


@compiled
def accumulate(keys, weights, rows, size):
    """Sum weighted rows by key, (size, K); rows with key -1 are ignored.

    Args:
        keys: (E,), or (2E,) for two keys per row.
        weights, rows: (E,) and (E, K).
        size: number of keys.
    """
    found = np.zeros((size, rows.shape[1]), np.float32)
    for n in range(len(keys)):
        if keys[n] >= 0:
            e = n % len(rows)
            into, row, weight = found[keys[n]], rows[e], weights[e]
            for k in range(len(row)):
                into[k] += weight * row[k]
    return found


@compiled
def expanded(G, a, z):
    """Compute U_e = G[a_e]'z_e, (E, H1)."""
    found = np.zeros((len(a), G.shape[2]), np.float32)
    for e in range(len(a)):
        into, shared, factors = found[e], G[a[e]], z[e]
        for k in range(len(factors)):
            row, factor = shared[k], factors[k]
            for h in range(len(into)):
                into[h] += factor * row[h]
    return found


@compiled
def _set_means(x, out):
    for k in range(len(x)):
        out[k] = logistic(x[k])


@compiled_in_any_order
def _products(rows, m, out):
    """Compute out = rows m."""
    for e in range(len(rows)):
        row, total = rows[e], np.float32(0.0)
        for k in range(len(row)):
            total += row[k] * m[k]
        out[e] = total


@compiled_in_any_order
def _selected_products(rows, a, through, out):
    """Compute out_e = rows_e · through[a_e]."""
    for e in range(len(rows)):
        row, other, total = rows[e], through[a[e]], np.float32(0.0)
        for k in range(len(row)):
            total += row[k] * other[k]
        out[e] = total


@compiled
def normal_without_itself(y, U, base, slopes):
    """Return mean and √3 σ of the logits of units (E,), each at y without its own slope.

    Args:
        y: (H1,) logits of h1.
        U: (E, H1) weights of the units.
        base: (E,) logits without U_e·h1.
        slopes: (E,) slopes of the units.
    """
    mean, spread = np.empty(len(U), np.float32), np.empty(len(U), np.float32)
    rest, m = np.empty_like(y), np.empty_like(y)
    for e in range(len(U)):
        row = U[e]
        for k in range(len(y)):
            rest[k] = y[k] - slopes[e] * row[k]
        _set_means(rest, m)
        mean[e], variance = _moments(row, m)
        mean[e] += base[e]
        spread[e] = np.sqrt(np.float32(3.0) * variance)
    return mean, spread


@compiled_in_any_order
def _moments(row, m):
    mean = variance = np.float32(0.0)
    for k in range(len(row)):
        mean += row[k] * m[k]
        variance += row[k] * row[k] * (m[k] * (np.float32(1.0) - m[k]))
    return mean, variance


@compiled
def fixed_point(x, G, a, base, z, r, gate, sweeps):
    """Compute the mean field of `RelationUnits.fixed_point`: y (H1,) and slopes (E,).

    Args:
        x: (H1,) logits of h1 given the objects.
        G: (A, K, H1), U_e = G[a_e]'z_e; empty if z (E, H1) is U itself.
        a, base, z: see `relations.Units`.
        r, gate: (E,) values of the relations, and presence of both ends.
        sweeps: number of iterations.
    """
    E, (A, K, _) = len(a), G.shape
    y, m, logits = x.copy(), np.empty_like(x), np.empty(E, np.float32)
    slopes, on = np.zeros(E, np.float32), np.empty(E, np.float32)
    shared, through = G.reshape(A * K, -1), np.empty(A * K, np.float32)
    factors = np.empty((A, K), np.float32)
    for sweep in range(sweeps):
        _set_means(y, m)
        if A:
            _products(shared, m, through)
            _selected_products(z, a, through.reshape(A, K), logits)
        else:
            _products(z, m, logits)
        for e in range(E):
            logits[e] += base[e]
        _set_means(logits, on)
        kept = _DAMPING if sweep else np.float32(0.0)
        for e in range(E):
            slopes[e] = kept * slopes[e] + (np.float32(1.0) - kept) * gate[e] * (r[e] - on[e])
        y[:] = x
        if A:
            factors[:] = np.float32(0.0)
            for e in range(E):
                into, row, slope = factors[a[e]], z[e], slopes[e]
                for k in range(K):
                    into[k] += slope * row[k]
            _add_rows(factors.reshape(-1), shared, y)
        else:
            _add_rows(slopes, z, y)
    return y, slopes


@compiled
def _add_rows(weights, rows, out):
    for e in range(len(rows)):
        row, weight = rows[e], weights[e]
        for k in range(len(out)):
            out[k] += weight * row[k]


@compiled
def _no_steps(relations, n):
    """Return the empty step tables of a scene without relations.

    A step follows a relation: step a leads from subject to object, step A + a leads back.

    Returns:
        degree: (2A, n) number of steps of each kind from each class.
        near: (2A, n, n) targets of these steps.
        seen: (n, n, 2A) for paths of two steps, by first step: bit set of the second steps.
        paths: (n, n, A) shift of each relation between two classes by the paths between them.
    """
    steps = 2 * relations
    degree, near = np.zeros((steps, n), np.int64), np.empty((steps, n, n), np.int64)
    seen = np.zeros((n, n, steps), np.uint64)
    return degree, near, seen, np.zeros((n, n, relations), np.float32)


@compiled
def _hold(known, weight, a, i, j):
    """Add relation a between classes i and j: count its two steps and the new paths."""
    # Plain indices, because a slice costs more than the few numbers read from it.
    degree, near, seen, paths = known
    steps = len(degree)
    both = (a, i, j), (steps // 2 + a, j, i)
    for c, x, y in both:
        near[c, x, degree[c, x]] = y
        degree[c, x] += 1
    for c, x, y in both:
        for d in range(steps):
            for at in range(degree[d, y]):
                _add_path(seen, paths, weight, x, near[d, y, at], c, d)
            # Targets of step d from x lead to x by the opposite step.
            back = (d + steps // 2) % steps
            for at in range(degree[d, x]):
                _add_path(seen, paths, weight, near[d, x, at], y, back, c)


@inlined
def _add_path(seen, paths, weight, x, y, first, second):
    steps, bit = seen.shape[2], np.uint64(1) << np.uint64(second)
    if not seen[x, y, first] & bit:
        seen[x, y, first] |= bit
        for b in range(paths.shape[2]):
            paths[x, y, b] += weight[steps + first * steps + second, b]


@compiled
def _implied(known, weight, direct):
    """Return the shift of each relation by all relations that hold, (n, n, A).

    Args:
        known: tables of `_no_steps`.
        weight: (F, A) implication weights.
        direct: whether the relations of a pair shift each other.
    """
    degree, near, _, paths = known
    (steps, n), A = degree.shape, weight.shape[1]
    shift, degrees = paths.copy(), weight[steps + steps * steps :]
    out, into = np.zeros((n, A), np.float32), np.zeros((n, A), np.float32)
    for c in range(steps):
        # A step into a class is the opposite step out of the class.
        back = (c + A) % steps
        for x in range(n):
            for b in range(A):
                out[x, b] += degrees[c, b] * min(np.float32(degree[c, x]), _MOST)
                into[x, b] += degrees[steps + c, b] * min(np.float32(degree[back, x]), _MOST)
    for x in range(n):
        for y in range(n):
            for b in range(A):
                shift[x, y, b] += out[x, b] + into[y, b]
    for c in range(steps):
        back = (c + A) % steps
        for x in range(n):
            for at in range(degree[c, x]):
                y = near[c, x, at]
                for b in range(A):
                    if direct:
                        shift[x, y, b] += weight[c, b]
                    # The degrees must not count the step between these two classes.
                    if degree[c, x] <= _MOST:
                        shift[x, y, b] -= degrees[c, b]
                    if degree[back, y] <= _MOST:
                        shift[x, y, b] -= degrees[steps + c, b]
    return shift


@compiled
def implied(weight, n, a, i, j):
    """Return the shifts of all relations by relations that hold, (2, n, n, A).

    The first entry contains all shifts. In the second, the relations of a pair do not shift each
    other.

    Args:
        weight: (F, A), see `RelationUnits.implication_weights`.
        n: number of classes in the scene.
        a, i, j: (E,) relations that hold between different classes.
    """
    known = _no_steps(weight.shape[1], n)
    for e in range(len(a)):
        _hold(known, weight, a[e], i[e], j[e])
    found = np.empty((2, n, n, weight.shape[1]), np.float32)
    found[0], found[1] = _implied(known, weight, True), _implied(known, weight, False)
    return found


@compiled
def draw_in_groups(weight, logits, free, uniform, other, r):
    """Sample relations that imply each other: group after group, given all earlier groups.

    The groups are random; a(i, j) and a(j, i) are always in different groups.

    Args:
        weight: (F, A), see `RelationUnits.implication_weights`.
        logits: (A, n, n) logits without implications.
        free: (A, n, n) relations to sample; the others keep their value.
        uniform, other: (A, n, n) random numbers in [0, 1), for relations and for groups.
        r: (A, n, n) receives the samples.
    """
    A, n, _ = r.shape
    known, group = _no_steps(A, n), np.full(r.shape, -1, np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                if free[a, i, j]:
                    # One random number for both directions decides which direction comes first.
                    later = other[a, min(i, j), max(i, j)] < 0.5
                    half = _GROUPS if later == (i < j) else 0
                    group[a, i, j] = half + np.int64(2 * _GROUPS * other[a, i, j]) % _GROUPS
    for turn in range(-1, 2 * _GROUPS):
        if turn >= 0:
            shift = _implied(known, weight, True)
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
                        _hold(known, weight, a, i, j)
