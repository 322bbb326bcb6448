"""Compiled loops that rank the entries of answers, ties by position, and round their numbers."""

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

# These doubles are exact. So an integer divided by one of them is the double nearest to the decimal
# number.
_POWERS: Final = np.array([10.0**power for power in range(23)])


TupleT = TypeVar("TupleT", bound=tuple[Any, ...])


REASONS: Final = 3
"""Maximum number of reasons for one entry of an answer."""

EXPLAINED: Final = 32
"""Only the first entries of an answer, at most this many, have reasons."""


class Because(NamedTuple):
    """A reason: how much the presence of `object` changes the log-odds of the judged class."""

    object: int
    log_odds_change: float


def entries(kind: type[TupleT], *columns: Iterable[Any]) -> list[TupleT]:
    """Make named tuples from columns of fields, in half the time of calls to the class."""
    return list(map(partial(tuple.__new__, kind), zip(*columns, strict=True)))


@compiled
def best(values, usable, count):
    """Positions of the `count` largest usable values, largest first, ties by position.

    The time is O(N log count).

    Args:
        values: (N,).
        usable: (N,) bool.

    Returns:
        At most `count` positions.
    """
    size, kept = 0, min(count, len(values))
    # A heap of the best positions so far. Its root is the worst of them: the smallest value, and
    # the last position among equal values.
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
    """Whether position `one` ranks after position `other`."""
    return values[one] < values[other] or (values[one] == values[other] and one > other)


@compiled
def _sink(values, heap, size, position):
    """Replace the root of a heap by a position, and restore the heap."""
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
    """The `count` likeliest relations between objects, likeliest first, ties by position.

    Args:
        slopes: (A, 4 + 2K), see `RelationSlopes`.
        log_odds: (A, n, n) log-odds of the relations between classes.
        log_counts: (n,) log of the number of instances of each class.
        row: (N,) index of each object's class among the n classes.
        asked: (N, N) bool, the ordered pairs to answer.
        least: relations of a lower probability are left out.
        opposites: whether to add, as relation A + a, relation a from object to subject.

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
    """The k likeliest places of each candidate, one candidate after the other.

    Place (d A + a) m + j stands for relation a and anchor j. The candidate is the subject if d = 0;
    the anchor is the subject if d = 1.

    Args:
        slopes: (A, 4 + 2K), see `RelationSlopes`.
        forward, backward: (N, A, m) log-odds of relations from the candidates to the anchors, and
            from the anchors to the candidates.
        log_counts: (m,) log of the number of instances of each anchor's class.
        classes: number of distinct classes in the scene, the candidate included.
        count: maximum of k.
        first: the place that is listed first, however likely; -1 for none.

    Returns:
        Five arrays (N k,): number of the candidate, relation, whether the candidate is its subject,
        number of the anchor, and probability.
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
    """Indices and values of the largest changes of either sign, each (N, k).

    Args:
        change: (N, n) changes of N explained classes by the n classes of the scene.
        rows: (N,) index of each explained class among the n classes, which is skipped; empty if the
            explained classes are absent.
        count: maximum of k.
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
    """The reasons for each of N explained classes: the largest changes of either sign, first.

    A reason names the first object of its class.

    Args:
        first: (n,) position of the first object of each class of the scene.
        change: (N, n) changes of the explained classes' log-odds by each class of the scene.
        rows: (N,) indices of the explained classes among the n; None for absent classes.
    """
    rows = np.zeros(0, np.int64) if rows is None else rows
    places, values = strongest(change, rows, REASONS)
    found = entries(Because, first[places.reshape(-1)].tolist(), values.reshape(-1).tolist())
    kept = places.shape[1]
    return [tuple(found[k * kept : (k + 1) * kept]) for k in range(len(change))]


@compiled
def observed_pairs(triples, row, asked, classes, relations):
    """Pairs of objects with at least one observed relation, with the relations as bit sets.

    Bit a stands for relation a from subject to object. Bit A + a stands for relation a from object
    to subject.

    Args:
        triples: (T, 3) relation, subject and object.
        row: (N,) index of each object's class among the n classes.
        asked: (N, N) bool, the ordered pairs to answer; a pair counts in either order.
        classes, relations: the numbers n and A.

    Returns:
        Four arrays (P,): subject, object, relations of the pair, and relations between any
        instances of the two classes.
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
                # The subject is the object whose first relation, its lowest bit, has the lower
                # number.
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
    """The `count` pairs with the largest ratio of expected to observed probability.

    The expected relation of a pair is its likeliest relation. The observed probability is that of
    the likeliest observed relation. A pair counts only if its expected relation is unobserved, both
    for the pair and for its classes.

    Args:
        slopes: (A, 4 + 2K), see `RelationSlopes`.
        forward, backward: (A, P) log-odds from subject to object, and from object to subject.
        log_counts: (P,) log of the number of instance pairs of both classes.
        classes: number of distinct classes in the scene.
        holds, of_classes: (P,) relations of the pair and of its classes, see `observed_pairs`.
        least: smallest probability of an expected relation.

    Returns:
        Four arrays (k,): index of the pair, number of the expected relation, its probability, and
        the observed probability.
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
    """Round numbers to `DIGITS` significant digits."""
    values = np.array(numbers, dtype=np.float64)
    exact = _round(values)
    rounded: list[float] = values.tolist()
    if not exact:
        return [float(f"{value:.{DIGITS}g}") for value in rounded]
    return rounded


@compiled
def _round(values: NDArray[np.float64]) -> bool:
    """Round numbers in place.

    Returns:
        False if a number is too small or too large for exact powers of ten; it stays unchanged.
    """
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
