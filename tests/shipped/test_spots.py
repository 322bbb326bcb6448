"""Where a robot arm would place things: offsets of the default model in furnished rooms."""

import math

import pytest

from scene_client import OfflineClient
from tests.conftest import REPOSITORY

# Objects: (x, y, bottom) and (length, width, height) in metres.
ROOMS = {
    "bathroom": {
        "sink": ((1.0, 0, 0.85), (0.5, 0.4, 0.18)),
        "toilet": ((1, -1, 0), (0.6, 0.4, 0.8)),
    },
    "office": {
        "desk": ((1.2, 0, 0), (0.7, 1.4, 0.74)),
        "monitor": ((1.4, 0, 0.74), (0.2, 0.6, 0.45)),
        "cup": ((1.0, 0.5, 0.74), (0.09, 0.09, 0.1)),
        "chair": ((0.5, 0, 0), (0.5, 0.5, 0.9)),
    },
    "bedroom": {
        "bed": ((2.5, 0, 0), (2.1, 1.6, 1.1)),
        "pillow": ((3.2, 0.4, 0.62), (0.4, 0.6, 0.15)),
        "nightstand": ((3.3, 1.1, 0), (0.4, 0.45, 0.55)),
    },
    "kitchen": {
        "refrigerator": ((1.5, 1.5, 0), (0.7, 0.7, 1.8)),
        "egg": ((1.5, 1.5, 1.0), (0.2, 0.2, 0.1)),
        "stove": ((1.5, 0.3, 0), (0.6, 0.6, 0.9)),
    },
    "dining room": {
        "table": ((1.5, 0, 0), (0.9, 1.6, 0.75)),
        "vase": ((0.7, 0, 0), (0.3, 0.3, 0.5)),
        "plate": ((1.5, 0, 0.75), (0.25, 0.25, 0.02)),
    },
}


@pytest.fixture(scope="module")
def client():
    with OfflineClient(str(REPOSITORY / "model_store")) as client:
        yield client


@pytest.fixture
def spot(client):
    """A function of a room and a place: the centre, and the bottom above the floor, or None."""
    sizes = {"faucet": 0.26, "keyboard": 0.05, "teddy bear": 0.47, "lamp": 0.42, "milk": 0.24}
    sizes |= {"pan": 0.05, "chair": 0.88, "bowl": 0.08, "cup": 0.1}

    def ask(room, missing, relation, anchor, frame="base_link"):
        objects, is_optical = [], frame.endswith("optical_frame")
        for label, ((x, y, bottom), (length, width, height)) in ROOMS[room].items():
            centre, size = (x, y, bottom + height / 2), (length, width, height)
            if is_optical:
                (x, y, z), (length, width, height) = centre, size
                centre, size = (-y, -z, x), (width, height, length)
            objects.append({"label": label, "position": centre, "size": size})
        answer = client.missing(
            objects, candidates=[missing], at=(relation, anchor), frame_id=frame
        )
        place = answer.missing[0].placements[0]
        assert (place.relation, place.object) == (relation, anchor)
        if place.offset is None:
            return None
        mean, ((x, y, bottom), (_, _, height)) = place.offset.mean, ROOMS[room][anchor]
        dx, dy, dz = (mean.z, -mean.x, -mean.y) if is_optical else (mean.x, mean.y, mean.z)
        return x + dx, y + dy, bottom + height / 2 + dz - sizes[missing] / 2

    return ask


@pytest.mark.parametrize("frame", ["base_link", "map", "camera_optical_frame"])
def test_things_touch_the_faces_of_the_given_boxes(spot, frame):
    height = lambda *place: spot(*place, frame)[2]  # noqa: E731
    near = lambda value: pytest.approx(value, abs=0.006)  # noqa: E731
    assert height("bathroom", "faucet", "on-top", "sink") == near(0.85 + 0.18)
    assert height("kitchen", "pan", "on-top", "stove") == near(0.9)
    assert height("bedroom", "lamp", "on-top", "nightstand") == near(0.55)
    assert 0 <= height("kitchen", "milk", "inside", "refrigerator") <= 1.8 - 0.24
    assert height("dining room", "bowl", "on-top", "table") == near(0.75)


def test_a_keyboard_lies_in_front_of_the_monitor(spot):
    x, y, bottom = spot("office", "keyboard", "on-top", "desk")
    assert bottom == pytest.approx(0.74, abs=0.006)
    assert 0.85 < x < 1.3 - 0.19  # on the desk, and not under the monitor
    assert abs(y) < 0.5
    x, y, bottom = spot("office", "keyboard", "front", "monitor")
    assert bottom == pytest.approx(0.74, abs=0.006)
    assert 0.85 < x < 1.3 - 0.19


def test_a_teddy_bear_lies_on_the_bed_and_not_on_its_headboard(spot):
    x, y, bottom = spot("bedroom", "teddy bear", "on-top", "bed")
    assert bottom == pytest.approx(0.6, abs=0.05)
    assert not (x > 2.8 and -0.1 < y < 0.9)  # the pillow


def test_things_in_a_refrigerator_do_not_share_a_spot(spot):
    x, y, bottom = spot("kitchen", "milk", "inside", "refrigerator")
    assert max(abs(x - 1.5), abs(y - 1.5)) >= 0.15 or not 0.76 < bottom < 1.1


def test_a_chair_stands_in_front_of_the_table_and_beside_the_vase(spot):
    x, y, bottom = spot("dining room", "chair", "front", "table")
    assert bottom == pytest.approx(0.0, abs=0.006)
    assert x + 0.25 <= 1.05
    assert max(abs(x - 0.7), abs(y)) >= 0.15 + 0.25
    x, y, _ = spot("dining room", "bowl", "on-top", "table")
    assert math.hypot(x - 1.5, y) > 0.2  # not on the plate
