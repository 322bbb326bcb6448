"""Which of the relations that were drawn a scene can have, all at once."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.scene.relations import CANONICAL, FRONT, LEFT, ON_TOP

Triple = tuple[int, int, int]
Indices = NDArray[np.int64]

# The direction of each relation: up, left or front. A thing on another is higher, as one above it.
_DIRECTION: Final = np.zeros(len(CANONICAL), dtype=np.int64)
_DIRECTION[[LEFT, FRONT]] = 1, 2
_DIRECTIONS: Final = 3

_ONE: Final = np.uint64(1)
_WORD: Final = 64


def staying(
    units: Indices,
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
    fixed = np.array(sorted(given), dtype=np.int64).reshape(-1, 3)
    order = np.lexsort((*units.T[::-1], -logits))
    possible = (units[:, 1] != units[:, 2]) & ~structure[units[:, 1:]].any(axis=1)
    every = np.concatenate([fixed, units])
    classes, places = np.unique(every[:, 1:], return_inverse=True)
    stay: NDArray[np.bool_] = _holding(
        np.ascontiguousarray(every[:, 0]),
        *(places.reshape(-1, 2), order[possible[order]], len(fixed), len(classes)),
    )
    shape = len(CANONICAL), len(structure), len(structure)
    stay |= np.isin(np.ravel_multi_index(units.T, shape), np.ravel_multi_index(fixed.T, shape))
    return stay


@compiled
def _holding(
    relation: Indices, places: Indices, order: Indices, given: int, count: int
) -> NDArray[np.bool_]:
    """Which of m relations hold beside those that are given, (m,).

    Args:
        relation: (given + m,), those that are given first.
        places: (given + m, 2) of the two classes.
        order: of those to try, 0 to m - 1, likeliest first.
        given: how many are given.
        count: n, how many classes there are.
    """
    # Bit y of beyond[d, x]: y lies beyond x in direction d.
    beyond = np.zeros((_DIRECTIONS, count, count // _WORD + 1), np.uint64)
    related, supported = np.zeros((count, count), np.bool_), np.zeros(count, np.bool_)
    stay = np.zeros(len(relation) - given, np.bool_)
    for turn in range(given + len(order)):
        e = turn if turn < given else given + order[turn - given]
        x, y, far = places[e, 0], places[e, 1], beyond[_DIRECTION[relation[e]]]
        word, bit = x // _WORD, np.uint64(x % _WORD)
        on_top = relation[e] == ON_TOP
        if turn >= given:
            circle = far[y, word] >> bit & _ONE
            if circle or related[x, y] or (on_top and supported[x]):
                continue
            stay[e - given] = True
        related[x, y] = related[y, x] = True
        supported[x] |= on_top
        for k in range(count):
            if k == x or far[k, word] >> bit & _ONE:
                far[k] |= far[y]
                far[k, y // _WORD] |= _ONE << np.uint64(y % _WORD)
    return stay
