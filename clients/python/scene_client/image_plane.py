"""Two boxes in an image: which one is left of the other, or above it, as the camera sees them.

One rule for training on images and for detections without depth. Without depth there is no front,
and no telling what rests on what; *above* in the image may be farther away on the floor. Offsets
count in units of the boxes, as an image has no metres: boxes are neighbours if the gap between them
is at most the mean of their diagonals, the larger offset between the centres decides (sideways if
they are equal), and offsets under 10 % of that mean decide nothing.

Plain Python: a client has no arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, TypeAlias

Box: TypeAlias = tuple[float, float, float, float]
"""(xmin, ymin, xmax, ymax), y downwards; one with NaN is unseen and has no neighbour."""

MIN_OFFSET: Final = 0.10  # of the mean diagonal


def are_neighbours(box: Box, other: Box) -> bool:
    """Whether two boxes are near enough for their relation to mean something."""
    across = max(box[0] - other[2], other[0] - box[2], 0.0)
    down = max(box[1] - other[3], other[1] - box[3], 0.0)
    return math.hypot(across, down) <= _unit(box, other)


def relation_between(box: Box, other: Box) -> Literal["left", "right", "above", "below"] | None:
    """How a box stands to its neighbour; None where their centres are too near each other."""
    across = (box[0] + box[2]) / 2 - (other[0] + other[2]) / 2
    down = (box[1] + box[3]) / 2 - (other[1] + other[3]) / 2
    if not max(abs(across), abs(down)) >= MIN_OFFSET * _unit(box, other):
        return None
    # Boxes without extent have no unit, and a centre of their own need not differ from another's.
    if abs(across) >= abs(down):
        return "left" if across < 0 else "right" if across > 0 else None
    return "above" if down < 0 else "below"


def left_pairs(boxes: Sequence[Box | None], order: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of neighbours, the left one first, those of boxes that come early in ``order`` first.

    Args:
        boxes: None for things without a box.
        order: places in ``boxes``.
    """
    found = []
    for rank, i in enumerate(order):
        for j in order[:rank]:
            first, second = boxes[i], boxes[j]
            if first is None or second is None or not are_neighbours(first, second):
                continue
            relation = relation_between(first, second)
            if relation == "left":
                found.append((i, j))
            elif relation == "right":
                found.append((j, i))
    return found


def upright_box(centre: tuple[float, float], size: tuple[float, float], theta: float) -> Box:
    """The upright box around a box that is turned by ``theta`` radians."""
    cos, sin = abs(math.cos(theta)), abs(math.sin(theta))
    across = (cos * size[0] + sin * size[1]) / 2
    down = (sin * size[0] + cos * size[1]) / 2
    return centre[0] - across, centre[1] - down, centre[0] + across, centre[1] + down


def _unit(box: Box, other: Box) -> float:
    """The mean of the diagonals."""
    return (_diagonal(box) + _diagonal(other)) / 2


def _diagonal(box: Box) -> float:
    return math.hypot(box[2] - box[0], box[3] - box[1])
