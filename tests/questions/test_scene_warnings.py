"""The warning about conventions, one mistake at a time, and scenes without a mistake."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import ContradictionError
from app.questions.reading import Limits, read_scene
from app.scene.vocabulary import ObjectClass, Vocabulary
from scene_client.schemas import OutliersRequest, SceneWarning

VOCABULARY = Vocabulary(
    [
        ObjectClass("bed", size=(1.8, 1.8, 0.9)),
        ObjectClass("desk", size=(1.0, 1.0, 0.75)),
        ObjectClass("chair", size=(0.5, 0.5, 0.9)),
        ObjectClass("wardrobe", size=(0.9, 0.9, 2.0)),
        ObjectClass("book", size=(0.2, 0.2, 0.04)),
        ObjectClass("robot"),
    ]
)
STANDS = np.array([(0.98, 0.01, 0.01)] * 4 + [(0.02, 0.01, 0.97), (1.0, 0.0, 0.0)])
# Label, centre and extents in a frame whose z axis points up; no box has its typical size.
ROOM: list[tuple[str, tuple[float, ...], tuple[float, ...]]] = [
    ("bed", (2.0, 1.0, 0.4), (1.6, 2.1, 0.8)),
    ("desk", (1.0, -1.5, 0.4), (0.7, 1.6, 0.8)),
    ("chair", (1.0, -0.8, 0.4), (0.45, 0.5, 0.8)),
    ("wardrobe", (4.0, 0.0, 1.1), (1.2, 0.6, 2.2)),
    ("book", (1.0, -1.4, 0.92), (0.03, 0.15, 0.24)),  # it stands
]
FURNITURE = ["bed", "desk", "chair", "wardrobe"]
Detection = dict[str, Any]
QUARTER = math.sqrt(0.5)


def room(
    convert: Callable[[tuple[float, ...]], Any] = tuple, size: Callable[..., Any] | None = None
) -> list[Detection]:
    return [
        {"label": label, "position": [*convert(p)], "size": [*(size or convert)(s)]}
        for label, p, s in ROOM
    ]


def turned(quaternion: list[float], *labels: str) -> list[Detection]:
    """The room; these things have an orientation, and the others have none."""
    return [one | ({"orientation": quaternion} if one["label"] in labels else {}) for one in room()]


def warnings_of(objects: list[Any], **fields: Any) -> list[SceneWarning]:
    request = OutliersRequest(objects=objects, **fields)
    reading = read_scene(request, VOCABULARY, Limits(), stands=STANDS)
    assert all(one.message for one in reading.warnings)
    return reading.warnings


def declared(objects: list[Any], **fields: Any) -> dict[str, str] | None:
    """The fields that the only warning declares, or None without a warning.

    With these fields, the service has no further warning.
    """
    found = warnings_of(objects, **fields)
    if not found:
        return None
    assert [(one.code, one.objects) for one in found] == [("convention", [])]
    declare = found[0].declare
    assert declare is not None
    if declare:
        assert warnings_of(objects, **(fields | declare)) == []
    return declare


def to_y_up(p: tuple[float, ...]) -> tuple[float, ...]:
    """To a right-handed frame whose y axis points up: x right, z towards the viewer."""
    return -p[1], p[2], -p[0]


def sides_y_up(s: tuple[float, ...]) -> tuple[float, ...]:
    return s[1], s[2], s[0]


def optical(p: tuple[float, ...]) -> tuple[float, ...]:
    return -p[1], -p[2], p[0]


@pytest.mark.parametrize(
    ("unit", "metres"), [("dm", 0.1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254)]
)
def test_another_unit(unit: str, metres: float) -> None:
    scene = room(lambda p: [value / metres for value in p])
    assert declared(scene) == {"units": unit}
    # Metres in a scene that declares another unit.
    assert declared(room(), units=unit) == {"units": "m"}


@pytest.mark.parametrize("factor", [0.1, 1 / 0.3048, 17.0])
def test_a_factor_that_is_no_unit(factor: float) -> None:
    scene = room(lambda p: [factor * value for value in p])
    (warning,) = warnings_of(scene)
    assert warning.code == "convention"
    assert warning.declare == {}
    named = float(warning.message.split(" times")[0].split()[-1])
    assert named == pytest.approx(factor, rel=0.25)


def test_positions_in_another_unit_than_sizes() -> None:
    scene = [*room(), *room()]
    for k, one in enumerate(scene):
        # Without different heights, all bottoms are equal at any scale.
        height = one["size"][2] * (0.8 + 0.05 * k)
        one["size"][2], one["position"][2] = height, height / 2
        one["position"] = [10 * value for value in one["position"]]
        one["position"][1] += 30 * (k // len(ROOM))
    assert declared(scene) == {}
    assert "positions alone are in dm" in warnings_of(scene)[0].message


def test_few_sizes_show_no_convention() -> None:
    scene = room(lambda p: [value / 0.01 for value in p])
    robot = {"label": "robot", "size": [400, 400, 1000]}  # without a typical size
    codes = {one.code for one in warnings_of([*scene[:2], robot])}
    assert codes == {"implausible-position", "implausible-size"}
    # Sizes without positions have a unit too.
    bare = [{"label": one["label"], "size": one["size"]} for one in scene]
    assert declared(bare) == {"units": "cm"}


@pytest.mark.parametrize("rotation", [{}, {"yaw": 0.3}, {"orientation": [0, 0.6, 0, 0.8]}])
def test_a_frame_whose_y_axis_points_up(rotation: Detection) -> None:
    scene = [one | rotation for one in room(to_y_up, sides_y_up)]
    assert declared(scene) == {"up": "y"}
    assert declared(scene, up="y") is None
    # z up in a scene that declares y.
    plain = [one | ({} if "orientation" in rotation else rotation) for one in room()]
    assert declared(plain, up="y") == {"up": "z"}


def test_the_axes_of_a_camera() -> None:
    scene = room(optical, sides_y_up)
    assert declared(scene) == {"frame_id": "camera_optical"}
    assert declared(scene, frame_id="head_camera") == {"frame_id": "head_camera_optical"}
    assert declared(scene, frame_id="camera_optical_frame") is None
    # Body axes in a frame with the name of a camera.
    fields = {"up": "z", "frame_id": "camera"}
    (warning,) = warnings_of(room(), frame_id="camera_optical_frame")
    assert warning.declare == fields


def test_sizes_along_other_axes_than_positions() -> None:
    """No field declares them, so the warning only describes them."""
    for frame_id, convert in (("camera_optical_frame", optical), ("base_link", tuple)):
        sides = (lambda s: s) if frame_id != "base_link" else (lambda s: (s[0], s[2], s[1]))
        assert declared(room(convert, sides), frame_id=frame_id) == {}


def test_half_and_double_extents() -> None:
    half = room(size=lambda s: [side / 2 for side in s])
    double = room(size=lambda s: [2 * side for side in s])
    assert declared(half) == {"extents": "half"}
    assert declared(half, extents="half") is None
    assert declared(room(), extents="half") == {"extents": "full"}
    assert declared(double) == {}
    assert "half as long" in warnings_of(double)[0].message


@pytest.mark.parametrize("yaw", [0.0, 0.7])
@pytest.mark.parametrize(("origin", "shares"), [("bottom", (0, 0, 1)), ("corner", (1, 1, 1))])
def test_other_origins_of_boxes(origin: str, shares: tuple[int, ...], yaw: float) -> None:
    scene, cos, sin = room(), math.cos(yaw), math.sin(yaw)
    for one in scene:
        x, y, z = (share * side / 2 for share, side in zip(shares, one["size"], strict=True))
        moves = cos * x - sin * y, sin * x + cos * y, z
        one["position"] = [p - m for p, m in zip(one["position"], moves, strict=True)]
        one["yaw"] = yaw
    named = declared(scene)
    # The depth of few boxes does not tell a corner from the middle of the bottom.
    assert named is not None
    assert named["box_origin"] in {"bottom", origin}
    assert declared(scene, box_origin=origin) is None
    assert declared([one | {"yaw": yaw} for one in room()], box_origin=origin) == {
        "box_origin": "centre"
    }


def test_quaternions_with_w_first() -> None:
    """A quarter turn about z is then a quarter turn about x, and the identity a half turn."""
    quarter, wxyz = [QUARTER, 0, 0, QUARTER], {"quaternion_order": "wxyz"}
    assert declared(turned(quarter, *FURNITURE)) == wxyz
    assert declared(turned([1, 0, 0, 0], *FURNITURE)) == wxyz
    assert declared(turned([0, 0, QUARTER, QUARTER], *FURNITURE), **wxyz) == {
        "quaternion_order": "xyzw"
    }
    # One chair may have fallen over, if the other quaternions are right.
    scene = turned(quarter, "chair")
    scene[1]["orientation"] = scene[0]["orientation"] = [0, 0, QUARTER, QUARTER]
    assert declared(scene) is None


@given(
    st.permutations(range(len(ROOM))),
    st.floats(-3, 3),
    st.lists(st.floats(-0.02, 0.02), min_size=15, max_size=15),
    st.sampled_from(["map", None]),
)
def test_right_rooms_get_no_warning(
    order: list[int], yaw: float, noise: list[float], frame_id: str | None
) -> None:
    """Rooms in any order and direction, with errors of 2 cm."""
    cos, sin, objects = math.cos(yaw), math.sin(yaw), []
    for k in order:
        label, (x, y, z), size = ROOM[k]
        place = (cos * x - sin * y, sin * x + cos * y, z)
        place = [value + noise[3 * k + n] for n, value in enumerate(place)]
        objects.append({"label": label, "position": place, "size": size, "yaw": yaw})
    assert declared(objects, frame_id=frame_id) is None


@pytest.mark.parametrize(
    ("objects", "frame_id"),
    [
        (turned([0, 0, QUARTER, QUARTER], *FURNITURE), "map"),
        (turned([0, 0, 0.4, math.sqrt(0.84)], *FURNITURE, "book"), None),
        (turned([0, 0, 0, 1], *FURNITURE), None),
        (room(optical, sides_y_up), "camera_optical_frame"),
        (  # boxes with z as height, turned into optical axes
            [
                one | {"orientation": [0.5, -0.5, 0.5, 0.5]}
                for one in room(optical, size=lambda s: s)
            ],
            "camera_optical_frame",
        ),
        ([one | {"size": [one["size"][0], 0.0, one["size"][2]]} for one in room()], None),
        ([one | {"size": [0, 0, 0]} for one in room()], None),
    ],
)
def test_right_scenes_get_no_warning(objects: list[Detection], frame_id: str | None) -> None:
    codes = {one.code for one in warnings_of(objects, frame_id=frame_id)}
    assert codes <= {"implausible-size"}


def test_up_contradicts_an_optical_frame() -> None:
    for up in ("z", "y"):
        with pytest.raises(ContradictionError) as error:
            warnings_of(room(), frame_id="camera_optical_frame", up=up)
        assert error.value.located[0].location == ("up",)


def test_errors_of_boxes_are_read_in_metres():
    entry = {"label": "bed", "position": [0, 0, 40], "size": [80, 105, 40]}
    stated = {**entry, "position_std": 2, "size_std": 1}
    request = OutliersRequest(objects=[stated, entry], units="cm", extents="half")
    things = read_scene(request, VOCABULARY, Limits()).scene.objects
    assert [(t.position_std, t.size_std) for t in things] == [(0.02, 0.02), (None, None)]
    with pytest.raises(ValueError, match="position_std"):
        OutliersRequest(objects=[{**entry, "position_std": -1}])
