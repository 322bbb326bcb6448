"""Counts of roles for tests, written as a table."""

from collections.abc import Mapping

import numpy as np

from app.scene.roles import IN, ON, UNDER, RoleCounts

ROLES = {ON: "on", UNDER: "under", IN: "in"}
LABELS = (
    *("bed", "bin", "book", "chair", "cushion", "desk", "fridge", "lamp", "milk", "monitor"),
    *("pillow", "shelf", "slippers", "sofa", "table", "towel", "bathtub"),
)
V = len(LABELS)
DESK, LAMP, SHELF = (LABELS.index(label) for label in ("desk", "lamp", "shelf"))

Counts = Mapping[tuple[int, int], tuple[int, ...]]
"""How often the first class is on, under and in the second."""


def role_counts(table: Counts) -> RoleCounts:
    """The roles at a class are those of all pairs with this class."""
    pairs = sorted(table)
    anchor = np.zeros((V, 3), np.float32)
    for _, j in pairs:
        anchor[j] = sum(np.array(table[pair]) for pair in pairs if pair[1] == j)
    rows = np.array([table[pair] for pair in pairs], np.float32).reshape(-1, 3)
    return RoleCounts(np.array([i * V + j for i, j in pairs], np.int64), rows, anchor)
