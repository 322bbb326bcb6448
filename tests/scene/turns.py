"""Turns as quaternions (x, y, z, w)."""

import math

Turn = tuple[float, float, float, float]


def about(axis: tuple[float, float, float], angle: float) -> Turn:
    """A turn by an angle about an axis of length 1."""
    sin = math.sin(angle / 2)
    return (axis[0] * sin, axis[1] * sin, axis[2] * sin, math.cos(angle / 2))


def after(second: Turn, first: Turn) -> Turn:
    """The turn `first`, then `second`: the product of two quaternions."""
    ax, ay, az, aw = second
    bx, by, bz, bw = first
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
