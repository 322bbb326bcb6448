"""Which of the relations that were drawn a scene can have, all at once."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.scene.relations import ABOVE, FRONT, LEFT, ON_TOP

Triple = tuple[int, int, int]

# The direction of each relation: a thing on top of another is higher, as one above it is.
_DIRECTION: Final = {ON_TOP: 0, ABOVE: 0, LEFT: 1, FRONT: 2}


def staying(
    units: NDArray[np.int64],
    logits: NDArray[np.floating[Any]],
    given: Collection[Triple],
    structure: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Which of the drawn relations stay, (m,).

    Those that are given do. The others are taken from the likeliest on. One stays if

    - its two classes have no relation yet (`app.scene.geometry` finds at most one),
    - it closes no circle, such as A left of B, B left of C, C left of A,
    - its first class has no other support yet, where it is *on-top*.

    A class stands in no relation to itself. Structure stands in none: training drops its relations,
    so those that are drawn have no meaning.

    Args:
        units: (m, 3) distinct (a, i, j) over classes.
        logits: (m,) of each; where two are equal, the smaller (a, i, j) comes first.
        given: (a, i, j) over classes.
        structure: (V,) which classes are.
    """
    order = np.lexsort((*units.T[::-1], -logits))
    holding = _Holding()
    for triple in given:
        holding.add(triple)
    stay = np.zeros(len(units), dtype=np.bool_)
    possible = (units[:, 1] != units[:, 2]) & ~structure[units[:, 1:]].any(axis=1)
    triples: list[Triple] = [(a, i, j) for a, i, j in units.tolist()]
    for k in order[possible[order]].tolist():
        if holding.admits(triples[k]):
            holding.add(triples[k])
            stay[k] = True
    return stay | np.array([triple in given for triple in triples], dtype=np.bool_)


class _Holding:
    """Relations that hold, and which classes lie beyond each in each of three directions.

    Classes have places in the order they come in. Those beyond a class are the bits of a number.
    """

    def __init__(self) -> None:
        self._related: set[tuple[int, int]] = set()
        self._supported: set[int] = set()
        self._places: dict[int, int] = {}
        self._beyond: tuple[list[int], list[int], list[int]] = ([], [], [])

    def admits(self, triple: Triple) -> bool:
        """Whether it can hold together with those that were added."""
        a, i, j = triple
        if (i, j) in self._related or (a == ON_TOP and i in self._supported):
            return False
        x, y = self._place(i), self._place(j)
        return not self._beyond[_DIRECTION[a]][y] >> x & 1

    def add(self, triple: Triple) -> None:
        """Note that it holds, and everything that follows for what lies beyond what."""
        a, i, j = triple
        x, y = self._place(i), self._place(j)
        self._related |= {(i, j), (j, i)}
        if a == ON_TOP:
            self._supported.add(i)
        beyond = self._beyond[_DIRECTION[a]]
        more = beyond[y] | 1 << y
        for k, own in enumerate(beyond):
            if k == x or own >> x & 1:
                beyond[k] = own | more

    def _place(self, index: int) -> int:
        place = self._places.setdefault(index, len(self._places))
        if place == len(self._beyond[0]):
            for direction in self._beyond:
                direction.append(0)
        return place
