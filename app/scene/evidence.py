"""Conversion of the instances (objects) of a scene to evidence about object classes.

Scenes contain instances, but models only know classes. A relation is on if it holds, and off if it
was observed not to hold. Relation a between classes x and y is on if at least one instance of x has
relation a to an instance of y. Pairs of instances without an observed relation have no influence.
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
    """The n distinct classes of a scene and their observed relations.

    Attributes:
        classes: (n,) int64, distinct indices of the classes, in ascending order.
        counts: (n,) int64, number of instances of each class.
        confidence: (n,) float64 in (0, 1], probability that at least one instance of the class
            exists.
        holds: (A, n, n) bool, True for relations that hold. ``holds[a, x, y]`` means that
            classes[x] has relation a to classes[y].
        observed: (A, n, n) bool, True for relations that were observed, whether they hold or not.
            ``holds`` implies ``observed``.
        room_type: index of the room type, or None if the room type is unknown.
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
    """Pool the instances of each class by a logical OR.

    A relation between classes is on if the relation holds for at least one pair of instances. The
    relation is off if it was observed for at least one pair, but holds for none. Otherwise the
    relation is unobserved. If a class has a single instance, the relations between the class and
    itself stay unobserved.

    Args:
        classes: (N,) index of the class of each instance.
        confidence: (N,) probability that the instance exists. Instances count as independent
            detections, so a class exists with probability 1 - prod(1 - confidence).
        holds: (A, N, N) bool, True for relations between instances that hold.
        observed: (A, N, N) bool, True for relations between instances that were observed, whether
            they hold or not.
        room_type: index of the room type, or None if the room type is unknown.

    Raises:
        ValueError: the shapes do not match.
    """
    size = len(classes)
    for name, array in (("holds", holds), ("observed", observed)):
        if array.shape != (A, size, size):
            raise ValueError(f"{name} must have the shape {(A, size, size)}, not {array.shape}")
    if confidence.shape != (size,):
        raise ValueError(f"confidence must have the shape {(size,)}, not {confidence.shape}")
    labels = np.asarray(classes, dtype=np.int64)
    distinct, _, row, counts, present = pool_classes(labels, np.asarray(confidence, np.float64))
    on, seen = pooled(row, len(distinct), holds, observed)
    return ClassEvidence(distinct, counts, present, on, seen, room_type)


@compiled
def pool_classes(
    classes: NDArray[np.int64], confidence: NDArray[np.float64]
) -> tuple[Places, Places, Places, Places, NDArray[np.float64]]:
    """Return the n distinct classes of N instances.

    Returns:
        Class indices in ascending order, (n,).
        Index of the first instance of each class, (n,).
        For each instance, index of its class in the first array, (N,).
        Number of instances of each class, (n,).
        Probability that at least one instance of each class exists, (n,).
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
    """Pool the relations of instances (A, N, N) into relations of classes (A, n, n).

    Args:
        row: (N,) index of each instance's class, from 0 to n - 1.
        n: number of classes.
        holds: (A, N, N) bool, True for relations between instances that hold.
        observed: (A, N, N) bool, True for relations between instances that were observed.

    Returns:
        The arrays ``holds`` and ``observed`` of `ClassEvidence`, each (A, n, n).
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
    """Return the evidence of a scene about its classes.

    Instances whose label is outside the vocabulary are left out. If the scene has poses,
    ``scene.poses`` defines which relations hold and which are observed. Otherwise, stated relations
    are on. Relations that are not stated are off if ``scene.relations_complete`` is True, and
    unobserved otherwise.
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
    """Return which relations between the N instances of a scene hold, and which are observed.

    Both bool arrays have the shape (A relations, N subjects, N objects).
    """
    if scene.poses is not None:
        return scene.poses.holds, scene.poses.observed
    size = len(scene.objects)
    holds = np.zeros((A, size, size), dtype=np.bool_)
    if scene.relations:
        holds[tuple(np.array(scene.relations).T)] = True
    return holds, np.full((A, size, size), scene.relations_complete)
