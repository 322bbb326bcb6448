"""Compiled loops from log-odds to the best of what an answer can list; ties go by position.

And from numbers to the digits that an answer shows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.relations import NO_UNIT
from app.questions.calibration import exclusive, relation_probability

DIGITS: Final = 6
"""Significant digits of probabilities, log-odds and metres."""

# Exact doubles: a whole number divided by one of them is the double nearest to the decimal number.
_POWERS: Final = np.array([10.0**power for power in range(23)])


TupleT = TypeVar("TupleT", bound=tuple[Any, ...])


REASONS: Final = 3
"""How many objects an answer names as reasons."""

EXPLAINED: Final = 32
"""Reasons are given for so many entries of an answer at most, its first."""


class Because(NamedTuple):
    """What the presence of one object adds to the log-odds of another; negative speaks against."""

    object: int
    log_odds_change: float


def entries(kind: type[TupleT], *columns: Iterable[Any]) -> list[TupleT]:
    """Named tuples from their fields, column by column: in half the time that calls would take."""
    return list(map(partial(tuple.__new__, kind), zip(*columns, strict=True)))


@compiled
def best(values, usable, count):
    """Positions of the `count` largest usable values, largest first, earlier first among equals.

    Args:
        values: (N,).
        usable: (N,) bool.

    Returns:
        At most `count` positions. N numbers cost O(N log count).
    """
    size, kept = 0, min(count, len(values))
    # A heap whose first is the worst of the best so far: the smallest, the last among equals.
    heap = np.empty(kept, np.int64)
    for position in range(len(values)):
        if not usable[position]:
            continue
        if size < kept:
            at = size
            size += 1
            while at and not _worse(values, heap[(at - 1) // 2], position):
                heap[at] = heap[(at - 1) // 2]
                at = (at - 1) // 2
            heap[at] = position
        elif values[position] > values[heap[0]]:
            _sink(values, heap, size, position)
    found = heap[:size]
    for last in range(size - 1, 0, -1):
        worst, moved = heap[0], heap[last]
        _sink(values, heap, last, moved)
        found[last] = worst
    return found


@compiled
def _worse(values, one, other):
    """Whether the value at one position comes after that at another."""
    return values[one] < values[other] or (values[one] == values[other] and one > other)


@compiled
def _sink(values, heap, size, position):
    """Put a position in the place of the first of a heap."""
    at = 0
    while 2 * at + 1 < size:
        below = 2 * at + 1
        if below + 1 < size and _worse(values, heap[below + 1], heap[below]):
            below += 1
        if not _worse(values, heap[below], position):
            break
        heap[at] = heap[below]
        at = below
    heap[at] = position


@compiled
def likeliest_relations(slopes, log_odds, log_counts, row, asked, least, opposites, count):
    """The best `count` relations between objects, by place: subject, object, relation.

    Args:
        slopes: (A, 4 + 2K), see `RelationSlopes`.
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
    found = relation_probability(slopes, log_odds.reshape(1, A, n * n), counts.reshape(-1), n)
    p = found.reshape(A, n, n)
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
def likeliest_places(slopes, forward, backward, log_counts, classes, count, first):
    """The best k places of each candidate, one candidate after the other.

    Place (d A + a) m + j is relation a to anchor j, or back if d = 1.

    Args:
        slopes: (A, 4 + 2K), see `RelationSlopes`.
        forward, backward: (N, A, m) log-odds of relations to the anchors, and of those back.
        log_counts: (m,).
        classes: how many distinct ones there are with the candidate.
        first: the place that is listed before all others, however likely; -1 for none.

    Returns:
        (N k,) the number of the candidate, the relation, whether it leads from the candidate to the
        anchor, the number of the anchor, and the probability.
    """
    N, A, m = forward.shape
    size = A * m
    to = relation_probability(slopes, forward, log_counts, classes)
    back = relation_probability(slopes, backward, log_counts, classes)
    p, usable = np.empty(2 * size, forward.dtype), np.ones(2 * size, np.bool_)
    kept, begin = min(count, 2 * size), 0
    if first >= 0:
        usable[first], begin = False, 1
    candidate, relation = np.empty(N * kept, np.int64), np.empty(N * kept, np.int64)
    outgoing, anchor = np.empty(N * kept, np.bool_), np.empty(N * kept, np.int64)
    probabilities = np.empty(N * kept, np.float64)
    for c in range(N):
        one, other = to[c].reshape(-1), back[c].reshape(-1)
        for e in range(size):
            p[e], p[size + e] = exclusive(one[e], other[e])
        where = best(p, usable, kept - begin)
        for k in range(kept):
            place, at = first if k < begin else where[k - begin], c * kept + k
            candidate[at], relation[at], anchor[at] = c, place // m % A, place % m
            outgoing[at], probabilities[at] = place < size, p[place]
    return candidate, relation, outgoing, anchor, probabilities


@compiled
def strongest(change, rows, count):
    """The places of the largest changes, of either sign, and these, (N, k) both.

    Args:
        change: (N, n).
        rows: (N,) the place of what is explained, which is no reason for itself; empty where
            nothing of it is among the n.
    """
    N, n = change.shape
    kept = min(count, n - (len(rows) > 0))
    places, values = np.empty((N, kept), np.int64), np.empty((N, kept), np.float64)
    usable = np.ones(n, np.bool_)
    for c in range(N):
        if len(rows):
            usable[rows[c]] = False
        where = best(np.abs(change[c]), usable, kept)
        if len(rows):
            usable[rows[c]] = True
        for k in range(kept):
            places[c, k], values[c, k] = where[k], change[c, where[k]]
    return places, values


def strongest_reasons(
    first: NDArray[np.int64],
    change: NDArray[np.floating[Any]],
    rows: NDArray[np.int64] | None = None,
) -> list[tuple[Because, ...]]:
    """The classes that change the log-odds of N others most, strongest first, for each of these.

    Of either sign; instances of a class are spoken of by the first.

    Args:
        first: (n,) the first object of each class present.
        change: (N, n) by each class present.
        rows: (N,) places of the explained classes among the n; None for absent classes.
    """
    rows = np.zeros(0, np.int64) if rows is None else rows
    places, values = strongest(change, rows, REASONS)
    found = entries(Because, first[places.reshape(-1)].tolist(), values.reshape(-1).tolist())
    kept = places.shape[1]
    return [tuple(found[k * kept : (k + 1) * kept]) for k in range(len(change))]


@compiled
def observed_pairs(triples, row, asked, classes, relations):
    """Pairs of objects between which something holds, (P,) each of what follows.

    Relations are numbers, a from subject to object and A + a back, and a set of them is their bits.

    Args:
        triples: (T, 3) relation, subject and object.
        row: (N,) the class of each object.
        asked: (N, N) ordered pairs; a pair asked either way counts.
        classes, relations: how many there are, n and A.

    Returns:
        Subject and object; what holds from the one to the other, and what between any two
        instances of their classes.
    """
    size = len(row)
    holds, of_classes = np.zeros((size, size), np.int64), np.zeros((classes, classes), np.int64)
    for t in range(len(triples)):
        a, x, y = triples[t, 0], triples[t, 1], triples[t, 2]
        holds[x, y] |= 1 << a
        holds[y, x] |= 1 << (relations + a)
        of_classes[row[x], row[y]] |= 1 << a
        of_classes[row[y], row[x]] |= 1 << (relations + a)
    found = np.empty((4, min(len(triples), size * size)), np.int64)
    pairs, forward = 0, (1 << relations) - 1
    for x in range(size):
        for y in range(x + 1, size):
            if holds[x, y] and (asked[x, y] or asked[y, x]):
                # Whose relation comes first: the lowest bit of what holds from x, and from y.
                one, other = holds[x, y] & forward, holds[y, x] & forward
                swapped = one == 0 or (other != 0 and (other & -other) < (one & -one))
                subject, object_ = (y, x) if swapped else (x, y)
                found[0, pairs], found[1, pairs] = subject, object_
                found[2, pairs] = holds[subject, object_]
                found[3, pairs] = of_classes[row[subject], row[object_]]
                pairs += 1
    return found[0, :pairs], found[1, :pairs], found[2, :pairs], found[3, :pairs]


@compiled
def disagreeing(slopes, forward, backward, log_counts, classes, holds, of_classes, least, count):
    """The `count` pairs whose likeliest relation exceeds those observed by the largest ratio.

    Args:
        slopes: (A, 4 + 2K), see `RelationSlopes`.
        forward, backward: (A, P) log-odds from subject to object, and back.
        log_counts: (P,) log of the instance pairs of both classes.
        classes: how many distinct ones the scene has.
        holds, of_classes: (P,) see `observed_pairs`; what either has is not expected.
        least: relations of a lower probability are left out.

    Returns:
        (k,) places, numbers of the expected relations, their probabilities, and those of the
        likeliest relations that hold.
    """
    A, P = forward.shape
    to = relation_probability(slopes, forward.reshape(1, A, P), log_counts, classes)[0]
    back = relation_probability(slopes, backward.reshape(1, A, P), log_counts, classes)[0]
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
    where = best(ratio, usable, count)
    return where, expected[where], likely[0][where], likely[1][where]


def significant(numbers: Sequence[float]) -> list[float]:
    """The same numbers to `DIGITS` significant digits."""
    values = np.array(numbers, dtype=np.float64)
    exact = _round(values)
    rounded: list[float] = values.tolist()
    if not exact:
        return [float(f"{value:.{DIGITS}g}") for value in rounded]
    return rounded


@compiled
def _round(values: NDArray[np.float64]) -> bool:
    """Round numbers in place; False if one is too small or too large for exact powers of ten."""
    exact = True
    for k in range(len(values)):
        size = np.abs(values[k])
        if 1e-16 < size < 1e5:
            shift = DIGITS - 1 - np.int64(np.floor(np.log10(size)))
            scale = _POWERS[shift]
            values[k] = np.rint(values[k] * scale) / scale
        elif size != 0.0:
            exact = False
    return exact
