"""The best of many, in an order that never depends on chance."""

from __future__ import annotations

import numpy as np

from app.compiling import compiled


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
