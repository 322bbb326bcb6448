"""Compiled loops that calibrate relations and rank the entries of answers.

Entries with equal values keep the order of their indices. Several functions take tables of
`RelationSlopes`, which contain the calibration of relations. Each table has one row for each
relation, with intercept, slope and log_count.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference.elementary import logistic
from app.inference.relations import NO_UNIT

Floats = NDArray[np.floating[Any]]

EXCLUDED = np.float32(-1.0)
"""Evidence that a relation cannot hold."""
MOST_EXCLUDED = np.float32(0.01)
"""Maximum probability of a relation that cannot hold."""


@compiled
def relation_probability(slopes: Floats, log_odds: Floats, log_count: Floats) -> Floats:
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
def exclusive(forward: Floats, backward: Floats) -> tuple[Floats, Floats]:
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
def likeliest_classes(logits, usable, count):
    """Return the `count` usable classes with the largest logits, likeliest first.

    The order follows the logits, because probabilities near 0 or 1 may round to the same number.

    Args:
        logits: (N,) logit of the probability of each class.
        usable: (N,) bool, True for classes that the result may contain.
        count: maximum number k of classes.

    Returns:
        Indices of the classes, and their probabilities, each (k,).
    """
    first = best(logits, usable, count)
    p = np.empty(len(first), np.float64)
    for k in range(len(first)):
        p[k] = 1.0 / (1.0 + np.exp(-np.float64(logits[first[k]])))
    return first, p


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
def likeliest_places(slopes, forward, backward, log_counts, count, first):
    """Return the k likeliest places of each of N candidate classes, likeliest first.

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
        count: maximum of k.
        first: number of a place that comes first even if other places are likelier. -1 means that
            the order depends only on the probabilities.

    Returns:
        Five arrays (N k,) with the places of candidate 0, then of candidate 1 and so on: index of
        the candidate, relation, True if the candidate is the subject, index of the anchor, and
        probability.
    """
    N, A, m = forward.shape
    size = A * m
    to = relation_probability(slopes, forward, log_counts)
    back = relation_probability(slopes, backward, log_counts)
    p, usable = np.empty(2 * size, forward.dtype), np.ones(2 * size, np.bool_)
    kept, begin = min(count, 2 * size), 0
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
        for k in range(kept):
            place, at = first if k < begin else indices[k - begin], c * kept + k
            candidate[at], relation[at], anchor[at] = c, place // m % A, place % m
            outgoing[at], probabilities[at] = place < size, p[place]
    return candidate, relation, outgoing, anchor, probabilities


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
