"""Relations of two boxes in an image: left, right, above and below, as the camera sees the boxes.

Training on images uses the same rule as the conversion of detections without depth. Without depth,
the relations front, on-top and inside are unknown. An object that is *above* another object in the
image may be farther away on the floor.

Lengths in an image are not in metres, so the unit of length is the mean diagonal of the two boxes.
Two boxes are neighbours if the gap between the boxes is at most one unit. The larger of the
horizontal and the vertical distance between the centres decides the relation. If the two distances
are equal, the horizontal distance decides. If both distances are under 10 % of the unit, the boxes
have no relation.

The module uses only the standard library, because the client does not depend on numpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, TypeAlias

Box: TypeAlias = tuple[float, float, float, float]
"""A box (xmin, ymin, xmax, ymax), with y downwards. A box with NaN has no neighbours."""

MIN_OFFSET: Final = 0.10  # minimum distance between the centres, as a part of the mean diagonal


def are_neighbours(box: Box, other: Box) -> bool:
    """Return whether two boxes are close enough for a relation."""
    across = max(box[0] - other[2], other[0] - box[2], 0.0)
    down = max(box[1] - other[3], other[1] - box[3], 0.0)
    return math.hypot(across, down) <= _unit(box, other)


def relation_between(box: Box, other: Box) -> Literal["left", "right", "above", "below"] | None:
    """Return the relation of a box to its neighbour, or None if the centres are too close."""
    across = (box[0] + box[2]) / 2 - (other[0] + other[2]) / 2
    down = (box[1] + box[3]) / 2 - (other[1] + other[3]) / 2
    if not max(abs(across), abs(down)) >= MIN_OFFSET * _unit(box, other):
        return None
    # Two boxes of size zero have a unit of 0, and their centres may be equal.
    if abs(across) >= abs(down):
        return "left" if across < 0 else "right" if across > 0 else None
    return "above" if down < 0 else "below"


def left_pairs(boxes: Sequence[Box | None], order: Sequence[int]) -> list[tuple[int, int]]:
    """Return all pairs (i, j) of neighbours where box i is left of box j.

    The result starts with the pairs of boxes that stand first in ``order``.

    Args:
        boxes: box of each object, or None for an object without a box.
        order: indices of ``boxes``, for example by descending confidence.
    """
    pairs = []
    for rank, i in enumerate(order):
        for j in order[:rank]:
            first, second = boxes[i], boxes[j]
            if first is not None and second is not None and are_neighbours(first, second):
                relation = relation_between(first, second)
                pairs += {"left": [(i, j)], "right": [(j, i)]}.get(relation or "", [])
    return pairs


def upright_box(centre: tuple[float, float], size: tuple[float, float], theta: float) -> Box:
    """Return the smallest upright box around a box that is rotated by ``theta`` radians."""
    cos, sin = abs(math.cos(theta)), abs(math.sin(theta))
    across = (cos * size[0] + sin * size[1]) / 2
    down = (sin * size[0] + cos * size[1]) / 2
    return centre[0] - across, centre[1] - down, centre[0] + across, centre[1] + down


def _unit(box: Box, other: Box) -> float:
    return sum(math.hypot(right - left, low - high) for left, high, right, low in (box, other)) / 2
