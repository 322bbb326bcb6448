"""Ranking: the best entries of an answer."""

import numpy as np

from app.compiling import compiled


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
