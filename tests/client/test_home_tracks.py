"""Tracks: existence, labels, association, and jumps of the map."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scene_client import Home, InvalidRequestError, Settings
from scene_client.floor_plan import inside
from scene_client.home_settings import Latch
from scene_client.tracks import FULL, LABELS, MOST_CERTAIN, POSES
from tests.client.homes import FakeClient, thing

VIEW = (math.radians(90), 5.0)
ROOMS = {"kitchen": [(-1.0, -3.0), (6.0, -3.0), (6.0, 3.0), (-1.0, 3.0)]}
POSE = (0.0, 0.0, 0.0)


def home(**options) -> Home:
    return Home(FakeClient(), **{"rooms": ROOMS, "view": VIEW, **options})


def labels(some: Home) -> list[str]:
    return sorted(one.label for one in some.things())


@given(
    looks=st.lists(st.booleans(), max_size=6),
    confidence=st.floats(0.1, 1.0),
    situation=st.sampled_from(["full", "poses", "labels"]),
)
def test_existence_is_the_log_odds_filter(looks, confidence, situation):
    s = Settings(hit_rate=0.6, false_rate=0.05, prior=0.2)
    one = home(settings=s, view=VIEW if situation == "full" else None)
    places = situation != "labels"
    cup = thing("cup", 2.0, confidence=confidence) if places else {"label": "cup"}
    cup["confidence"] = confidence
    # Neighbours on both sides, farther away.
    around = [thing("bed", 4.0, 1.0), thing("desk", 4.0, -1.0)] if places else [{"label": "bed"}]
    seen = FULL if places else LABELS
    shown = {"full": FULL, "poses": POSES, "labels": LABELS}[situation]
    expected = math.log(0.2 / 0.8) + confidence * math.log(seen * 0.6 / 0.05)
    for second, hit in enumerate([True, *looks]):
        pose = POSE if places else None
        one.update([*around, cup] if hit else around, pose, float(second), room="kitchen")
        if second and hit:
            expected = min(MOST_CERTAIN, expected + confidence * math.log(seen * 0.6 / 0.05))
        elif second:
            expected += math.log((1 - shown * 0.6) / (1 - 0.05))
        if expected < math.log(0.05):
            return
    (cup_track,) = [t for t in one._tracks.all.values() if t.label == "cup"]
    assert cup_track.log_odds == pytest.approx(expected)


def test_a_frame_of_a_fast_camera_counts_in_proportion():
    slow, fast = home(), home()
    for tick in range(3):
        slow.update([thing("cup", 2.0)], POSE, tick * 0.5)
    for tick in range(31):
        fast.update([thing("cup", 2.0)], POSE, tick / 30)
    (a,), (b,) = slow._tracks.all.values(), fast._tracks.all.values()
    assert a.log_odds == pytest.approx(b.log_odds)


def test_things_appear_once_and_go_when_their_place_is_seen_without_them():
    one, kinds = home(), []
    for second in range(5):
        kinds += [e.kind for e in one.update([thing("cup", 2.0)], POSE, float(second))]
    for second in range(5, 60):  # looks away: nothing changes
        kinds += [e.kind for e in one.update([], (0.0, 0.0, math.pi), float(second))]
    assert labels(one) == ["cup"]
    for second in range(60, 80):
        kinds += [e.kind for e in one.update([], POSE, float(second))]
    assert [kind for kind in kinds if kind in ("appeared", "gone")] == ["appeared", "gone"]
    assert not one._tracks.all


def test_walls_of_unknown_rooms_hide_things():
    one = home(rooms=None)
    for second in range(5):
        one.update([thing("cup", 4.0)], POSE, float(second))
    for second in range(5, 40):  # a wall at 1.5 m
        one.update([thing("poster", 1.4)], POSE, float(second))
    assert "cup" in labels(one)
    for second in range(40, 60):  # an open view beyond the place
        one.update([thing("bed", 4.9)], POSE, float(second))
    assert labels(one) == ["bed"]


def test_labels_are_votes_and_the_second_is_an_alternative():
    one = home()
    for second, label in enumerate(["cup", "bowl", "cup", "bowl", "cup", "cup"]):
        one.update([thing(label, 2.0), thing("bed", 3.0)], POSE, float(second))
    cup = next(o for o in one.scene()["objects"] if o["label"] == "cup")
    assert labels(one) == ["bed", "cup"]
    assert [a["label"] for a in cup["alternatives"]] == ["bowl"]
    assert cup["confidence"] == pytest.approx(2 * cup["alternatives"][0]["confidence"], abs=0.01)


def test_alternatives_of_a_detector_are_votes():
    one = home()
    guess = [{"label": "bowl", "confidence": 0.6}]
    for second in range(4):
        one.update([thing("cup", 2.0, confidence=0.3, alternatives=guess)], POSE, float(second))
    assert labels(one) == ["bowl"]


def test_neighbours_keep_their_labels():
    """A stove and an oven at one place: each detection goes to the track of its label."""
    one, rng = home(), random.Random(0)
    for second in range(20):
        seen = [thing("stove", 2.0, rng.gauss(0, 0.03)), thing("oven", 2.0, rng.gauss(0, 0.03))]
        rng.shuffle(seen)
        one.update(seen[: rng.choice((1, 2, 2))], POSE, float(second))
    assert labels(one) == ["oven", "stove"]
    assert all(len(track.votes) == 1 for track in one.things())


def test_a_moved_thing_is_the_same_if_it_is_the_only_candidate():
    one, events = home(), []
    for second in range(5):
        one.update([thing("cup", 2.0), thing("bed", 3.0, 1.0)], POSE, float(second))
    before = {track.label: track.id for track in one.things()}
    for second in range(5, 12):
        events += one.update([thing("cup", 3.5, -1.0), thing("bed", 3.0, 1.0)], POSE, float(second))
    after = {track.label: track for track in one.things()}
    assert after["cup"].id == before["cup"]
    assert after["cup"].place[0] == pytest.approx(3.5, abs=0.01)
    assert not [e for e in events if e.kind in ("appeared", "gone")]


def test_the_map_jumps():
    one, rng = home(), random.Random(1)
    spots = [(f"thing {k}", 1.5 + k % 3, (k // 3 - 1) * 0.9) for k in range(9)]

    def frame(dx, dy):
        seen = [thing(n, x + dx + rng.gauss(0, 0.03), y + dy) for n, x, y in spots]
        return rng.sample(seen, 7)

    for second in range(6):
        one.update(frame(0, 0), POSE, float(second))
    before = {track.label: track.id for track in one.things()}
    events = []
    for second in range(6, 20):
        events += one.update(frame(0.8, -0.6), (0.8, -0.6, 0.0), float(second))
    assert {track.label: track.id for track in one.things()} == before
    assert not [e for e in events if e.kind in ("appeared", "gone")]
    # A request is in the frame of the map as it is now.
    where = {o["label"]: o["position"] for o in one.scene()["objects"]}
    assert where["thing 0"][:2] == pytest.approx([2.3, -1.5], abs=0.1)
    assert one.scene()["viewpoint"] == pytest.approx({"x": 0.8, "y": -0.6, "yaw": 0.0})
    for second in range(20, 26):
        events += one.update(frame(0, 0), POSE, float(second))
    assert {track.label: track.id for track in one.things()} == before


def test_labels_only_counts_instances():
    one = home(rooms=None, view=None)
    for second in range(20):
        seen = ["table", "chair", "chair"] if second % 2 else ["table", "chair"]
        one.update(seen, stamp=float(second), room="kitchen")
    assert labels(one) == ["chair", "chair", "table"]
    for second in range(20, 120):
        one.update(["bed"], stamp=float(second), room="bedroom")
    assert len(one.things("kitchen")) == 3
    for second in range(120, 240):
        one.update(["table"], stamp=float(second), room="kitchen")
    assert [track.label for track in one.things("kitchen")] == ["table"]


def test_the_objects_of_a_request_are_detections():
    quaternion = {"x": 0.0, "y": 0.0, "z": math.sin(0.4), "w": math.cos(0.4)}
    one = home()
    for second in range(3):
        one.update([thing("bed", 2.0, orientation=quaternion), "lamp"], POSE, float(second))
    (bed,) = [o for o in one.scene()["objects"] if o["label"] == "bed"]
    assert bed["yaw"] == pytest.approx(0.8, abs=1e-3)
    assert one.matched == ["t1", "t2"]
    with pytest.raises(InvalidRequestError, match="#/objects/1/confidence"):
        one.update(["bed", {"label": "cup", "confidence": 7.0}], POSE, 3.0)


def test_time_that_goes_back_is_no_error():
    one = home()
    for second in (10.0, 11.0, 12.0, 3.0, 4.0, 5.0):
        one.update([thing("cup", 2.0)], POSE, second)
    assert labels(one) == ["cup"]
    stamp = {"sec": 6, "nanosec": 500_000_000}
    assert one.update([], POSE, stamp) == []
    assert one._now == 6.5


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_points_in_polygons(x, y):
    corner = [(-1.0, -1.0), (1.0, -1.0), (1.0, 0.0), (0.0, 0.0), (0.0, 1.0), (-1.0, 1.0)]
    edges = (-1.0, 0.0, 1.0)
    if all(abs(x - edge) > 1e-9 and abs(y - edge) > 1e-9 for edge in edges):
        assert inside(x, y, corner) == (abs(x) < 1 and abs(y) < 1 and not (x > 0 and y > 0))


@given(st.lists(st.sampled_from(["a", "b", None]), max_size=60))
def test_a_latch_changes_after_three_steps_ahead(values):
    latch, changes = Latch(), []
    for now, value in enumerate(values):
        before = latch.value
        if latch.update(value, float(now), 1 / 3):
            changes.append((before, value))
            assert latch.since <= now - 2
            assert values[now - 2 : now + 1].count(value) >= 1
    assert all(a != b for a, b in changes)
    assert len(changes) <= len(values) / 3
