"""Compiled loops of one Gibbs chain: contexts and objects in turn, and relations at the end.

Formulas in `scene_chains`. Every function works for one chain, whose numbers come from its own
stream (`philox`), so nothing depends on other chains. `beta` is one over the temperature.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled, compiled_in_any_order, inlined
from app.inference.elementary import exp, log, logistic
from app.inference.philox import fill

# Draws compare 31 random bits: as many as a signed word holds.
_DRAWS = np.float32(2.0**31)
_BELOW_ONE = np.float32(1.0 - 2.0**-24)
_ONE_BIT = np.uint32(1)
# Contexts that observed relations tie together are proposed in so many blocks,
_PROPOSALS = 8
# and relations that imply each other are drawn in twice so many groups.
_GROUPS = 4
# One more neighbour says less and less.
_MOST = 3


@inlined
def _residual(w, a, i, j):
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
def _softplus(x):
    return max(x, np.float32(0.0)) + log(np.float32(1.0) + exp(-abs(x)))


@compiled
def _words(stream, numbers):
    """At least so many fresh words."""
    words = np.empty(-(-numbers // 4) * 4, np.uint32)
    fill(stream, words)
    return words


@compiled
def _bernoulli(logits, beta, words, on):
    """on = 1 with probability sigmoid(beta logits), to within 2^-31."""
    for i in range(len(logits)):
        p = min(logistic(beta * logits[i]), _BELOW_ONE)
        on[i] = np.int32(words[i] >> _ONE_BIT) < np.int32(p * _DRAWS)


@compiled
def places(on):
    """Where on (n,) is 1, ascending."""
    found, count = np.empty(len(on), np.int64), 0
    for i in range(len(on)):
        found[count] = i
        count += on[i]
    return found[:count]


@compiled
def _add_rows(rows, which, total):
    """total += sum of the named rows, in their order."""
    count = len(which)
    for k in range(0, count - count % 4, 4):
        a, b, c, d = rows[which[k]], rows[which[k + 1]], rows[which[k + 2]], rows[which[k + 3]]
        for i in range(len(total)):
            total[i] += (a[i] + b[i]) + (c[i] + d[i])
    for k in range(count - count % 4, count):
        row = rows[which[k]]
        for i in range(len(total)):
            total[i] += row[i]


@compiled
def hidden_logits(bias, W, classes):
    """x of a set of classes, (H1,)."""
    x = bias.copy()
    _add_rows(W, classes, x)
    return x


# -- the start ---------------------------------------------------------------------------------


@compiled
def _unpack(scene, on):
    """Bits of a scene into on (V,)."""
    for i in range(len(on)):
        on[i] = (scene[i // 32] >> (i % 32)) & 1


@compiled
def fantasy_weights(w, given, held, hint):
    """How likely each fantasy is chosen: cumulative, its last entry 1, (N,) float64.

    Args:
        given: classes that must be there.
        held: hidden units that are held on.
        hint: (N,) what the room type says.
    """
    N = w.mean.shape[1]
    total, logits = hint.copy(), np.empty(N, np.float32)
    for i in given:
        row = w.W[i]
        for f in range(N):
            logits[f] = w.b[i]
        for k in range(len(row)):
            weight, mean = row[k], w.mean[k]
            for f in range(N):
                logits[f] += weight * mean[f]
        for f in range(N):
            total[f] -= _softplus(-logits[f])
    for k in held:
        y = w.y[k]
        for f in range(N):
            total[f] -= _softplus(-y[f])
    largest = np.float32(-np.inf)
    for f in range(N):
        largest = max(largest, total[f])
    for f in range(N):
        total[f] = exp(total[f] - largest)
    cumulative, weight = np.empty(N, np.float64), 0.0
    for f in range(N):
        weight += total[f]
        cumulative[f] = weight
    for f in range(N):
        cumulative[f] /= weight
    return cumulative


@compiled
def start(w, bias, given, held, held2, cumulative, stream):
    """Presence (V,) and contexts (H1,) and (H2,) of a new chain."""
    V, H1 = w.W.shape
    on, h1 = np.zeros(V, np.uint8), np.zeros(H1, np.uint8)
    words = _words(stream, 1 + H1)
    logits = bias
    if len(cumulative):
        chosen = np.searchsorted(cumulative, (np.float64(words[H1]) + 0.5) / 2.0**32)
        _unpack(w.fantasies[chosen], on)
        logits = np.ascontiguousarray(w.y[:, chosen])
    _bernoulli(logits, np.float32(1.0), words, h1)
    for i in given:
        on[i] = 1
    for k in held:
        h1[k] = 1
    h2 = np.zeros(len(w.c2), np.uint8)
    _second_layer(w, h1, held2, np.float32(1.0), h2, stream)
    return on, h1, h2


@compiled
def _second_layer(w, h1, held, beta, h2, stream):
    """h2 given h1."""
    if len(h2):
        logits = w.c2.copy()
        _add_rows(w.J, places(h1), logits)
        _bernoulli(logits, beta, _words(stream, len(h2)), h2)
        for k in held:
            h2[k] = 1


# -- contexts and objects ----------------------------------------------------------------------


@compiled
def sweeps(w, bias, given, held, held2, observed, beta, count, on, h1, h2, stream):
    """So many Gibbs sweeps over h1 (H1,), h2 (H2,) and on (V,), in place.

    Args:
        given, held, held2: classes and hidden units that stay on.
        observed: relations that were seen, `scene_chains.Observed`.
    """
    V, H1 = w.W.shape
    logits = np.empty(V, np.float32)
    for _ in range(count):
        x = hidden_logits(bias, w.W, places(on))
        _add_rows(w.JT, places(h2), x)
        if len(observed.r):
            _propose(w, x, held, observed, beta, h1, stream)
        else:
            _bernoulli(x, beta, _words(stream, H1), h1)
            for k in held:
                h1[k] = 1
        _second_layer(w, h1, held2, beta, h2, stream)
        logits[:] = w.b
        _add_rows(w.WT, places(h1), logits)
        _bernoulli(logits, beta, _words(stream, V), on)
        for i in given:
            on[i] = 1


@compiled
def _propose(w, x, held, observed, beta, h1, stream):
    """h1 given the objects and observed relations: block after block is proposed from p(h1 | v)."""
    H1 = len(x)
    proposal, taken = np.empty(H1, np.uint8), np.empty(H1, np.int64)
    _bernoulli(x, beta, _words(stream, H1), proposal)
    for k in held:
        proposal[k] = 1
    blocks, draws = _words(stream, H1), _words(stream, _PROPOSALS)
    first = _by_block(blocks, proposal, h1, taken)
    shared = w.constant.copy()
    _add_rows(w.directions, places(h1), shared)
    changed, terms = np.empty_like(shared), np.empty(len(observed.r), np.float32)
    weight = _observed_weight(w, shared, observed, beta, terms)
    for block in range(_PROPOSALS):
        units = taken[first[block] : first[block + 1]]
        if not len(units):
            continue
        changed[:] = shared
        for k in units:
            row = w.directions[k]
            if proposal[k]:
                for i in range(len(row)):
                    changed[i] += row[i]
            else:
                for i in range(len(row)):
                    changed[i] -= row[i]
        proposed = _observed_weight(w, changed, observed, beta, terms)
        if np.log((np.float64(draws[block]) + 0.5) / 2.0**32) < proposed - weight:
            weight = proposed
            shared[:] = changed
            for k in units:
                h1[k] = proposal[k]


@compiled
def _by_block(words, proposal, h1, taken):
    """Units that would change, in random blocks: where each begins in taken, filled here."""
    first = np.zeros(_PROPOSALS + 1, np.int64)
    for k in range(len(h1)):
        first[words[k] % _PROPOSALS + 1] += proposal[k] != h1[k]
    for block in range(_PROPOSALS):
        first[block + 1] += first[block]
    after = first.copy()
    for k in range(len(h1)):
        if proposal[k] != h1[k]:
            block = words[k] % _PROPOSALS
            taken[after[block]] = k
            after[block] += 1
    return first


@compiled
def _observed_weight(w, shared, observed, beta, terms):
    """log p(observed r | v, h1)."""
    _observed_logits(w, shared, observed, terms)
    for e in range(len(terms)):
        logit = beta * terms[e]
        terms[e] = observed.r[e] * logit - _softplus(logit)
    return _sum(terms)


@compiled_in_any_order
def _observed_logits(w, shared, observed, out):
    A, K = w.R.shape
    for a in range(A):
        first, last = observed.first[a], observed.first[a + 1]
        logits, base, constant = out[first:last], observed.base[first:last], shared[A * K + a]
        own = shared[a * K : (a + 1) * K]
        for e in range(len(logits)):
            logits[e] = base[e] + constant
        # All units of a relation at a time, four factors at a time: no sum runs across lanes.
        for k in range(0, K - K % 4, 4):
            p, q, s, u = own[k], own[k + 1], own[k + 2], own[k + 3]
            z = observed.z[k : k + 4, first:last]
            one, two, three, four = z[0], z[1], z[2], z[3]
            for e in range(len(logits)):
                logits[e] += (p * one[e] + q * two[e]) + (s * three[e] + u * four[e])
        for k in range(K - K % 4, K):
            p, one = own[k], observed.z[k, first:last]
            for e in range(len(logits)):
                logits[e] += p * one[e]


@compiled_in_any_order
def _sum(values):
    total = np.float64(0.0)
    for e in range(len(values)):
        total += values[e]
    return total


@compiled
def observed_units(w, classes, log_counts, a, i, j):
    """What of ℓ_e depends on nothing else: z_e = S_i * O_j, (K, E), and all but d_a, R_a, h1."""
    E, K = len(a), w.S.shape[1]
    z, base = np.empty((K, E), np.float32), np.empty(E, np.float32)
    for e in range(E):
        s, o = classes[i[e]], classes[j[e]]
        base[e] = w.s[a[e], s] + w.n[a[e], 0] * log_counts[i[e]]
        base[e] += w.o[a[e], o] + w.n[a[e], 1] * log_counts[j[e]] + _residual(w, a[e], s, o)
        for k in range(K):
            z[k, e] = w.S[s, k] * w.O[o, k]
    return z, base


# -- relations ---------------------------------------------------------------------------------


@compiled_in_any_order
def relation_logits(w, classes, h1):
    """ℓ between the classes, one instance each, (A, n, n)."""
    n, (A, K), V = len(classes), w.R.shape, len(w.S)
    shared = w.constant.copy()
    _add_rows(w.directions, places(h1), shared)
    logits, left = np.empty((A, n, n), np.float32), np.empty(K, np.float32)
    for a in range(A):
        own = shared[a * K : (a + 1) * K]
        for i in range(n):
            S, row = w.S[classes[i]], logits[a, i]
            for k in range(K):
                left[k] = S[k] * own[k]
            base = shared[A * K + a] + w.s[a, classes[i]]
            for j in range(n):
                total, O = np.float32(0.0), w.O[classes[j]]  # noqa: E741
                for k in range(K):
                    total += left[k] * O[k]
                row[j] = base + w.o[a, classes[j]] + total
    place = np.full(V, -1)
    place[classes] = np.arange(n)
    for a in range(A):
        for i in range(n):
            own_row = a * V + classes[i]
            for e in range(w.start[own_row], w.start[own_row + 1]):
                j = place[w.column[e]]
                if j >= 0:
                    logits[a, i, j] += w.residual[e]
    return logits


@compiled
def relations(w, bias, classes, logits, observed, beta, stream):
    """r between different classes, (A, n, n) uint8; observed units keep their value.

    A class stands in no relation to itself but those observed: nothing else depends on these.
    """
    A, n = logits.shape[0], len(classes)
    r, open_ = np.zeros((A, n, n), np.uint8), np.ones((A, n, n), np.uint8)
    for i in range(n):
        open_[:, i, i] = 0
    where = np.searchsorted(classes, observed.classes)
    for e in range(len(observed.r)):
        a, i, j = observed.a[e], where[observed.i[e]], where[observed.j[e]]
        r[a, i, j], open_[a, i, j] = np.uint8(observed.r[e]), 0
    words = _words(stream, A * n * n)
    if w.gamma.shape[0]:
        x = hidden_logits(bias, w.W, classes)
        _draw_in_groups(w, x, logits, open_, beta, words, r, stream)
        return r
    drawn = np.empty(A * n * n, np.uint8)
    _bernoulli(logits.reshape(-1), beta, words, drawn)
    flat, free = r.reshape(-1), open_.reshape(-1)
    for e in range(len(drawn)):
        flat[e] = drawn[e] if free[e] else flat[e]
    return r


@compiled
def _draw_in_groups(w, x, logits, open_, beta, words, r, stream):
    """Relations that imply each other: group after group, each given those before it."""
    A, n, _ = r.shape
    steps = 2 * A
    weight = _implication_weights(w, x, beta)
    order, first = _drawing_order(open_, _words(stream, A * n * n))
    # Bits: the relations from i to j, read from either end.
    between = np.zeros((n, n), np.uint64)
    outgoing, incoming = np.zeros((n, steps), np.int64), np.zeros((n, steps), np.int64)
    # The paths there are, from either end: what comes after each first step, before each second.
    after = np.zeros((n, n, steps), np.uint64)
    before = np.zeros((n, n, steps), np.uint64)
    paths = np.zeros((A, n, n), np.float32)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                if r[a, i, j] and i != j:
                    _turn_on(a, i, j, weight, between, outgoing, incoming, after, before, paths)
    newly = np.empty(len(order), np.int64)
    leaving, arriving = np.empty((A, n), np.float32), np.empty((A, n), np.float32)
    degrees = steps + steps * steps
    for turn in range(2 * _GROUPS):
        _degree_shifts(weight[:, degrees : degrees + steps], outgoing, leaving)
        _degree_shifts(weight[:, degrees + steps :], incoming, arriving)
        count = 0
        for place in range(first[turn], first[turn + 1]):
            unit = order[place]
            a, i, j = unit // (n * n), unit // n % n, unit % n
            shift, own = paths[a, i, j] + leaving[a, i] + arriving[a, j], weight[a]
            others, step = between[i, j], 0
            while others:
                if others & np.uint64(1):
                    shift += own[step]
                    # Degrees are of all other classes than these two.
                    if outgoing[i, step] <= _MOST:
                        shift -= own[degrees + step]
                    if incoming[j, step] <= _MOST:
                        shift -= own[degrees + steps + step]
                others >>= np.uint64(1)
                step += 1
            p = min(logistic(beta * logits[a, i, j] + shift), _BELOW_ONE)
            if np.int32(words[unit] >> _ONE_BIT) < np.int32(p * _DRAWS):
                newly[count] = unit
                count += 1
        for place in range(count):
            unit = newly[place]
            a, i, j = unit // (n * n), unit // n % n, unit % n
            r[a, i, j] = 1
            _turn_on(a, i, j, weight, between, outgoing, incoming, after, before, paths)


@compiled
def _degree_shifts(weight, degrees, shifts):
    """What the degrees (n, steps) of each class say of its relations, into shifts (A, n)."""
    for a in range(len(weight)):
        for i in range(len(degrees)):
            shift = np.float32(0.0)
            for step in range(degrees.shape[1]):
                shift += weight[a, step] * min(np.float32(degrees[i, step]), np.float32(_MOST))
            shifts[a, i] = shift


@compiled
def _implication_weights(w, x, beta):
    """beta (gamma_0 + sum_q z_q gamma_q), (A, F), without a unit's say in itself."""
    mean = np.empty(len(x), np.float32)
    for k in range(len(x)):
        mean[k] = logistic(beta * x[k])
    weight = w.gamma[0].copy()
    for q in range(1, len(w.gamma)):
        z, row, own = np.float32(0.0), w.B[q - 1], w.gamma[q]
        for k in range(len(mean)):
            z += row[k] * mean[k]
        for a in range(own.shape[0]):
            for f in range(own.shape[1]):
                weight[a, f] += z * own[a, f]
    for a in range(len(weight)):
        weight[a, a] = np.float32(0.0)
        for f in range(weight.shape[1]):
            weight[a, f] *= beta
    return weight


@compiled
def _drawing_order(open_, words):
    """Open units in random groups, never a(i, j) and a(j, i) in one, and where each begins."""
    A, n, _ = open_.shape
    group, count = np.empty(A * n * n, np.int64), np.zeros(2 * _GROUPS + 1, np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                unit = (a * n + i) * n + j
                later = (words[(a * n + min(i, j)) * n + max(i, j)] >> np.uint32(8)) % 2
                if j < i:
                    later = 1 - later
                group[unit] = words[unit] % _GROUPS + _GROUPS * later
                count[group[unit] + 1] += open_[a, i, j]
    first = np.cumsum(count)
    order, after, free = np.empty(first[-1], np.int64), first.copy(), open_.reshape(-1)
    for unit in range(len(group)):
        if free[unit]:
            order[after[group[unit]]] = unit
            after[group[unit]] += 1
    return order, first


@compiled
def _turn_on(a, i, j, weight, between, outgoing, incoming, after, before, paths):
    """What changes for others where a(i, j), different classes, holds."""
    A = weight.shape[0]
    for step, x, y in ((a, i, j), (A + a, j, i)):
        between[x, y] |= np.uint64(1) << np.uint64(step)
        outgoing[x, step] += 1
        incoming[y, step] += 1
    for step, x, y in ((a, i, j), (A + a, j, i)):
        for k in range(len(between)):
            if k in (x, y):
                continue
            new = between[y, k] & ~after[x, k, step]
            if new:
                after[x, k, step] |= new
                _walk(step, new, x, k, True, weight, before, paths)
            new = between[k, x] & ~before[k, y, step]
            if new:
                before[k, y, step] |= new
                _walk(step, new, k, y, False, weight, after, paths)


@inlined
def _walk(step, others, x, y, ahead, weight, marks, paths):
    """New paths from x to y: one step and any of the others after it, or before it."""
    steps = 2 * weight.shape[0]
    other = 0
    while others:
        if others & np.uint64(1):
            marks[x, y, other] |= np.uint64(1) << np.uint64(step)
            path = step * steps + other if ahead else other * steps + step
            for b in range(weight.shape[0]):
                paths[b, x, y] += weight[b, steps + path]
        others >>= np.uint64(1)
        other += 1


# -- the score ---------------------------------------------------------------------------------


@compiled
def log_score(w, bias, classes, shown, logits, kept):
    """b·v + sum_k softplus(x_k) + log p(kept | v, h1) of the classes that are shown.

    Args:
        shown: (n,) bool.
        logits: (A, n, n).  kept: the same shape, bool.
    """
    listed = classes[shown]
    x = hidden_logits(bias, w.W, listed)
    for k in range(len(x)):
        x[k] = _softplus(x[k])
    score = _sum(x)
    for i in listed:
        score += w.b[i]
    n = len(classes)
    terms = np.empty(n, np.float32)
    for a in range(len(logits)):
        for i in range(n):
            if not shown[i]:
                continue
            own, on = logits[a, i], kept[a, i]
            for j in range(n):
                term = np.float32(on[j]) * own[j] - _softplus(own[j])
                terms[j] = term if shown[j] else np.float32(0.0)
            score += _sum(terms)
    return score
