"""Ranking of the candidates for the entries of an answer."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled


@compiled
def best(
    values: Float[NDArray, " N"], usable: Bool[NDArray, " N"], count: int
) -> Int[NDArray, " k"]:
    """Return the indices of the k <= `count` largest usable values, largest first.

    Of equal values, the value with the lower index comes first. The time is O(N log count).
    """
    size, rest, kept = 0, 0, min(count, len(values))
    # The heap contains the best indices so far. Its root is the worst of these indices: the index
    # with the smallest value, and of several equal values the largest index.
    heap = np.empty(kept, np.int64)
    while size < kept and rest < len(values):
        if usable[rest]:
            heap[size] = rest
            size += 1
        rest += 1
    for node in range(size // 2 - 1, -1, -1):
        _sink(values, heap, size, node, heap[node])
    for index in range(rest, len(values)):
        if size and usable[index] and values[index] > values[heap[0]]:
            _sink(values, heap, size, 0, index)
    for last in range(size - 1, 0, -1):
        worst, moved = heap[0], heap[last]
        _sink(values, heap, last, 0, moved)
        heap[last] = worst
    return heap[:size]


@compiled
def _sink(
    values: Float[NDArray, " N"], heap: Int[NDArray, " k"], size: int, node: int, index: int
) -> None:
    """Replace a node of the heap by an index, and restore the heap order below the node."""
    value = values[index]
    while 2 * node + 1 < size:
        child = 2 * node + 1
        if child + 1 < size:
            one, other = heap[child], heap[child + 1]
            if values[other] < values[one] or (values[other] == values[one] and other > one):
                child += 1
        worse = heap[child]
        if not (values[worse] < value or (values[worse] == value and worse > index)):
            break
        heap[node] = worse
        node = child
    heap[node] = index
