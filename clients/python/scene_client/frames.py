"""Conversion of boxes in the frames and conventions of a robot to metres and body axes.

Body axes are x forward, y left and z up. ROS REP 103 and REP 105 define the frames. A scene may
declare other conventions: the axis that points up, the unit of length, and the form of its boxes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]
Quaternion = tuple[float, float, float, float]

# Names of frames that are fixed to the world. Such a frame does not define a viewer, so left and
# front need a viewpoint in the request.
WORLD_FRAMES = frozenset({"map", "odom", "world"})

Up = Literal["z", "y"]
Units = Literal["m", "dm", "cm", "mm", "in"]
Extents = Literal["full", "half"]
BoxOrigin = Literal["centre", "bottom", "corner"]
QuaternionOrder = Literal["xyzw", "wxyz"]

METRES: Final[Mapping[str, float]] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Length of each unit in metres."""

# Maximum difference between the length of a quaternion and 1 that counts as a rounding error.
_NORM_TOLERANCE = 0.01


def is_optical(frame_id: str | None) -> bool:
    """Return whether a frame has optical axes: z forward, x right, y down."""
    return _plain(frame_id).endswith(("_optical", "_optical_frame"))


def optical_name(frame_id: str | None, *, optical: bool) -> str:
    """Return the name of a frame with optical axes, or of the frame with the same name without."""
    name = (frame_id or "camera").strip()
    for ending in ("_frame", "_optical"):
        if name.casefold().endswith(ending) and is_optical(frame_id):
            name = name[: -len(ending)]
    return f"{name}_optical" if optical else name


def is_world_fixed(frame_id: str | None) -> bool:
    """Return whether a frame is fixed to the world, such as "map" or "robot_1/odom"."""
    return _plain(frame_id).rpartition("/")[2] in WORLD_FRAMES


def _plain(frame_id: str | None) -> str:
    # "MAP" and "map " also mean "map". If such a frame counted as a body frame, the relations would
    # be wrong.
    return (frame_id or "").strip().casefold()


class Conventions(NamedTuple):
    """The conventions of the boxes of one scene. The defaults are those of a ROS body frame.

    Attributes:
        up: the axis of the frame that points up. With "z", x points ahead and y left. With "y", the
            frame is right-handed: x points right, and z towards the viewer. With "-y", the frame is
            optical: x points right, and z ahead.
        units: unit of all lengths.
        extents: whether a size has the whole sides of a box or half of each side.
        box_origin: the point of the box at its position. "corner" is the corner with the smallest
            x, y and z before the rotation of the box.
        quaternion_order: order of the numbers of a quaternion.
    """

    up: Literal["z", "y", "-y"] = "z"
    units: Units = "m"
    extents: Extents = "full"
    box_origin: BoxOrigin = "centre"
    quaternion_order: QuaternionOrder = "xyzw"

    @classmethod
    def of(cls, scene: Any, frame_id: str | None = None) -> Conventions:
        """Return the conventions that the fields of a scene declare, in the frame ``frame_id``.

        Raises:
            ValueError: the scene declares the axis that points up, although the frame is optical.
        """
        up: Literal["z", "y", "-y"] = scene.up or "z"
        if is_optical(frame_id):
            if scene.up is not None:
                raise ValueError(
                    f"`up` is {scene.up}, but the y axis of an optical frame points down; leave "
                    "`up` out, or use a frame whose name does not end in _optical"
                )
            up = "-y"
        return cls(up, scene.units, scene.extents, scene.box_origin, scene.quaternion_order)

    def errors(
        self, position: float | None, size: float | None
    ) -> tuple[float | None, float | None]:
        """Convert standard deviations of a position and of a size to metres. None stays None."""
        metres = METRES[self.units]
        of_size = metres if self.extents == "full" else 2 * metres
        return (
            None if position is None else metres * position,
            None if size is None else of_size * size,
        )

    def box(
        self,
        position: Vector | None,
        size: Vector | None = None,
        orientation: Quaternion | None = None,
        yaw: float | None = None,
        *,
        typical: Vector | None = None,
    ) -> tuple[Vector | None, Vector | None, float]:
        """Convert a box to an upright box in metres and body axes.

        The box axis that is nearest to the vertical becomes z, and the extents change their order
        accordingly. So the function also accepts a box that lies on its side, and a box with a
        vertical y axis, as in optical frames. The function ignores the remaining tilt of the box.
        For optical frames, it assumes that the viewing direction is horizontal.

        Args:
            position: the point `box_origin` of the box in the frame, or None if it is unknown.
            size: extents along the box's own axes, or None if the size is unknown.
            orientation: quaternion from the box's axes to the frame. None means that the box is not
                rotated.
            yaw: rotation in radians instead of ``orientation``: about the y axis of a frame whose y
                axis points up, and otherwise about the z axis.
            typical: typical extents of the class in metres, the third one vertical. They replace an
                unknown size for the way from `box_origin` to the centre.

        Returns:
            The centre, the extents and the yaw of the box. An unknown position or size stays None.

        Raises:
            ValueError: the length of the quaternion is not 1.
        """
        if self.units != "m" or self.extents != "full":
            metres = METRES[self.units]
            position = _scaled(position, metres)
            size = _scaled(size, metres if self.extents == "full" else 2 * metres)
        if yaw is not None:
            sin, cos = math.sin(yaw / 2), math.cos(yaw / 2)
            orientation = (0.0, sin, 0.0, cos) if self.up == "y" else (0.0, 0.0, sin, cos)
        elif orientation is not None and self.quaternion_order == "wxyz":
            orientation = (*orientation[1:], orientation[0])
        if orientation is None and self.up == "z":
            axes, order, turn = _IDENTITY, _UPRIGHT, 0.0
        else:
            axes = _IDENTITY if orientation is None else _rotation(orientation)
            first, second, third = (to_body(axis, self.up) for axis in axes)
            axes = first, second, third
            order, turn = _upright(axes, ahead=-1.0 if self.up == "y" else 1.0)
        if position is not None:
            position = to_body(position, self.up)
            if self.box_origin != "centre":
                position = self._centre(position, size, axes, order, typical)
        if size is not None:
            size = (size[order[0]], size[order[1]], size[order[2]])
        return position, size, turn

    def _centre(
        self,
        origin: Vector,  # in body axes and metres
        size: Vector | None,
        axes: Axes,  # of the box, in body axes
        order: tuple[int, int, int],  # the box axes that are ahead, aside and up
        typical: Vector | None,
    ) -> Vector:
        """Return the centre of a box from its origin. Without any size, it is the origin."""
        if size is None or not any(size):
            if typical is None:
                return origin
            first, second, third = (typical[order.index(axis)] for axis in range(3))
            size = first, second, third
        x, y, z = origin
        if self.box_origin == "bottom":
            return x, y, z + size[order[2]] / 2
        for axis, side in zip(axes, size, strict=True):
            x, y, z = x + axis[0] * side / 2, y + axis[1] * side / 2, z + axis[2] * side / 2
        return x, y, z


CONVENTIONS: Final = ("up", "units", "extents", "box_origin", "quaternion_order")
"""The fields of a scene that declare its conventions."""

_IDENTITY: Final[Axes] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_UPRIGHT: Final = (0, 1, 2)  # axes of a box that are ahead, aside and up


def viewer_axes(
    frame_id: str | None = None, yaw: float | None = None, up: Up | None = None
) -> Axes:
    """Return the viewer's axes (x away, y left, z up) as vectors of a frame.

    Without a name, the frame has body axes. The viewing direction is ``yaw`` in radians from the
    body axis x, or else this axis. ``up`` is the axis of the frame that points up, by default z, or
    -y in an optical frame.
    """
    away, left, above = _IDENTITY
    if yaw is not None:
        cos, sin = math.cos(yaw), math.sin(yaw)
        away, left = (cos, sin, 0.0), (-sin, cos, 0.0)
    direction = "-y" if is_optical(frame_id) else up or "z"
    return to_frame(away, direction), to_frame(left, direction), to_frame(above, direction)


def to_body(vector: Vector, up: str) -> Vector:
    """Return a vector of a frame in body axes. ``up`` is the axis that points up, as "-y"."""
    if up == "z":
        return vector
    x, y, z = vector
    return (-z, -x, y) if up == "y" else (z, -x, -y)


def to_frame(vector: Vector, up: str) -> Vector:
    """Return a vector in body axes in a frame; the inverse of `to_body`."""
    if up == "z":
        return vector
    x, y, z = vector
    return (-y, z, -x) if up == "y" else (-y, -z, x)


def _scaled(vector: Vector | None, factor: float) -> Vector | None:
    return None if vector is None else (vector[0] * factor, vector[1] * factor, vector[2] * factor)


def _upright(axes: Axes, *, ahead: float) -> tuple[tuple[int, int, int], float]:
    """Return which axes of a box are ahead, aside and up, and the yaw of the first of them.

    ``ahead`` is -1 if this axis points backwards, as z of a frame whose y axis points up.
    """
    rises = abs(axes[0][2]), abs(axes[1][2]), abs(axes[2][2])
    # If several axes are equally near to the vertical, the last of these axes becomes z.
    if rises[2] >= max(rises):
        order = _UPRIGHT
    elif rises[1] >= rises[0]:
        order = (2, 0, 1)
    else:
        order = (1, 2, 0)
    x, y, _ = axes[order[0]]
    return order, math.atan2(ahead * y, ahead * x)


def _rotation(quaternion: Quaternion) -> Axes:
    x, y, z, w = quaternion
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:
        raise ValueError(f"orientation must be a quaternion of length 1, but has length {norm:g}")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, xw, yw, zw = x * y, x * z, y * z, x * w, y * w, z * w
    return (
        (1 - 2 * (yy + zz), 2 * (xy + zw), 2 * (xz - yw)),
        (2 * (xy - zw), 1 - 2 * (xx + zz), 2 * (yz + xw)),
        (2 * (xz + yw), 2 * (yz - xw), 1 - 2 * (xx + yy)),
    )


def quaternion_of(axes: Sequence[float]) -> Quaternion:
    """Return the rotation whose rotated axes are the nine numbers: x, y and z, one after another.

    Of a left-handed set, the third axis counts as the other way round: a box has the same sides.
    """
    a, b, c, d, e, f, g, h, i = axes
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        g, h, i = -g, -h, -i
    # The largest component comes from a square root, and the others from it (Shepperd, 1978).
    squares = (1 + a - e - i, 1 - a + e - i, 1 - a - e + i, 1 + a + e + i)
    largest = max(range(4), key=squares.__getitem__)
    root = 2 * math.sqrt(max(squares[largest], 1e-12))
    table = (
        (root * root / 4, b + d, c + g, f - h),
        (b + d, root * root / 4, f + h, g - c),
        (c + g, f + h, root * root / 4, b - d),
        (f - h, g - c, b - d, root * root / 4),
    )
    x, y, z, w = (value / root for value in table[largest])
    return x, y, z, w


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation by b and then by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotated(vector: Sequence[float], turn: Quaternion) -> Vector:
    """Return a rotated vector."""
    x, y, z, w = turn
    a, b, c, _ = product(product(turn, (vector[0], vector[1], vector[2], 0.0)), (-x, -y, -z, w))
    return a, b, c
