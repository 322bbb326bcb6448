"""Conversion of robot frames to body axes: x forward, y left, z up.

ROS REP 103 and REP 105 define the frames.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]
Quaternion = tuple[float, float, float, float]

# Names of frames that are fixed to the world. Such a frame does not define a viewer, so left and
# front need a viewpoint in the request.
WORLD_FRAMES = frozenset({"map", "odom", "world"})

# Maximum difference between the length of a quaternion and 1 that counts as a rounding error.
_NORM_TOLERANCE = 0.01


def is_optical(frame_id: str | None) -> bool:
    """Return whether a frame has optical axes: z forward, x right, y down."""
    return _plain(frame_id).endswith(("_optical", "_optical_frame"))


def is_world_fixed(frame_id: str | None) -> bool:
    """Return whether a frame is fixed to the world, such as "map" or "robot_1/odom"."""
    return _plain(frame_id).rpartition("/")[2] in WORLD_FRAMES


def _plain(frame_id: str | None) -> str:
    # "MAP" and "map " also mean "map". If such a frame counted as a body frame, the relations would
    # be wrong.
    return (frame_id or "").strip().casefold()


def body_pose(
    position: Vector,
    size: Vector | None = None,
    orientation: Quaternion | None = None,
    *,
    optical: bool = False,
) -> tuple[Vector, Vector | None, float]:
    """Convert a box in a frame to an upright box in body axes. Return its position, size and yaw.

    The box axis that is nearest to the vertical becomes z, and the extents change their order
    accordingly. So the function also accepts a box that lies on its side, and a box with a vertical
    y axis, as in optical frames. The function ignores the remaining tilt of the box. For optical
    frames, it assumes that the viewing direction is horizontal.

    Args:
        position: centre of the box in the frame, in metres.
        size: extents along the box's own axes in metres, or None if the size is unknown.
        orientation: quaternion (x, y, z, w) from the box's axes to the frame. None means that the
            box is not rotated.
        optical: whether the frame has optical axes (z forward, x right, y down).

    Raises:
        ValueError: the length of the quaternion is not 1.
    """
    if orientation is None and not optical:
        return position, size, 0.0
    first, second, third = _IDENTITY if orientation is None else _rotation(orientation)
    if optical:
        position = _from_optical(position)
        first, second, third = map(_from_optical, (first, second, third))
    rises = abs(first[2]), abs(second[2]), abs(third[2])
    # If several axes are equally near to the vertical, the last of these axes becomes z.
    if rises[2] >= max(rises):
        up, ahead, aside, heading = 2, 0, 1, first
    elif rises[1] >= rises[0]:
        up, ahead, aside, heading = 1, 2, 0, third
    else:
        up, ahead, aside, heading = 0, 1, 2, second
    yaw = math.atan2(heading[1], heading[0])
    upright = None if size is None else (size[ahead], size[aside], size[up])
    return position, upright, yaw


def viewer_axes(frame_id: str | None = None, yaw: float | None = None) -> Axes | None:
    """Return the viewer's axes (x away, y left, z up) as vectors of a frame, or None.

    The result is None for a world-fixed frame without a viewing direction. Without a name, the
    frame has body axes. The viewing direction is ``yaw`` in radians, or else the x axis.
    """
    if yaw is None and is_world_fixed(frame_id):
        return None
    away, left, up = _IDENTITY
    if yaw is not None:
        cos, sin = math.cos(yaw), math.sin(yaw)
        away, left = (cos, sin, 0.0), (-sin, cos, 0.0)
    if is_optical(frame_id):
        return _to_optical(away), _to_optical(left), _to_optical(up)
    return away, left, up


_IDENTITY: Axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _from_optical(vector: Vector) -> Vector:
    x, y, z = vector
    return z, -x, -y


def _to_optical(vector: Vector) -> Vector:
    x, y, z = vector
    return -y, -z, x


def _rotation(quaternion: Quaternion) -> tuple[Vector, ...]:
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
