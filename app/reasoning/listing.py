"""Compiled loops from log-odds to what an answer lists: calibrated, and the best of it in order."""

from __future__ import annotations

import numpy as np

from app.compiling import compiled
from app.reasoning.calibration import exclusive, relation_probability
from app.reasoning.ranking import best


@compiled
def absent_things(structure, classes):
    """The classes that are no structure (V,) bool and not among those of a scene, ascending."""
    usable = ~structure
    for k in range(len(classes)):
        usable[classes[k]] = False
    return np.flatnonzero(usable)


@compiled
def likeliest_classes(scores, chosen, count):
    """The best `count` of the chosen by score, and their shares of the softmax over all, (k,) each.

    By score: probabilities of far ones may all round to zero.
    """
    where = best(scores, chosen, count)
    largest, total = np.max(scores), np.float64(0.0)
    for k in range(len(scores)):
        total += np.exp(scores[k] - largest)
    p = np.empty(len(where), np.float64)
    for k in range(len(where)):
        p[k] = np.exp(scores[where[k]] - largest) / total
    return where, p


@compiled
def likeliest_places(slopes, forward, backward, log_counts, classes, count):
    """The best places of each candidate, (N, k): numbers of them, and their probabilities.

    Args:
        slopes: (A, 4), see `RelationSlopes`.
        forward, backward: (N, A, m) log-odds of relations to the anchors, and of those back.
        log_counts: (m,).
        classes: how many distinct ones there are with the candidate.

    Returns:
        Place (d A + a) m + j is relation a, back if d = 1, of anchor j.
    """
    N, A, m = forward.shape
    counts, size = log_counts.reshape(1, m), A * m
    to = relation_probability(slopes, forward.reshape(N, A, 1, m), counts, classes)
    back = relation_probability(slopes, backward.reshape(N, A, 1, m), counts, classes)
    p, usable = np.empty(2 * size, forward.dtype), np.ones(2 * size, np.bool_)
    kept = min(count, 2 * size)
    places, probabilities = np.empty((N, kept), np.int64), np.empty((N, kept), np.float64)
    for c in range(N):
        one, other = to[c].reshape(-1), back[c].reshape(-1)
        for e in range(size):
            p[e], p[size + e] = exclusive(one[e], other[e])
        where = best(p, usable, kept)
        for k in range(kept):
            places[c, k], probabilities[c, k] = where[k], p[where[k]]
    return places, probabilities


@compiled
def pairs_of_things(structure, classes, row):
    """(N, N) which ordered pairs of objects are two things: different, and no structure."""
    size = len(row)
    asked = np.zeros((size, size), np.bool_)
    for x in range(size):
        if not structure[classes[row[x]]]:
            for y in range(size):
                asked[x, y] = x != y and not structure[classes[row[y]]]
    return asked


@compiled
def likeliest_relations(slopes, log_odds, log_counts, row, asked, least, opposites, count):
    """The best `count` relations between objects, by place: subject, object, relation.

    Args:
        slopes: (A, 4), see `RelationSlopes`.
        log_odds: (A, n, n) between classes.
        log_counts: (n,).
        row: (N,) the class of each object.
        asked: (N, N) bool, which ordered pairs.
        least: leave out what is less likely.
        opposites: whether each is also spelled the other way round, as relation A + a.

    Returns:
        (k,) subjects, objects, relations and probabilities.
    """
    (A, n), size = log_odds.shape[:2], len(row)
    counts = np.empty((n, n), log_counts.dtype)
    for i in range(n):
        for j in range(n):
            counts[i, j] = log_counts[i] + log_counts[j]
    p = relation_probability(slopes, log_odds.reshape(1, A, n, n), counts, n)[0]
    names = 2 * A if opposites else A
    grid, usable = np.zeros((size, size, names), p.dtype), np.zeros((size, size, names), np.bool_)
    for x in range(size):
        for y in range(size):
            if asked[x, y]:
                i, j = row[x], row[y]
                for a in range(A):
                    to, back = exclusive(p[a, i, j], p[a, j, i])
                    grid[x, y, a], usable[x, y, a] = to, to >= least
                    if opposites:
                        grid[x, y, A + a], usable[x, y, A + a] = back, back >= least
    values = grid.reshape(-1)
    where = best(values, usable.reshape(-1), count)
    pair = where // names
    return pair // size, pair % size, where % names, values[where].astype(np.float64)


@compiled
def least_fitting(intercept, slope, log_odds, row):
    """Objects by how badly they fit, ties by place, (N,); and the probability of each class, (n,).

    Args:
        intercept, slope: from log-odds of presence to those of being an intruder.
        log_odds: (n,) of the classes.
        row: (N,) the class of each object.
    """
    intruder, p = np.empty(len(log_odds), np.float64), np.empty(len(log_odds), np.float64)
    for i in range(len(log_odds)):
        intruder[i] = intercept + slope * log_odds[i]
        p[i] = 1.0 / (1.0 + np.exp(-intruder[i]))
    judged = np.empty(len(row), np.float64)
    for k in range(len(row)):
        judged[k] = intruder[row[k]]
    return best(judged, np.ones(len(row), np.bool_), len(row)), p


@compiled
def strongest(change, rows, count):
    """For each class in rows (N,) the places of the largest changes (N, n), and these; not its own.

    Of either sign, (N, k) both.
    """
    n = change.shape[1]
    kept = min(count, n - 1)
    places, values = np.empty((len(rows), kept), np.int64), np.empty((len(rows), kept), np.float64)
    usable = np.ones(n, np.bool_)
    for c in range(len(rows)):
        usable[rows[c]] = False
        where = best(np.abs(change[c]), usable, kept)
        usable[rows[c]] = True
        for k in range(kept):
            places[c, k], values[c, k] = where[k], change[c, where[k]]
    return places, values
