"""Counts of the roles that pairs of classes have in words.

The table serves pairs whose boxes reach into each other. "The bin is under the desk" counts for the
bin. "The lamp is on the desk" does not count for the desk: its box does not reach into the lamp.

People say "on the shelf" of a book between two boards. So the table reads "on" as "in" for larger
objects that contain things: classes whose share of "in" among "on" and "in" is at least
`_CONTAINS`, such as fridges, shelves and bathtubs, but not beds and sofas.
"""

from __future__ import annotations

from collections import Counter, defaultdict
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

_ROLES: Final = {"on-top": ON, "under": UNDER, "below": UNDER, "inside": IN, "contains": IN}

Role = tuple[int, int, int]  # role, the class in this role, and the class of the larger object


def count_roles(scenes: Iterable[AnnotatedScene], vocabulary: Vocabulary) -> RoleCounts:
    """Count the roles in listed relations, once in each group of near-duplicate scenes."""
    index = cache(vocabulary.index)
    stated: set[tuple[str, str, Role]] = set()
    for scene in scenes:
        classes = [index(thing.label) for thing in scene.objects]
        for subject, relation, anchor in scene.relations or ():
            small, large = (anchor, subject) if relation == "contains" else (subject, anchor)
            role, i, j = _ROLES.get(relation), classes[small], classes[large]
            if role is None or i is None or j is None or i == j:
                continue
            if not vocabulary.structure[[i, j]].any():
                stated.add((scene.source, scene.group, (role, i, j)))
    return _table(Counter(role for _, _, role in stated), vocabulary)


def lift_of(thing: AnnotatedObject, support: AnnotatedObject) -> float | None:
    """Return the bottom of an object minus the top of its support, in metres, or None."""
    if not (thing.position and thing.size and support.position and support.size):
        return None
    return (thing.position[2] - thing.size[2] / 2) - (support.position[2] + support.size[2] / 2)


def _table(stated: Counter[Role], vocabulary: Vocabulary) -> RoleCounts:
    """Count the roles of each pair (key i V + j) and each larger class j, also for their kin."""
    V, kin = len(vocabulary), _kin(vocabulary)
    pairs: defaultdict[int, np.ndarray] = defaultdict(lambda: np.zeros(3, np.float32))
    anchor = np.zeros((V, 3), np.float32)
    for (role, i, j), count in stated.items():
        for large in kin[j]:
            anchor[large, role] += (1.0 if large == j else _OF_KIN) * count
            for small in kin[i]:
                weight = 1.0 if (small, large) == (i, j) else _OF_KIN
                pairs[small * V + large][role] += weight * count
    keys = np.array(sorted(pairs), np.int64)
    counts = np.array([pairs[key] for key in keys.tolist()], np.float32).reshape(-1, 3)
    contains = anchor[:, IN] >= _CONTAINS * np.maximum(anchor[:, ON] + anchor[:, IN], 1)
    for table, rows in ((anchor, contains), (counts, contains[keys % V])):
        table[rows, IN] += table[rows, ON]  # "on" means "in" for classes that contain things
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
