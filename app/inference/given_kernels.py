"""Compiled loops for relations that are given: what they say of the context, and of each other.

Formulas in `closed_form` and `implications`. Given units are lists (E,): relation a, places i and j
of their classes in the scene, value r (0 or 1) and gate g, the presence of both ends.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled, compiled_in_any_order
from app.inference.elementary import exp, logistic
from app.inference.matrix_kernels import ROWS, add_products, add_rows
from app.inference.relation_kernels import means, residual_row, set_means, to_log_odds

_DAMPING = np.float32(0.8)
_MOST = np.float32(3.0)
_WORD = 64


@compiled_in_any_order
def _units(w, classes, log_counts, a, i, j):
    """z_e = (S_i * O_j, 1), (E, K + 1), and what of ℓ_e does not depend on h1, (E,)."""
    # By name: to take an array from the tuple again and again is to count references to it.
    S, O, s, o, n, g = w.S, w.O, w.s, w.o, w.n, w.g  # noqa: E741
    start, keys, residual, V, K = w.start, w.key, w.residual, len(w.S), w.S.shape[1]
    z, base = np.zeros((len(a), g.shape[1]), np.float32), np.empty(len(a), np.float32)
    for e in range(len(a)):
        b, one, other = a[e], classes[i[e]], classes[j[e]]
        S_i, O_j, row, constant = S[one], O[other], z[e], g[b]
        total = s[one, b] + n[b, 0] * log_counts[i[e]]
        total += o[other, b] + n[b, 1] * log_counts[j[e]]
        total += residual[residual_row(start, keys, one * V + other), b]
        for k in range(K):
            row[k] = S_i[k] * O_j[k]
        row[K] = np.float32(1.0)
        for k in range(K + 1):
            total += row[k] * constant[k]
        base[e] = total
    return z, base


@compiled_in_any_order
def _by_relation(z, a, relations):
    """z with the units of one relation together, each from a whole multiple of `ROWS` on.

    Returns:
        The rows, (A + 1,) where each relation begins, and (E,) where each unit is.
    """
    start, place = np.zeros(relations + 1, np.int64), np.empty(len(a), np.int64)
    for e in range(len(a)):
        start[a[e] + 1] += 1
    for b in range(relations):
        start[b + 1] = start[b] + -(-start[b + 1] // ROWS) * ROWS
    filled = start[:-1].copy()
    rows = np.zeros((start[-1], z.shape[1]), np.float32)
    for e in range(len(a)):
        place[e] = filled[a[e]]
        rows[place[e]] = z[e]
        filled[a[e]] += 1
    return rows, start, place


@compiled_in_any_order
def _add_logits(mean, G, rows, start, out):
    """out (1, units) += U m through what the units of a relation share, G m."""
    shared = np.zeros((1, G.shape[1]), np.float32)
    for b in range(len(G)):
        some = rows[start[b] : start[b + 1]]
        if len(some):
            shared[:] = np.float32(0.0)
            add_products(G[b], mean.reshape(1, -1), shared)
            add_products(some, shared, out[:, start[b] : start[b + 1]])


@compiled_in_any_order
def _add_pull(weight, G, rows, start, out):
    """out (H1,) += sum_e weight_e U_e the same way."""
    factors = np.empty(G.shape[1], np.float32)
    for b in range(len(G)):
        some = rows[start[b] : start[b + 1]]
        if len(some):
            factors[:] = np.float32(0.0)
            add_rows(weight[start[b] : start[b + 1]], some, factors)
            add_rows(factors, G[b], out)


@compiled_in_any_order
def _gather(target, a, z, weight, factors, some):
    """weight_e z_e of each unit into factors (n, A, K + 1) of its target; none where it is -1."""
    for e in range(len(a)):
        c, b, value = target[e], a[e], weight[e]
        if c >= 0 and value != 0.0:
            some[c, b], into, row = True, factors[c, b], z[e]
            for k in range(len(row)):
                into[k] += value * row[k]


@compiled_in_any_order
def _add_expanded(G, factors, some, out):
    for b in range(len(factors)):
        if some[b]:
            add_rows(factors[b], G[b], out)


@compiled
def fixed_point(x, w, classes, log_counts, a, i, j, r, g, sweeps):
    """The mean field given relations: logits of h1 (H1,), and the slopes (E,) at its end.

    And the factors z (E, K + 1) of the units, which `shares` and `common_growth` need again.
    """
    E, G = len(a), w.G
    z, base = _units(w, classes, log_counts, a, i, j)
    rows, start, place = _by_relation(z, a, len(G))
    # U itself where its rows are fewer than those that the units share.
    shared = G.shape[0] * G.shape[1]
    few = 2 * len(rows) <= shared
    U = np.zeros((len(rows) if few else 0, len(x)), np.float32)
    if few:
        for e in range(E):
            add_rows(z[e], G[a[e]], U[place[e]])
    # All in the order of the rows, so that nothing is gathered in the sweeps.
    constant, value = np.zeros(len(rows), np.float32), np.zeros(len(rows), np.float32)
    gate, slopes = np.zeros(len(rows), np.float32), np.zeros(len(rows), np.float32)
    for e in range(E):
        constant[place[e]], value[place[e]], gate[place[e]] = base[e], r[e], g[e]
    y, logits, on = x.copy(), np.empty((1, len(rows)), np.float32), np.empty(len(rows), np.float32)
    for sweep in range(sweeps):
        logits[0] = constant
        if few:
            add_products(U, means(y).reshape(1, -1), logits)
        else:
            _add_logits(means(y), G, rows, start, logits)
        set_means(logits[0], on)
        kept = _DAMPING if sweep else np.float32(0.0)
        for e in range(len(rows)):
            slopes[e] = kept * slopes[e] + (np.float32(1.0) - kept) * gate[e] * (value[e] - on[e])
        y[:] = x
        if few:
            add_rows(slopes, U, y)
        else:
            _add_pull(slopes, G, rows, start, y)
    return y, slopes[place], z


@compiled_in_any_order
def _normal_logit(mean, U, base):
    total, variance = base, np.float32(0.0)
    for h in range(len(U)):
        total += U[h] * mean[h]
        variance += U[h] * U[h] * (mean[h] * (np.float32(1.0) - mean[h]))
    return total, np.sqrt(np.float32(3.0) * variance)


@compiled
def without_itself(y, w, classes, log_counts, a, i, j, slopes, shift):
    """Log-odds of each given unit, its own slope taken out of y, (E,); shift (A, n, n) or none."""
    E, H1, G = len(a), len(y), w.G
    z, base = _units(w, classes, log_counts, a, i, j)
    U, rest = np.empty(H1, np.float32), np.empty(H1, np.float32)
    found, spreads = np.empty(E, np.float32), np.empty(E, np.float32)
    for e in range(E):
        U[:] = np.float32(0.0)
        add_rows(z[e], G[a[e]], U)
        slope = slopes[e]
        for h in range(H1):
            rest[h] = logistic(y[h] - slope * U[h])
        found[e], spreads[e] = _normal_logit(rest, U, base[e])
        if len(shift):
            found[e] += shift[a[e], i[e], j[e]]
    to_log_odds(found, spreads)
    return found


@compiled
def find_slopes(n, relations, a, i, j, slopes, units_a, units_i, units_j):
    """The slopes of some units, (M,); what is not given has none."""
    found, grid = np.empty(len(units_a), np.float32), np.zeros((relations, n, n), np.float32)
    for e in range(len(a)):
        grid[a[e], i[e], j[e]] = slopes[e]
    for m in range(len(found)):
        found[m] = grid[units_a[m], units_i[m], units_j[m]]
    return found


@compiled
def shares(G, W, classes, presence, z, a, i, j, slopes):
    """What each class and its relations, of factors z (E, K + 1), add to y, (n, H1)."""
    n, H1 = len(classes), W.shape[1]
    found = np.empty((n, H1), np.float32)
    for c in range(n):
        row, into = W[classes[c]], found[c]
        for h in range(H1):
            into[h] = presence[c] * row[h]
    factors, some = np.zeros((n, *G.shape[:2]), np.float32), np.zeros((n, len(G)), np.bool_)
    _gather(i, a, z, slopes, factors, some)
    _gather(np.where(i == j, -1, j), a, z, slopes, factors, some)
    for c in range(n):
        _add_expanded(G, factors[c], some[c], found[c])
    return found


@compiled
def common_growth(G, n, z, a, i, j, slopes, rows):
    """e^ what the relations between two classes add to y, (N, n, H1) for classes in rows (N,).

    And (N, n), whether there are any: where there are none, nothing is filled in.

    Args:
        n: classes of the scene.
        z: (E, K + 1) the factors of the relations.
    """
    H1, N = G.shape[2], len(rows)
    place = np.full(n, -1)
    for c in range(N):
        place[rows[c]] = c
    factors, some = np.empty((n, *G.shape[:2]), np.float32), np.empty((n, len(G)), np.bool_)
    target = np.empty(len(a), np.int64)
    found, filled = np.empty((N, n, H1), np.float32), np.zeros((N, n), np.bool_)
    for c in range(N):
        one = rows[c]
        factors[:], some[:] = np.float32(0.0), False
        for e in range(len(a)):
            other = -1
            if (i[e] == one) != (j[e] == one):
                other = j[e] if i[e] == one else i[e]
                if 0 <= place[other] < c:
                    other = -1
            target[e] = other
        _gather(target, a, z, slopes, factors, some)
        for other in range(n):
            earlier = place[other]
            if 0 <= earlier < c:
                filled[c, other] = filled[earlier, one]
                if filled[c, other]:
                    found[c, other] = found[earlier, one]
            elif np.any(some[other]):
                filled[c, other], into = True, found[c, other]
                into[:] = np.float32(0.0)
                _add_expanded(G, factors[other], some[other], into)
                for h in range(H1):
                    into[h] = exp(into[h])
    return found, filled


@compiled
def implied(gamma, B, x, n, a, i, j, r):
    """What the given relations that hold imply for all others, (2, A, n, n); see `implications`.

    First all they do; then without what those of a pair imply for each other.

    Args:
        gamma: (1 + G, A, F).  B: (G, H1).
        x: (H1,) logits of h1 given the objects: how strictly the rules hold.
        n: classes of the scene.
    """
    A, F = gamma.shape[1:]
    steps = 2 * A
    # (F, A): what one feature says of all relations lies together.
    weight, mean = np.empty((F, A), np.float32), means(x)
    for b in range(A):
        for f in range(F):
            weight[f, b] = gamma[0, b, f]
    for q in range(len(B)):
        strictness = np.float32(0.0)
        for h in range(len(mean)):
            strictness += B[q, h] * mean[h]
        for b in range(A):
            for f in range(F):
                weight[f, b] += strictness * gamma[1 + q, b, f]
    for b in range(A):
        weight[b, b] = np.float32(0.0)
    # Relations in both directions; the second ends of one relation from one class as a set of bits.
    both = np.zeros((steps, n, n), np.bool_)
    words = -(-n // _WORD)
    ends = np.zeros((steps, n, words), np.uint64)
    for e in range(len(a)):
        if r[e] > 0 and i[e] != j[e]:
            for c, x_, y_ in ((a[e], i[e], j[e]), (A + a[e], j[e], i[e])):
                both[c, x_, y_] = True
                ends[c, x_, y_ // _WORD] |= np.uint64(1) << np.uint64(y_ % _WORD)
    shift = np.zeros((n, n, A), np.float32)
    _add_degrees(both, weight[steps + steps * steps :], shift)
    _add_paths(both, ends, weight[steps:], shift)
    found = np.empty((2, A, n, n), np.float32)
    for x_ in range(n):
        for y_ in range(n):
            for b in range(A):
                found[1, b, x_, y_] = shift[x_, y_, b]
            for c in range(steps):
                if both[c, x_, y_]:
                    for b in range(A):
                        shift[x_, y_, b] += weight[c, b]
            for b in range(A):
                found[0, b, x_, y_] = shift[x_, y_, b]
    return found


@compiled
def _add_degrees(both, weight, shift):
    """What the other neighbours of either end say: weight (2 steps, A), out of x and into y."""
    steps, n = both.shape[:2]
    A = weight.shape[1]
    outgoing, incoming = np.zeros((steps, n), np.int64), np.zeros((steps, n), np.int64)
    for c in range(steps):
        for x in range(n):
            for y in range(n):
                outgoing[c, x] += both[c, x, y]
                incoming[c, y] += both[c, x, y]
    out, into = np.zeros((n, A), np.float32), np.zeros((n, A), np.float32)
    for c in range(steps):
        for x in range(n):
            for b in range(A):
                out[x, b] += weight[c, b] * min(np.float32(outgoing[c, x]), _MOST)
                into[x, b] += weight[steps + c, b] * min(np.float32(incoming[c, x]), _MOST)
    for x in range(n):
        for y in range(n):
            for b in range(A):
                shift[x, y, b] += out[x, b] + into[y, b]
    for c in range(steps):
        for x in range(n):
            for y in range(n):
                # The pair itself is no other neighbour.
                if both[c, x, y]:
                    for b in range(A):
                        if outgoing[c, x] <= _MOST:
                            shift[x, y, b] -= weight[c, b]
                        if incoming[c, y] <= _MOST:
                            shift[x, y, b] -= weight[steps + c, b]


@compiled
def _add_paths(both, ends, weight, shift):
    """What a path of two steps from x to y says: weight (steps², A)."""
    steps, n, words = ends.shape
    A = weight.shape[1]
    seen = np.empty(words, np.uint64)
    for c in range(steps):
        for x in range(n):
            if not np.any(ends[c, x]):
                continue
            for d in range(steps):
                seen[:] = np.uint64(0)
                for k in range(n):
                    if both[c, x, k]:
                        for word in range(words):
                            seen[word] |= ends[d, k, word]
                row = weight[c * steps + d]
                for word in range(words):
                    left, y = seen[word], word * _WORD
                    while left:
                        if left & np.uint64(1):
                            for b in range(A):
                                shift[x, y, b] += row[b]
                        left >>= np.uint64(1)
                        y += 1
