"""What a scene tells a model of classes.

Models speak of classes, scenes of instances: r[a, x, y] says that *some* instance of class x stands
in relation a to some instance of class y. A pair of instances nobody listed never makes it false.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

A = len(CANONICAL)


@dataclass(frozen=True, slots=True, eq=False)
class ClassEvidence:
    """The n distinct classes of a scene and what is known of their relations.

    Attributes:
        classes: (n,) int64, ascending, distinct.
        counts: (n,) int64, instances of each class.
        confidence: (n,) float64 in (0, 1], probability that at least one instance is there.
        holds: (A, n, n) bool, observed on. ``holds[a, x, y]``: classes[x] stands so to classes[y].
        observed: (A, n, n) bool, observed on or off; ``holds`` implies ``observed``.
        room_type: index of the room type, or None.
    """

    classes: NDArray[np.int64]
    counts: NDArray[np.int64]
    confidence: NDArray[np.float64]
    holds: NDArray[np.bool_]
    observed: NDArray[np.bool_]
    room_type: int | None


def pool_instances(
    classes: NDArray[np.int64],
    confidence: NDArray[np.float64],
    holds: NDArray[np.bool_],
    observed: NDArray[np.bool_],
    room_type: int | None = None,
) -> ClassEvidence:
    """OR over instances.

    A class-level relation is on if it holds for one pair of instances; it is observed off if it
    was observed for at least one pair and holds for none; otherwise it is unobserved. A class with
    a single instance has no pair with itself: its (x, x) relations stay unobserved.

    Args:
        classes: (N,) class of each instance.
        confidence: (N,) probability that the instance is there. Instances are taken as independent
            detections: a class is there with probability 1 - prod(1 - confidence).
        holds: (A, N, N) relations that hold between instances.
        observed: (A, N, N) relations of instances that were observed, on or off.
        room_type: passed through.

    Raises:
        ValueError: shapes that do not fit each other.
    """
    size = len(classes)
    for name, array in (("holds", holds), ("observed", observed)):
        if array.shape != (A, size, size):
            raise ValueError(f"{name} has shape {array.shape}, must be {(A, size, size)}")
    if confidence.shape != (size,):
        raise ValueError(f"confidence has shape {confidence.shape}, must be {(size,)}")
    labels = np.asarray(classes, dtype=np.int64, order="C")
    sure = np.asarray(confidence, dtype=np.float64, order="C")
    distinct, counts, present, on, seen = _pool(
        labels, sure, np.ascontiguousarray(holds), np.ascontiguousarray(observed)
    )
    return ClassEvidence(distinct, counts, present, on, seen, room_type)


@compiled
def _pool(classes, confidence, holds, observed):
    """The fields of the evidence, less the room type."""
    size = len(classes)
    distinct = np.unique(classes)
    n = len(distinct)
    row = np.searchsorted(distinct, classes)
    counts, absent = np.zeros(n, np.int64), np.ones(n)
    for i in range(size):
        counts[row[i]] += 1
        absent[row[i]] *= 1.0 - confidence[i]
    on, seen = pooled(row, n, holds, observed)
    return distinct, counts, 1.0 - absent, on, seen


@compiled
def pooled(row, n, holds, observed):
    """Relations of instances (A, N, N), which hold and which were observed, by class, (A, n, n).

    Args:
        row: (N,) the class of each instance, of n.
    """
    size = len(row)
    on, seen = np.zeros((A, n, n), np.bool_), np.zeros((A, n, n), np.bool_)
    for a in range(A):
        for i in range(size):
            for j in range(size):
                if i == j:
                    continue
                if holds[a, i, j]:
                    on[a, row[i], row[j]] = seen[a, row[i], row[j]] = True
                elif observed[a, i, j]:
                    seen[a, row[i], row[j]] = True
    return on, seen


def class_evidence(scene: Scene) -> ClassEvidence:
    """The evidence a scene gives; instances outside the vocabulary are left out.

    Relations derived from poses (``scene.poses``) are on or off for neighbours and unobserved
    beyond. Relations that were given are on; all others are unobserved, or off where the scene says
    that its relations are complete.
    """
    kept = [i for i, thing in enumerate(scene.objects) if thing.class_index is not None]
    size = len(kept)
    classes = np.array([scene.objects[i].class_index for i in kept], dtype=np.int64)
    confidence = np.array([scene.objects[i].confidence for i in kept], dtype=np.float64)
    holds, observed = instance_evidence(scene)
    if size < len(scene.objects):
        holds, observed = holds[:, kept][:, :, kept], observed[:, kept][:, :, kept]
    return pool_instances(classes, confidence, holds, observed, scene.room_type)


def instance_evidence(scene: Scene) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which relations hold between the N instances of a scene, and which are known, (A, N, N)."""
    if scene.poses is not None:
        return scene.poses.holds, scene.poses.observed
    size = len(scene.objects)
    holds = np.zeros((A, size, size), dtype=np.bool_)
    if scene.relations:
        holds[tuple(np.array(scene.relations).T)] = True
    return holds, np.full((A, size, size), scene.relations_complete)
