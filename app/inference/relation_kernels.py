"""Compiled kernels of relation units: look-up of residual weights, log-odds, implications.

An implication is a change of a relation's logit by other relations that hold. The formulas of the
implications are in `training/machines/triway.py`. All other formulas are in the module `relations`.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled, compiled_in_any_order, inlined
from app.inference.elementary import exp, log, logistic

SPREAD, SHIFT = 2654435761, 16
"""Constants of a hash table: bucket of a pair = (key * SPREAD) >> SHIFT, modulo the table size."""

# `draw_in_groups` samples the relations in 2 * _GROUPS groups.
_GROUPS = 4
# Limit of a degree feature. This feature counts the relations of one kind that a class has. More
# than three relations add little information.
_MOST = np.float32(3.0)


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
def pair_terms(w, first, ends, z, base):
    """Compute the parts of relation logits that do not depend on the hidden units.

    The function writes its results to z and base, for R relations of P pairs in each of B batches.

    Args:
        w: weights of the units; see `relations.SharedArrays`.
        first: index of the first of the R consecutive relations.
        ends: subject and object classes of the pairs, (B, P); see `relations.Ends`.
        z: (B, K, P') output array for the factors z_e. P' is P plus padding.
        base: (B, R, P') output array for the terms without z_e.
    """
    # Local names are faster: each access through the tuple would change a reference count.
    S, O, s, o, n, residual = w.S, w.O, w.s, w.o, w.n, w.residual  # noqa: E741
    for b in range(len(z)):
        subjects, objects, log_i, log_j = ends.i[b], ends.j[b], ends.log_i[b], ends.log_j[b]
        pairs = pair_rows(w.start, w.key, subjects * len(S) + objects)
        for p in range(len(pairs)):
            i, j = subjects[p], objects[p]
            S_i, O_j, pair_residual = S[i], O[j], residual[pairs[p]]
            for k in range(z.shape[1]):
                z[b, k, p] = S_i[k] * O_j[k]
            for c in range(base.shape[1]):
                a = first + c
                of_counts = n[a, 0] * log_i[p] + n[a, 1] * log_j[p]
                base[b, c, p] = s[i, a] + o[j, a] + of_counts + pair_residual[a]


@compiled_in_any_order
def spreads(C, q):
    """Return √3 σ = √(3 q'C q) of the logits of R relations for P pairs in B batches, (B, R, P).

    σ is the standard deviation of a logit. `relations.SharedUnits` defines C and q.

    Args:
        C: (B, R, r (r + 1) / 2) lower half of each symmetric r x r matrix C. Entries off the
            diagonal are doubled.
        q: (B, R, r, P) vectors q of r coordinates.
    """
    B, R, r, P = q.shape
    spread, row = np.empty((B, R, P), np.float32), np.empty(P, np.float32)
    for b in range(B):
        for c in range(R):
            weights, rows, variance, t = C[b, c], q[b, c], spread[b, c], 0
            variance[:] = np.float32(0.0)
            for d in range(r):
                row[:], q_d = np.float32(0.0), rows[d]
                for u in range(d + 1):
                    weight, q_u = weights[t + u], rows[u]
                    for p in range(P):
                        row[p] += weight * q_u[p]
                t += d + 1
                for p in range(P):
                    variance[p] += row[p] * q_d[p]
            for p in range(P):
                variance[p] = np.sqrt(np.float32(3.0) * max(variance[p], np.float32(0.0)))
    return spread


@compiled
def subtract_products(C, f):
    """Subtract sum_u f_u f_u' from each symmetric matrix C, in place.

    Args:
        C: (B, R, r (r + 1) / 2); see `spreads`.
        f: (units u, B, R, r) vectors f_u.
    """
    units, B, R, r = f.shape
    for b in range(B):
        for c in range(R):
            lower = C[b, c]
            for u in range(units):
                row, t = f[u, b, c], 0
                for d in range(r):
                    double = row[d] + row[d]
                    for e in range(d):
                        lower[t + e] -= double * row[e]
                    lower[t + d] -= row[d] * row[d]
                    t += d + 1


_ROOT_3 = np.float32(3.0**0.5)
# Limit of √3 σ. Below this limit, a quadrature with three nodes is accurate enough.
_NARROW = np.float32(0.75 * 3.0**0.5)
# Constants of the trapezoidal rule for larger σ. _STEP is the distance between two nodes in units
# of σ. _TAIL contains the weights of the positive nodes, relative to the weight of node 0.
_STEP = np.float32(0.25)
_TAIL = np.exp(-0.5 * (0.25 * np.arange(1, 21)) ** 2).astype(np.float32)


@compiled
def log_odds(means, spreads, least):
    """Replace the means (E,) of logits by log-odds of at least ``least``; see `to_log_odds`."""
    wide = np.flatnonzero(spreads >= _NARROW)
    wide_log_odds = _wide_log_odds(means[wide], spreads[wide])
    one, four = np.float32(1.0), np.float32(4.0)
    # The sums over the three nodes have the common denominator a b c; see `to_log_odds`.
    for e in range(len(means)):
        size, q = abs(means[e]), exp(spreads[e])
        u = exp(-size)
        a, b, c = one + u, one + u * q, q + u
        middle = four * b * c
        log_odds = size - log((middle + a * (q * c + b)) / (middle + a * (c + q * b)))
        means[e] = max(log_odds if means[e] >= 0.0 else -log_odds, least)
    for k in range(len(wide)):
        means[wide[k]] = max(wide_log_odds[k], least)


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
    """Return how much the relations that hold change the logit of each relation, (2, n, n, A).

    Index 0 of the first axis has the changes by all relations that hold. At index 1, relations
    between the same two classes do not change each other's logits.

    Args:
        weight: see `_shifts`.
        n: number of classes in the scene.
        a, i, j: (E,) indices of the relations that hold, of their subject classes and of their
            object classes. Subject and object class differ.
    """
    tables = _empty_steps(weight.shape[1], n)
    for e in range(len(a)):
        _add_relation(tables, weight, a[e], i[e], j[e])
    shifts = np.empty((2, n, n, weight.shape[1]), np.float32)
    shifts[0], shifts[1] = _shifts(tables, weight, True), _shifts(tables, weight, False)
    return shifts


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
    tables, group = _empty_steps(A, n), np.full(r.shape, -1, np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
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
