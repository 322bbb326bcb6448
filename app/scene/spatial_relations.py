"""The ten spatial relations and their five canonical forms.

A relation and its opposite are the same statement with exchanged objects: ``right(i, j)`` is
``left(j, i)``. So scenes store only the five relations in `CANONICAL`. A relation index is an index
into `CANONICAL`. The first argument of a relation is its subject, and the second is its anchor.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from graphlib import CycleError, TopologicalSorter
from typing import Final, TypeVar

import numpy as np
from jaxtyping import Bool, Int
from numpy.typing import NDArray

from app.compiling import compiled

LEFT, FRONT, ON_TOP, ABOVE, INSIDE = 0, 1, 2, 3, 4  # indices of the canonical relations

CANONICAL: Final[tuple[str, ...]] = ("left", "front", "on-top", "above", "inside")
OPPOSITES: Final[dict[str, str]] = {
    "left": "right", "front": "behind", "on-top": "under", "above": "below", "inside": "contains",
}  # fmt: skip
RELATIONS: Final[tuple[str, ...]] = CANONICAL + tuple(OPPOSITES[name] for name in CANONICAL)

# Indices of groups of relations:
LATERAL: Final = (LEFT, FRONT)  # of neighbours that stand beside each other
VERTICAL: Final = (ON_TOP, ABOVE)  # of an object to an object under it
SUPPORTS: Final = (ON_TOP, INSIDE)  # of an object to the object that it stands on or in
STACKED: Final = (ON_TOP, ABOVE, INSIDE)  # of two objects with overlapping footprints

HOLDS: Final = 0.5  # minimum probability of a relation that holds
POSSIBLE: Final = 0.01  # minimum probability of a relation that boxes do not exclude

_NUMBER: Final = {name: number for number, name in enumerate(RELATIONS)}


def relation_names(A: int) -> tuple[str, ...]:
    """Return the names of the first A canonical relations, then of their opposites."""
    return CANONICAL[:A] + RELATIONS[len(CANONICAL) : len(CANONICAL) + A]


End = TypeVar("End", bound=Hashable)


def _number(relation: str) -> int:
    """Return the index in `RELATIONS`."""
    try:
        return _NUMBER[relation]
    except KeyError:
        names = ", ".join(RELATIONS)
        raise ValueError(f"unknown relation {relation!r}; it must be one of {names}") from None


def opposite(relation: str) -> str:
    """Return the opposite relation: ``opposite("left") == "right"``.

    Raises:
        ValueError: the relation is not one of the ten `RELATIONS`.
    """
    return RELATIONS[(_number(relation) + len(CANONICAL)) % len(RELATIONS)]


def canonicalise(subject: End, relation: str, anchor: End) -> tuple[int, End, End]:
    """Return a statement in canonical form: (relation index, subject, anchor).

    For the opposites of `CANONICAL`, the function exchanges subject and anchor.

    Raises:
        ValueError: the relation is not one of the ten `RELATIONS`.
    """
    number = _number(relation)
    if number < len(CANONICAL):
        return number, subject, anchor
    return number - len(CANONICAL), anchor, subject


def support_cycle(triples: Iterable[tuple[int, End, End]]) -> list[End] | None:
    """Return objects in a circle, each on or in the next and the last one first again, or None."""
    below: dict[End, list[End]] = {}
    for relation, subject, anchor in triples:
        if relation in SUPPORTS:
            below.setdefault(subject, []).append(anchor)
    try:
        TopologicalSorter(below).prepare()
    except CycleError as error:
        circle: list[End] = error.args[1]
        return circle[::-1]
    return None


@compiled
def pool_relations(
    row: Int[NDArray, " N"], n: int, holds: Bool[NDArray, "A N N"], observed: Bool[NDArray, "A N N"]
) -> tuple[Bool[NDArray, "A n n"], Bool[NDArray, "A n n"]]:
    """Return which relations hold, and are observed, between any instances of n classes, `row`."""
    A, size, _ = holds.shape
    class_holds, class_observed = np.zeros((A, n, n), np.bool_), np.zeros((A, n, n), np.bool_)
    for a in range(A):
        for i in range(size):
            for j in range(size):
                if i != j and (holds[a, i, j] or observed[a, i, j]):
                    class_observed[a, row[i], row[j]] = True
                    class_holds[a, row[i], row[j]] |= holds[a, i, j]
    return class_holds, class_observed
