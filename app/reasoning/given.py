"""The relations between classes that a scene states or shows, of those the machine knows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.boltzmann.closed_form import Given
from app.compiling import compiled
from app.reasoning.present import Present
from app.scene.evidence import class_evidence
from app.scene.scene import Scene


def given_relations(scene: Scene, present: Present, relations: int) -> Given | None:
    """What `class_evidence` observes, as lists; None where the scene says nothing of relations.

    Args:
        relations: how many the machine knows.
    """
    if scene.poses is None and not scene.relations and not scene.relations_complete:
        return None
    found = class_evidence(scene)
    return Given(*_lists(found.holds[:relations], found.observed[:relations], present.presence))


@compiled
def _lists(
    holds: NDArray[np.bool_], observed: NDArray[np.bool_], presence: NDArray[np.float32]
) -> tuple[Any, ...]:
    """See `Given`, for (A, n, n) both."""
    size = np.count_nonzero(observed)
    a, i, j = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    r, g = np.empty(size, np.float32), np.empty(size, np.float32)
    A, n = observed.shape[:2]
    e = 0
    for b in range(A):
        for x in range(n):
            for y in range(n):
                if observed[b, x, y]:
                    a[e], i[e], j[e] = b, x, y
                    r[e], g[e] = holds[b, x, y], presence[x] * presence[y]
                    e += 1
    return a, i, j, r, g
