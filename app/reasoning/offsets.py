"""Placements in metres: how far from its anchor, in which direction, and how surely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.reasoning.answers import Offset, entries
from app.registry.offsets import NOTHING, Offsets, look_up
from app.scene.frames import Axes
from app.scene.relations import FRONT, LEFT

_PER_METRE: Final = 1000.0  # answers are rounded to millimetres
_UNTURNED: Final = np.eye(3)


def offsets_of(
    known: Offsets,
    relation: NDArray[np.int64],
    missing: NDArray[np.int64],
    anchor: NDArray[np.int64],
    outgoing: NDArray[np.bool_],
    axes: Axes | None,
) -> Sequence[Offset | None]:
    """From n anchors to n missing things.

    Args:
        relation, missing, anchor: (n,) canonical relation, class of the missing thing and of its
            anchor.
        outgoing: (n,) the missing thing is the relation's subject.
        axes: the viewer's, in the frame to answer in; None where nobody knows where he looks. Then
            left and front have no offset, and what lies on a thing lies in no direction from it.
    """
    ends = (relation, missing, anchor, outgoing)
    if axes is None:
        mean, spread, scenes = _lay(known.tables, *ends, _UNTURNED, False)
    else:
        mean, spread, scenes = _lay(known.tables, *ends, np.array(axes), True)
    counts = scenes.tolist()
    found = entries(Offset, map(tuple, mean.tolist()), map(tuple, spread.tolist()), counts)
    if NOTHING not in counts:
        return found
    return [offset if offset.scenes != NOTHING else None for offset in found]


@compiled
def _lay(tables, relation, missing, anchor, outgoing, axes, looking):
    """Means and spreads (n, 3), and scenes (n,), of `offsets_of`."""
    subject, other = np.where(outgoing, missing, anchor), np.where(outgoing, anchor, missing)
    offset, scenes = look_up(tables, relation, subject, other)
    n = len(relation)
    mean, spread = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        if looking:
            for axis in range(3):
                toward, square = offset[k, axis], offset[k, 3 + axis] ** 2
                for to in range(3):
                    mean[k, to] += axes[axis, to] * toward
                    spread[k, to] += axes[axis, to] ** 2 * square
        else:
            if relation[k] == LEFT or relation[k] == FRONT:
                scenes[k] = NOTHING
            mean[k, 2], spread[k, 2] = offset[k, 2], offset[k, 5] ** 2
            for axis in range(2):
                square = (offset[k, axis] ** 2 + offset[k, 3 + axis] ** 2) / 2
                spread[k, 0] += square
                spread[k, 1] += square
        for axis in range(3):
            value = mean[k, axis] if outgoing[k] else -mean[k, axis]
            # Adding zero makes 0 of -0.
            mean[k, axis] = np.rint(value * _PER_METRE) / _PER_METRE + 0.0
            spread[k, axis] = (
                max(np.rint(math.sqrt(spread[k, axis]) * _PER_METRE), 1.0) / _PER_METRE
            )
    return mean, spread, scenes
