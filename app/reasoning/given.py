"""The relations between classes that a scene states or shows, of those the machine knows.

What `app.scene.evidence.class_evidence` says, as lists and in one loop: a relation of two classes
is on if it holds for one pair of instances, and off if it was observed and holds for none.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from app.boltzmann.closed_form import Given
from app.compiling import compiled
from app.reasoning.present import Present
from app.scene.scene import Scene

Mask: TypeAlias = NDArray[np.bool_]
Places: TypeAlias = NDArray[np.int64]
States: TypeAlias = NDArray[np.int8]


def given_relations(scene: Scene, present: Present, relations: int) -> Given | None:
    """None where the scene says nothing of relations.

    Args:
        relations: how many the machine knows.
    """
    if scene.poses is not None:
        state = _shown(scene.poses.holds, scene.poses.observed, present.row, len(present.classes))
    elif scene.relations or scene.relations_complete:
        triples = np.array(scene.relations, dtype=np.int64).reshape(-1, 3)
        state = _stated(triples, scene.relations_complete, present.row, present.counts, relations)
    else:
        return None
    return Given(*_lists(state[:relations], present.presence))


@compiled
def _shown(holds: Mask, observed: Mask, row: Places, n: int) -> States:
    """1 off, 2 on, 0 neither, (A, n, n), of what instances show (A, N, N)."""
    A, N = holds.shape[:2]
    state = np.zeros((A, n, n), np.int8)
    for a in range(A):
        for x in range(N):
            for y in range(N):
                if x != y and (holds[a, x, y] or observed[a, x, y]):
                    i, j = row[x], row[y]
                    state[a, i, j] = max(state[a, i, j], 1 + holds[a, x, y])
    return state


@compiled
def _stated(triples: Places, complete: bool, row: Places, counts: Places, relations: int) -> States:
    """The same of what is stated of instances, (T, 3)."""
    n = len(counts)
    state = np.zeros((relations, n, n), np.int8)
    if complete:
        state[:] = 1
        for i in range(n):
            # A class of one instance has no pair with itself.
            if counts[i] < 2:
                state[:, i, i] = 0
    for t in range(len(triples)):
        if triples[t, 0] < relations:
            state[triples[t, 0], row[triples[t, 1]], row[triples[t, 2]]] = 2
    return state


@compiled
def _lists(state: States, presence: NDArray[np.float32]) -> tuple[Any, ...]:
    """See `Given`."""
    size = np.count_nonzero(state)
    a, i, j = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    r, g = np.empty(size, np.float32), np.empty(size, np.float32)
    A, n = state.shape[:2]
    e = 0
    for b in range(A):
        for x in range(n):
            for y in range(n):
                if state[b, x, y]:
                    a[e], i[e], j[e] = b, x, y
                    r[e], g[e] = state[b, x, y] == 2, presence[x] * presence[y]
                    e += 1
    return a, i, j, r, g
