"""The rules of poses a second time, pair by pair in plain Python, as an oracle for the loops.

Footprints are polygons here, clipped and measured as such, and nothing is shared with the product
but the names of the relations. What rounding may decide either way is left undecided.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Point = tuple[float, float]

# Metres, and shares of an area.
_ROUNDING = 1e-7


@dataclass(frozen=True)
class Box:
    """A thing: where it is and how large, as far as anybody knows."""

    position: Sequence[float] | None
    size: Sequence[float] | None
    yaw: float = 0.0

    @property
    def corners(self) -> list[Point]:
        """Of the footprint, counter-clockwise."""
        assert self.position is not None
        assert self.size is not None
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.position[0], self.position[1]
        length, width = self.size[0] / 2, self.size[1] / 2
        return [
            (x + cos * u * length - sin * v * width, y + sin * u * length + cos * v * width)
            for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ]


class UndecidedError(Exception):
    """A number is as near to its threshold as rounding reaches."""


def relate(
    subject: Box, anchor: Box, *, horizontal: bool = True
) -> tuple[frozenset[str], frozenset[str]]:
    """What holds of a pair in this direction, and what is observed of it.

    Raises:
        UndecidedError: rounding decides.
    """
    nothing: frozenset[str] = frozenset()
    if subject.position is None or anchor.position is None:
        return nothing, nothing
    dx, dy = (subject.position[k] - anchor.position[k] for k in (0, 1))
    sized = subject.size is not None and anchor.size is not None
    if sized:
        near = not _above(distance_of(subject.corners, anchor.corners), 1.0)
    else:
        near = not _above(math.hypot(dx, dy), 1.5)
    if not near:
        return nothing, nothing
    observed = frozenset(
        (["left", "front"] if horizontal else []) + (["on-top", "above"] if sized else [])
    )
    if sized:
        for upper, lower in ((subject, anchor), (anchor, subject)):
            if relation := _vertical(upper, lower):
                return frozenset([relation] if upper is subject else []), observed
    if not horizontal:
        return nothing, observed
    if abs(abs(dx) - abs(dy)) <= _ROUNDING and abs(dx) != abs(dy):
        raise UndecidedError
    name, lead = ("left", dy) if abs(dy) >= abs(dx) else ("front", -dx)
    return frozenset([name] if _above(lead, 0.1) else []), observed


def _vertical(upper: Box, lower: Box) -> str | None:
    assert upper.size is not None
    assert lower.size is not None
    assert upper.position is not None
    assert lower.position is not None
    smaller = min(box.size[0] * box.size[1] for box in (upper, lower) if box.size is not None)
    if not _above(common_area(upper.corners, lower.corners) / smaller, 0.3):
        return None
    gap = upper.position[2] - upper.size[2] / 2 - (lower.position[2] + lower.size[2] / 2)
    if _above(gap, 0.05):
        return "above"
    # Of two thin things the one with the higher centre lies on the other.
    if _above(gap, -0.05) and upper.position[2] > lower.position[2]:
        return "on-top"
    return None


def _above(value: float, threshold: float) -> bool:
    if abs(value - threshold) <= _ROUNDING:
        raise UndecidedError
    return value > threshold


def common_area(subject: list[Point], clip: list[Point]) -> float:
    """Area of the intersection of two convex polygons (Sutherland & Hodgman 1974)."""
    for (ax, ay), (bx, by) in zip(clip, clip[1:] + clip[:1], strict=True):

        def side(p: Point, ax: float = ax, ay: float = ay, bx: float = bx, by: float = by) -> float:
            return (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax)

        kept: list[Point] = []
        for p, q in zip(subject, subject[1:] + subject[:1], strict=True):
            if side(p) >= 0:
                kept.append(p)
            if side(p) * side(q) < 0:
                t = side(p) / (side(p) - side(q))
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        subject = kept
    turns = zip(subject, subject[1:] + subject[:1], strict=True)
    return abs(sum(p[0] * q[1] - p[1] * q[0] for p, q in turns)) / 2


def distance_of(a: list[Point], b: list[Point]) -> float:
    """Least distance of two convex polygons, 0 where they overlap."""
    if common_area(a, b) > 1e-9:
        return 0.0
    return min(border_distance(a, b), border_distance(b, a))


def border_distance(points: list[Point], polygon: list[Point]) -> float:
    """Least distance of some points to the border of a polygon."""
    best = math.inf
    for px, py in points:
        for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            ux, uy = bx - ax, by - ay
            t = ((px - ax) * ux + (py - ay) * uy) / (ux * ux + uy * uy)
            t = min(max(t, 0.0), 1.0)
            best = min(best, math.hypot(px - ax - t * ux, py - ay - t * uy))
    return best
