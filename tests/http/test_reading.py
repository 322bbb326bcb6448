"""From requests to scenes: ids, labels, relations, poses."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.serving.errors import Reason, RequestError
from app.serving.reading import Limits, Reading, read_scene
from scene_client.schemas import SceneRequest
from tests.http.stores import VOCABULARY
from tests.scene.turns import Turn, about, after


def read(limits: Limits | None = None, **request: Any) -> Reading:
    return read_scene(SceneRequest.model_validate(request), VOCABULARY, limits or Limits())


def ids(reading: Reading) -> list[str]:
    return [thing.id for thing in reading.scene.objects]


def faults(**request: Any) -> tuple[Reason, list[tuple[str | int, ...]]]:
    with pytest.raises(RequestError) as error:
        read(**request)
    return error.value.reason, [fault.location for fault in error.value.faults]


def at(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


# ------------------------------------------------------------------------------------- names


@pytest.mark.parametrize(
    ("objects", "expected"),
    [
        (["bed", "TV"], ["bed", "TV"]),
        (["chair", "chair"], ["chair_1", "chair_2"]),
        (
            ["chair", {"id": "chair_1", "label": "chair"}, "chair"],
            ["chair_2", "chair_1", "chair_3"],
        ),
        (["chair", {"id": "c", "label": "chair"}], ["chair", "c"]),
        ([{"id": "chair", "label": "table"}, "chair"], ["chair", "chair_1"]),
        ([{"label": "lamp"}, {"label": "lamp"}], ["lamp_1", "lamp_2"]),
    ],
)
def test_objects_without_an_id_are_named_by_their_label(
    objects: list[Any], expected: list[str]
) -> None:
    assert ids(read(objects=objects)) == expected


@given(
    st.lists(
        st.one_of(
            st.sampled_from(["chair", "lamp", "bed"]),
            st.fixed_dictionaries({"label": st.sampled_from(["chair", "lamp"])}),
        ),
        min_size=1,
        max_size=12,
    ),
    st.sets(st.sampled_from(["chair", "chair_1", "chair_2", "lamp_1", "bed"]), max_size=4),
)
def test_ids_are_always_distinct_and_given_ones_are_kept(
    objects: list[Any], given: set[str]
) -> None:
    own = [{"id": name, "label": "sofa"} for name in sorted(given)]
    named = ids(read(objects=[*objects, *own]))
    assert len(set(named)) == len(named)
    assert named[len(objects) :] == sorted(given)


def test_ids_win_over_labels() -> None:
    reading = read(
        objects=[{"id": "lamp", "label": "bed"}, {"id": "x", "label": "lamp"}, "chair"],
        relations=[{"subject": "lamp", "relation": "left", "object": "chair"}],
    )
    assert reading.scene.relations == ((0, 0, 2),)


def test_an_unambiguous_label_names_its_object_in_any_spelling() -> None:
    reading = read(
        objects=[{"id": "a", "label": "trash can"}, {"id": "b", "label": "bed"}],
        relations=[{"subject": "Garbage_Bins", "relation": "behind", "object": "beds"}],
    )
    assert reading.scene.relations == ((1, 1, 0),)


# ------------------------------------------------------------------------------------ labels


def test_unknown_labels_can_be_left_out_with_all_that_hangs_on_them() -> None:
    reading = read(
        objects=["bed", "flux capacitor", {"id": "r2", "label": "droid"}, "lamp"],
        relations=[
            {"subject": "lamp", "relation": "left", "object": "Flux_Capacitor"},
            {"subject": "r2", "relation": "left", "object": "bed"},
            {"subject": "lamp", "relation": "left", "object": "bed"},
        ],
        room_type="hangar",
        unknown_labels="ignore",
    )
    assert ids(reading) == ["bed", "lamp"]
    assert reading.ignored == ("flux capacitor", "r2", "hangar")
    assert reading.scene.relations == ((0, 1, 0),)
    assert reading.scene.room_type is None


def test_a_scene_of_unknown_labels_alone_is_refused() -> None:
    assert faults(objects=["droid"], unknown_labels="ignore") == (Reason.INVALID, [("objects",)])


# --------------------------------------------------------------------------------- relations


def relation(subject: str, name: str, other: str) -> dict[str, str]:
    return {"subject": subject, "relation": name, "object": other}


def test_saying_one_thing_twice_is_no_contradiction() -> None:
    given = [relation("bed", "left", "lamp"), relation("lamp", "right", "bed")]
    assert read(objects=["bed", "lamp"], relations=given).scene.relations == ((0, 0, 1),)


def test_different_relations_of_one_pair_may_hold_together() -> None:
    given = [relation("bed", "left", "lamp"), relation("bed", "front", "lamp")]
    assert len(read(objects=["bed", "lamp"], relations=given).scene.relations or ()) == 2


def test_an_operator_may_lower_the_limits() -> None:
    with pytest.raises(RequestError) as error:
        read(
            Limits(objects=2, relations=0),
            objects=["bed"] * 3,
            relations=[relation("a", "left", "b")],
        )
    assert [fault.location for fault in error.value.faults] == [("objects",), ("relations",)]


# ------------------------------------------------------------------------------------- poses

LAMP_ON_DESK = [
    {"id": "d", "label": "desk", "position": at(2, 0, 0.4), "size": at(0.7, 1.4, 0.8)},
    {"id": "l", "label": "lamp", "position": at(2, 0.5, 1.0), "size": at(0.2, 0.2, 0.4)},
]


def observed(reading: Reading) -> set[tuple[str, str, str]] | None:
    if reading.observed is None:
        return None
    return {(entry.subject, entry.relation, entry.object) for entry in reading.observed}


# From body axes to those of a camera: x right, y down, z forward.
TO_OPTICAL: Turn = (0.5, -0.5, 0.5, 0.5)
LYING: Turn = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


@given(st.integers(0, 2**32))
def test_one_scene_told_in_three_frames_is_one_scene(seed: int) -> None:
    """Random boxes, turned and lying, by a robot, by its camera, and in a map."""
    draw = random.Random(seed)
    robot = [draw.uniform(-5, 5), draw.uniform(-5, 5), draw.uniform(-7, 7)]
    cos, sin = math.cos(robot[2]), math.sin(robot[2])
    told: dict[str, list[Any]] = {"base_link": [], "camera_optical_frame": [], "map": []}
    for number in range(draw.randint(2, 6)):
        x, y, z = (draw.uniform(-2, 2) for _ in range(3))
        turn = about((0, 0, 1), draw.uniform(-4, 4))
        if draw.random() < 0.4:
            turn = after(turn, LYING)
        thing: dict[str, Any] = {"id": str(number), "label": "desk"}
        if draw.random() < 0.8:
            thing["size"] = at(*(draw.uniform(0.05, 2) for _ in range(3)))
        in_map = (robot[0] + cos * x - sin * y, robot[1] + sin * x + cos * y, z)
        for frame, place, turned in (
            ("base_link", (x, y, z), turn),
            ("camera_optical_frame", (-y, -z, x), after(TO_OPTICAL, turn)),
            ("map", in_map, after(about((0, 0, 1), robot[2]), turn)),
        ):
            orientation = dict(zip("xyzw", turned, strict=True))
            told[frame].append(thing | {"position": at(*place), "orientation": orientation})
    here = observed(read(objects=told["base_link"], frame_id="base_link"))
    camera = "camera_optical_frame"
    assert observed(read(objects=told[camera], frame_id=camera)) == here
    viewpoint = dict(zip(("x", "y", "yaw"), robot, strict=True))
    assert observed(read(objects=told["map"], frame_id="map", viewpoint=viewpoint)) == here
    vertical = {entry for entry in here or () if entry[1] in ("on-top", "above")}
    assert observed(read(objects=told["map"], frame_id="/map")) == vertical


@given(
    st.lists(
        st.fixed_dictionaries(
            {
                "label": st.sampled_from(["bed", "lamp", "chair", "book"]),
                "position": st.fixed_dictionaries(
                    {axis: st.floats(-1e8, 1e8, allow_nan=False) for axis in "xyz"}
                ),
            },
            optional={
                "size": st.fixed_dictionaries(
                    {axis: st.floats(1e-300, 1e4, allow_nan=False) for axis in "xyz"}
                )
            },
        ),
        min_size=1,
        max_size=6,
    )
)
def test_any_poses_can_be_read(objects: list[Any]) -> None:
    reading = read(objects=objects)
    pairs = {(entry.subject, entry.relation, entry.object) for entry in reading.observed or ()}
    assert not {(o, name, s) for s, name, o in pairs} & pairs


# ----------------------------------------------------------------------------------- nearest


def test_unknown_labels_can_be_taken_for_the_nearest_class() -> None:
    reading = read(
        objects=["bed", "nigthstand", {"id": "x", "label": "big lamp"}, "nigthstand"],
        relations=[
            {"subject": "big lamp", "relation": "left", "object": "bed"},
            {"subject": "lamp", "relation": "front", "object": "bed"},
        ],
        room_type="bedrom",
        unknown_labels="nearest",
    )
    assert ids(reading) == ["bed", "nigthstand_1", "x", "nigthstand_2"]
    labels = [VOCABULARY.labels[thing.class_index or 0] for thing in reading.scene.objects]
    assert labels == ["bed", "nightstand", "lamp", "nightstand"]
    assert reading.scene.relations == ((0, 2, 0), (1, 2, 0))
    assert reading.scene.room_type == 0
    mapped = [(one.label, one.class_) for one in reading.unknown.mapped.values()]
    assert mapped == [("nigthstand", "nightstand"), ("big lamp", "lamp"), ("bedrom", "bedroom")]
    assert all(0.8 <= one.similarity <= 1 for one in reading.unknown.mapped.values())
    assert reading.ignored == ()


def test_a_label_that_is_like_none_is_refused_all_the_same() -> None:
    reason, where = faults(objects=["bed", "droid", "big lamp"], unknown_labels="nearest")
    assert (reason, where) == (Reason.UNKNOWN_LABELS, [("objects", 1)])


# ---------------------------------------------------------------------------------- spelling


def test_the_reading_keeps_which_relations_are_spelled_from_the_other_end() -> None:
    given = [relation("bed", "right", "lamp"), relation("bed", "front", "lamp")]
    reading = read(objects=["bed", "lamp"], relations=given)
    assert reading.scene.relations == ((0, 1, 0), (1, 0, 1))
    assert reading.flipped == {(0, 1, 0)}
    assert read(objects=LAMP_ON_DESK).flipped == frozenset()


# ---------------------------------------------------------------------------------- warnings


def warned(**request: Any) -> list[tuple[str, list[str]]]:
    return [(one.code, one.objects) for one in read(**request).warnings]


def test_a_plain_scene_has_no_warnings() -> None:
    assert warned(objects=["bed", "lamp"]) == []
    assert warned(objects=LAMP_ON_DESK) == []
    assert warned(objects=LAMP_ON_DESK, frame_id="map") == []


def test_millimetres_are_noticed() -> None:
    far = {"id": "far", "label": "chair", "position": at(2000, 300, 400), "size": at(1, 1, 1)}
    assert warned(objects=[*LAMP_ON_DESK, far]) == [("implausible-position", ["far"])]
    sizes = [{"id": "a", "label": "bed", "size": at(500, 2, 1)}]
    sizes += [{"id": "b", "label": "bed", "size": at(1, 0.0005, 1)}]
    assert warned(objects=sizes) == [("implausible-size", ["a", "b"])]


def test_a_map_may_be_large() -> None:
    moved = [
        {**one, "position": {**one["position"], "x": one["position"]["x"] + 500}}
        for one in LAMP_ON_DESK
    ]
    assert warned(objects=moved) == [("implausible-position", ["d", "l"])]
    assert warned(objects=moved, frame_id="map") == []
    viewpoint = {"x": 499.0, "y": 0.0, "yaw": 0.0}
    assert warned(objects=moved, frame_id="map", viewpoint=viewpoint) == []


def test_a_camera_without_depth_is_noticed() -> None:
    size = at(0.2, 0.2, 0.2)
    objects = [
        {"id": str(k), "label": "book", "position": at(0.4 * k, 0.1 * k, 0), "size": size}
        for k in range(3)
    ]
    camera = "camera_optical_frame"
    assert warned(objects=objects, frame_id=camera) == [("flat-scene", ["0", "1", "2"])]
    assert warned(objects=objects[:2], frame_id=camera) == []
    assert warned(objects=objects, frame_id="base_link") == []


def test_sizes_that_nobody_knows_are_noticed() -> None:
    """The vocabulary has typical sizes of lamps and desks, of beds it has none."""
    bed = {"id": "b", "label": "bed", "position": at(2, 1, 0.3)}
    bare = [{key: value for key, value in one.items() if key != "size"} for one in LAMP_ON_DESK]
    assert warned(objects=[*bare, bed]) == [("unknown-sizes", ["b"])]
    assert warned(objects=[bare[0], bed]) == [("unknown-sizes", ["b"])]
    assert warned(objects=[bed]) == []
    assert warned(objects=[*bare, bed], relations=[]) == []
