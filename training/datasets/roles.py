"""Counts of the roles that pairs of classes have in words.

The table serves pairs whose boxes reach into each other. "The bin is under the desk" counts for the
bin. "The lamp is on the desk" does not count for the desk: its box does not reach into the lamp.

Words do not tell where the object is in the box: people say "on the shelf" of a book between two
boards. So the table reads "on" as "in" for larger objects that contain things: classes whose share
of "in" among "on" and "in" is at least `_CONTAINS`. Fridges, shelves and bathtubs contain things.
Beds and sofas do not: an object on them reaches into their box, because the box includes a
headboard or a back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from functools import cache
from typing import Final

import numpy as np

from app.scene import RoleCounts, Vocabulary
from app.scene.roles import IN, ON, UNDER
from training.datasets.records import AnnotatedObject, AnnotatedScene

_OF_KIN: Final = 0.5  # weight of a pair in which a class is replaced by its parent or its kind
# Share of "in" from which a class contains things. In the public data, shelf has .10 and chair .06.
_CONTAINS: Final = 0.08

_ROLES: Final = {"on-top": ON, "under": UNDER, "below": UNDER, "inside": IN}

Role = tuple[int, int, int]
"""A role, the class in this role, and the class of the larger object."""


def count_roles(scenes: Iterable[AnnotatedScene], vocabulary: Vocabulary) -> RoleCounts:
    """Count the roles that scenes state by listed relations.

    Each group of near-duplicate scenes counts once. A pair of classes also counts for its kin, with
    half the weight: pairs with the parent or a kind of a class. Structure has no roles.
    """
    index = cache(vocabulary.index)
    stated: set[tuple[str, str, Role]] = set()
    for scene in scenes:
        classes = [index(thing.label) for thing in scene.objects]
        for role, i, j in _stated_roles(scene):
            ends = classes[i], classes[j]
            if ends[0] is None or ends[1] is None or ends[0] == ends[1]:
                continue
            if not (vocabulary.structure[ends[0]] or vocabulary.structure[ends[1]]):
                stated.add((scene.source, scene.group, (role, ends[0], ends[1])))
    own = Counter(role for _, _, role in stated)
    return _table(own, vocabulary)


def _stated_roles(scene: AnnotatedScene) -> Iterable[Role]:
    """Yield role, index of the object in this role and index of the larger object."""
    for subject, relation, anchor in scene.relations or ():
        if relation in _ROLES:
            yield _ROLES[relation], subject, anchor
        elif relation == "contains":
            yield IN, anchor, subject


def lift_of(thing: AnnotatedObject, support: AnnotatedObject) -> float | None:
    """Return the bottom of an object minus the top of its support, in metres, or None."""
    if not (thing.position and thing.size and support.position and support.size):
        return None
    return (thing.position[2] - thing.size[2] / 2) - (support.position[2] + support.size[2] / 2)


def _table(own: Counter[Role], vocabulary: Vocabulary) -> RoleCounts:
    V = len(vocabulary)
    kin = _kin(vocabulary)
    pairs: dict[int, np.ndarray] = {}
    anchor = np.zeros((V, 3), np.float32)
    for (role, i, j), count in own.items():
        for k in kin[i]:
            for m in kin[j]:
                weight = 1.0 if (k, m) == (i, j) else _OF_KIN
                row = pairs.setdefault(k * V + m, np.zeros(3, np.float32))
                row[role] += weight * count
        for m in kin[j]:
            anchor[m, role] += (1.0 if m == j else _OF_KIN) * count
    keys = np.array(sorted(pairs), np.int64)
    counts = np.zeros((len(keys), 3), np.float32)
    for number, key in enumerate(keys.tolist()):
        counts[number] = pairs[key]
    contains = anchor[:, IN] >= _CONTAINS * np.maximum(anchor[:, ON] + anchor[:, IN], 1)
    for table, rows in ((anchor, contains), (counts, contains[keys % V])):
        table[rows, IN] += table[rows, ON]
        table[rows, ON] = 0
    return RoleCounts(keys, counts, anchor)


def _kin(vocabulary: Vocabulary) -> list[list[int]]:
    """Return each class with its parent and its kinds."""
    kin = [[i] for i in range(len(vocabulary))]
    for i, parent in enumerate(vocabulary.parents.tolist()):
        if parent >= 0:
            kin[i].append(parent)
            kin[parent].append(i)
    return kin
