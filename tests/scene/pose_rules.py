"""The rules of poses a second time, pair by pair in plain Python, as an oracle for the loops.

Footprints are polygons here, clipped and measured as such, and nothing is shared with the product
but the names of the relations. What rounding may decide either way is left undecided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Point = tuple[float, float]

# The role of a smaller thing at a larger one, of those that are possible: on, under, in, or none.
Decide = Callable[[int, int, frozenset[str]], str | None]

# Metres, and shares of an area.
_ROUNDING = 1e-7


@dataclass(frozen=True)
class Box:
    """A thing: where it is and how large, as far as anybody knows."""

    position: Sequence[float] | None
    size: Sequence[float] | None
    yaw: float = 0.0
    kind: int = -1

    @property
    def footprint(self) -> float:
        """Area."""
        assert self.size is not None
        return self.size[0] * self.size[1]

    @property
    def bottom(self) -> float:
        assert self.position is not None
        assert self.size is not None
        return self.position[2] - self.size[2] / 2

    @property
    def top(self) -> float:
        assert self.size is not None
        return self.bottom + self.size[2]

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
    subject: Box, anchor: Box, decide: Decide, *, horizontal: bool = True
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
    beside = near and horizontal
    observed = frozenset(
        (["left", "front"] if beside else []) + (["on-top", "above", "inside"] if sized else [])
    )
    if sized:
        for upper, lower in ((subject, anchor), (anchor, subject)):
            if relation := _vertical(upper, lower):
                return frozenset([relation] if upper is subject else []), observed
        pairs = ((subject, anchor), (anchor, subject))
        if _overlap(subject, anchor) and (
            any(_surrounds(*pair) for pair in pairs)
            or all(not _above(upper.bottom - lower.top, -0.05) for upper, lower in pairs)
        ):
            holds, unobserved = _reaching(subject, anchor, decide)
            return holds, observed - unobserved
    if not beside:
        return nothing, observed
    if abs(abs(dx) - abs(dy)) <= _ROUNDING and abs(dx) != abs(dy):
        raise UndecidedError
    name, lead = ("left", dy) if abs(dy) >= abs(dx) else ("front", -dx)
    return frozenset([name] if _above(lead, 0.1) else []), observed


def _vertical(upper: Box, lower: Box) -> str | None:
    assert upper.position is not None
    assert lower.position is not None
    if not _overlap(upper, lower):
        return None
    gap = upper.bottom - lower.top
    if _above(gap, 0.05):
        return "above"
    # Of two thin things the one with the higher centre lies on the other.
    if _above(gap, -0.05) and upper.position[2] > lower.position[2]:
        return None if _surrounds(upper, lower) else "on-top"
    return None


def _surrounds(outer: Box, inner: Box) -> bool:
    """Whether a tall box has a smaller one between its bottom and its top."""
    return (
        _is_smaller(inner, outer)
        and _above(outer.top - outer.bottom, 0.1)
        and _above(inner.bottom, outer.bottom)
        and _above(outer.top, inner.top)
    )


def _is_smaller(one: Box, other: Box) -> bool:
    sizes = [(box.footprint, box.footprint * (box.top - box.bottom)) for box in (one, other)]
    for a, b in zip(*sizes, strict=True):
        if _above(abs(a - b), 0.01 * max(a, b)):
            return a < b
    return False


def _overlap(one: Box, other: Box) -> bool:
    smaller = min(one.footprint, other.footprint)
    return _above(common_area(one.corners, other.corners) / smaller, 0.3)


def _reaching(subject: Box, anchor: Box, decide: Decide) -> tuple[frozenset[str], frozenset[str]]:
    """What holds in this direction of boxes that reach into each other, and what is unobserved."""
    nothing: frozenset[str] = frozenset()
    smaller, larger = sorted((subject, anchor), key=lambda box: box.footprint)
    if not _above(larger.footprint - smaller.footprint, 0.01 * larger.footprint):
        volumes = [box.footprint * (box.top - box.bottom) for box in (smaller, larger)]
        if not _above(max(volumes) - min(volumes), 0.01 * max(volumes)):
            return nothing, frozenset(["on-top", "inside"])
        if volumes[0] > volumes[1]:
            smaller, larger = larger, smaller
    rise, height = smaller.bottom - larger.bottom, larger.top - larger.bottom
    fits = {
        "on": not _above(0.2 * height, rise),
        "under": not _above(rise, max(0.1, 0.2 * height)),
        "in": not _above(smaller.top - smaller.bottom, 1.2 * height),
    }
    possible = frozenset(role for role, is_possible in fits.items() if is_possible)
    role = decide(smaller.kind, larger.kind, possible)
    # The relation of each role, as far as its subject is the subject here.
    own = {"on": "on-top", "in": "inside"} if smaller is subject else {"under": "on-top"}
    if role is not None:
        return frozenset([own[role]] if role in own else []), nothing
    return nothing, frozenset(own[role] for role in possible if role in own)


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
