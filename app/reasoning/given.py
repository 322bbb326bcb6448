"""The relations between classes that a scene states or shows, of those the machine knows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.closed_form import Pull
from app.inference.relation_part import Given
from app.reasoning.present import Present
from app.registry.description import EvidenceWeights
from app.scene.evidence import instance_evidence, pooled
from app.scene.scene import Scene


def given_relations(scene: Scene, present: Present, relations: int) -> Given | None:
    """What is observed, by class, as lists; None where the scene says nothing of relations.

    Args:
        relations: how many the machine knows.
    """
    if scene.poses is None and not scene.relations and not scene.relations_complete:
        return None
    holds, observed = instance_evidence(scene)
    return Given(*_lists(present.row, present.presence, holds, observed, relations))


def pull_of(scene: Scene, weights: EvidenceWeights) -> Pull:
    """How strongly the relations of a scene act on the context."""
    if scene.poses is None:
        return Pull(weights.relations_on_objects, weights.relations_on_relations)
    return Pull(weights.poses_on_objects, weights.poses_on_relations)


@compiled
def _lists(
    row: NDArray[np.int64],
    presence: NDArray[np.float32],
    instances_hold: NDArray[np.bool_],
    instances_observed: NDArray[np.bool_],
    relations: int,
) -> tuple[Any, ...]:
    """See `Given`, for (A, N, N) both."""
    on, seen = pooled(row, len(presence), instances_hold, instances_observed)
    holds, observed = on[:relations], seen[:relations]
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
