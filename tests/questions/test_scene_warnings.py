"""Warnings that compare the sizes of a scene with typical sizes, one mistake at a time."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from app.questions.reading import Limits, read_scene
from app.scene.vocabulary import ObjectClass, Vocabulary
from scene_client.schemas import OutliersRequest

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


def warned(objects: list[Any], frame_id: str | None = None) -> dict[str, list[str]]:
    request = OutliersRequest(objects=objects, frame_id=frame_id)
    reading = read_scene(request, VOCABULARY, Limits())
    assert all(one.message for one in reading.warnings)
    return {one.code: one.objects for one in reading.warnings}


def in_units(factor: float) -> list[Detection]:
    return room(size=lambda s: [factor * side for side in s])


def exchanged(p: tuple[float, ...]) -> tuple[float, ...]:
    """To a frame whose y axis points up."""
    return p[0], p[2], p[1]


def optical(p: tuple[float, ...]) -> tuple[float, ...]:
    """To optical axes, up to signs that a size must not have."""
    return p[1], p[2], p[0]


@pytest.mark.parametrize("factor", [0.1, 1 / 0.3048, 10.0, 1 / 0.0254, 100.0, 1000.0])
def test_sizes_in_another_unit(factor: float) -> None:
    assert warned(in_units(factor)) == {"implausible-scale": [*FURNITURE, "book"]}
    request = OutliersRequest(objects=in_units(factor))
    (warning,) = read_scene(request, VOCABULARY, Limits()).warnings
    named = float(warning.message.split(" times")[0].split()[-1])
    assert named == pytest.approx(factor, rel=0.25)


def test_a_unit_needs_three_things_that_agree() -> None:
    bed, desk, *others = in_units(10.0)
    robot = {"label": "robot", "size": [4, 4, 10]}  # without a typical size
    assert warned([bed, desk, robot]) == {"implausible-size": ["bed"]}
    assert warned([bed, desk, *room()[2:]]) == {"implausible-size": ["bed"]}
    # A thing without a position has a unit too.
    bare = [{"label": one["label"], "size": one["size"]} for one in others]
    assert warned(bare) == {"implausible-scale": ["chair", "wardrobe", "book"]}


def test_a_frame_whose_y_axis_points_up() -> None:
    assert warned(room(exchanged)) == {"y-axis-up": FURNITURE}
    # A turn about the vertical, which is y.
    upright = [one | {"orientation": [0, QUARTER, 0, QUARTER]} for one in room(exchanged)]
    assert warned(upright) == {"y-axis-up": FURNITURE}
    assert warned(room(exchanged)[:2]) == {}
    assert warned([*room(exchanged)[:2], *room()[2:]]) == {}


def test_quaternions_with_w_first() -> None:
    """A quarter turn about z is then a quarter turn about x, and the identity a half turn."""
    quarter = [QUARTER, 0, 0, QUARTER]
    assert warned(turned(quarter, "bed", "book")) == {"rolled-objects": ["bed"]}
    scene = turned(quarter, "bed")
    scene[1]["orientation"] = [1, 0, 0, 0]
    assert warned(scene) == {"rolled-objects": ["bed"]}
    # One chair may have fallen over, if the other quaternions are right.
    scene = turned(quarter, "chair")
    scene[1]["orientation"] = [0, 0, QUARTER, QUARTER]
    assert warned(scene) == {}
    for one in (scene[0], scene[3]):
        one["orientation"] = quarter
    assert warned(scene) == {"rolled-objects": ["bed", "chair", "wardrobe"]}


def test_sizes_with_z_as_height_in_an_optical_frame() -> None:
    objects = room(optical, size=lambda s: s)
    assert warned(objects, "camera_optical_frame") == {"rolled-objects": FURNITURE}


@pytest.mark.parametrize(
    ("objects", "frame_id"),
    [
        (room(), None),
        (room(), "map"),
        (turned([0, 0, QUARTER, QUARTER], *FURNITURE), "map"),
        (turned([0, 0, 0.4, math.sqrt(0.84)], *FURNITURE, "book"), None),
        (turned([0, 0, 0, 1], *FURNITURE), None),
        ([one | {"yaw": 1.0} for one in room()], None),
        (room(optical), "camera_optical_frame"),
        (  # boxes with z as height, turned into optical axes
            [
                one | {"orientation": [0.5, -0.5, 0.5, 0.5]}
                for one in room(optical, size=lambda s: s)
            ],
            "camera_optical_frame",
        ),
        ([one | {"size": [one["size"][0], 0.0, one["size"][2]]} for one in room()], None),
    ],
)
def test_right_scenes_get_no_warning(objects: list[Detection], frame_id: str | None) -> None:
    assert warned(objects, frame_id) == {}
