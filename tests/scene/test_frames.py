from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.geometry import (
    Viewpoint,
    body_pose,
    is_optical,
    is_world_fixed,
    to_viewer_frame,
    viewer_axes,
)
from tests.scene.turns import about, after


def same_turn(a: float, b: float, period: float = 2 * math.pi) -> bool:
    return abs(math.remainder(a - b, period)) < 1e-9


@pytest.mark.parametrize(
    ("frame", "optical", "fixed"),
    [
        ("base_link", False, False),
        ("camera_optical", True, False),
        ("robot/camera_color_optical_frame", True, False),
        ("optical_table", False, False),
        ("map", False, True),
        ("MAP", False, True),
        (" Odom ", False, True),
        ("Camera_Optical", True, False),
        ("robot_1/odom", False, True),
        ("/world", False, True),
        ("map_server", False, False),
        ("", False, False),
    ],
)
def test_frames_by_name(frame: str, optical: bool, fixed: bool) -> None:
    assert is_optical(frame) is optical
    assert is_world_fixed(frame) is fixed


def test_optical_axes() -> None:
    # 3 m ahead, 1 m to the right, 2 m below the camera.
    position, size, yaw = body_pose((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), optical=True)
    assert position == (3.0, -1.0, -2.0)
    # Unturned in optical axes: x is its width, y its height, z its depth.
    assert size == (0.3, 0.1, 0.2)
    assert same_turn(yaw, 0.0)


@given(st.floats(-3, 3), st.floats(-0.6, 0.6))
def test_a_box_on_its_side(angle: float, tilt: float) -> None:
    """Tipped about x the box heads along its z axis, tipped about y along its y axis."""
    for axis, size, heading in (
        ((1, 0, 0), (3.0, 1.0, 2.0), angle - math.pi / 2),
        ((0, 1, 0), (2.0, 3.0, 1.0), angle + math.pi / 2),
    ):
        # A tilt about the heading leaves it level.
        lean = after(about((0, 0, 1), heading), about((1, 0, 0), tilt))
        lean = after(lean, about((0, 0, 1), -heading))
        tipped = after(about((0, 0, 1), angle), about(axis, math.pi / 2))
        _, upright, yaw = body_pose((0.0, 0.0, 0.0), (1.0, 2.0, 3.0), after(lean, tipped))
        assert upright == size
        assert same_turn(yaw, heading)


@given(st.floats(-0.6, 0.6), st.floats(-3, 3))
def test_a_tilt_is_dropped(tilt: float, angle: float) -> None:
    # Yaw after a tilt about the box's own x axis leaves that axis horizontal.
    both = after(about((0, 0, 1), angle), about((1, 0, 0), tilt))
    _, size, yaw = body_pose((0.0, 0.0, 0.0), (1.0, 2.0, 3.0), both)
    assert size == (1.0, 2.0, 3.0)
    assert same_turn(yaw, angle)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 2), (0, 0, 0, math.nan)])
def test_quaternions_must_have_length_one(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="quaternion of length 1"):
        body_pose((0.0, 0.0, 0.0), None, quaternion)


@given(st.floats(-7, 7), st.booleans(), st.tuples(*[st.floats(-5, 5)] * 3))
def test_viewer_axes_invert_the_conversion_to_the_viewer(
    yaw: float, optical: bool, point: tuple[float, float, float]
) -> None:
    """A point read into body axes, seen by the viewer, and told in the frame again."""
    body, _, _ = body_pose(point, optical=optical)
    (seen,), _ = to_viewer_frame([body], Viewpoint(0.0, 0.0, yaw))
    axes = viewer_axes("camera_optical_frame" if optical else "map", yaw)
    assert axes is not None
    told = [sum(seen[k] * axes[k][n] for k in range(3)) for n in range(3)]
    assert told == pytest.approx(point, abs=1e-9)
