"""What a scene tells a model of classes.

Models speak of classes, scenes of instances: r[a, x, y] says that *some* instance of class x stands
in relation a to some instance of class y. A pair of instances that is not listed never makes it
false.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

A = len(CANONICAL)
Places = NDArray[np.int64]


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
    labels = np.asarray(classes, dtype=np.int64)
    distinct, _, row, counts, present = pool_classes(labels, np.asarray(confidence, np.float64))
    on, seen = pooled(row, len(distinct), holds, observed)
    return ClassEvidence(distinct, counts, present, on, seen, room_type)


@compiled
def pool_classes(
    classes: NDArray[np.int64], confidence: NDArray[np.float64]
) -> tuple[Places, Places, Places, Places, NDArray[np.float64]]:
    """The n distinct classes of N instances, ascending.

    Returns:
        The classes, the first instance of each, the place of each instance's class (N,), how many
        instances each has, and the probability that at least one is there.
    """
    distinct, row = np.empty(len(classes), np.int64), np.empty(len(classes), np.int64)
    counts, first = np.zeros(len(classes), np.int64), np.empty(len(classes), np.int64)
    absent, n = np.ones(len(classes), np.float64), 0
    for instance in np.argsort(classes, kind="mergesort"):
        if n == 0 or distinct[n - 1] != classes[instance]:
            distinct[n], first[n] = classes[instance], instance
            n += 1
        row[instance] = n - 1
        counts[n - 1] += 1
        absent[n - 1] *= 1.0 - confidence[instance]
    return distinct[:n], first[:n], row, counts[:n], 1.0 - absent[:n]


@compiled
def pooled(
    row: NDArray[np.int64], n: int, holds: NDArray[np.bool_], observed: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Relations of instances (A, N, N), which hold and which were observed, by class, (A, n, n).

    Args:
        row: (N,) the class of each instance, of n.
    """
    size = len(row)
    on, seen = np.zeros((A, n, n), np.bool_), np.zeros((A, n, n), np.bool_)
    for a in range(A):
        for i in range(size):
            for j in range(size):
                if i != j and (holds[a, i, j] or observed[a, i, j]):
                    seen[a, row[i], row[j]] = True
                    on[a, row[i], row[j]] |= holds[a, i, j]
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
