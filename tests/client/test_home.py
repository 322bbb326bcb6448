"""Events of a home: alarms, rooms, a lost service, confirmed habits, and its questions."""

import math
import os
import sys
from typing import Any

import pytest

from scene_client import (
    Client,
    Event,
    Home,
    InvalidRequestError,
    ProblemError,
    Settings,
    UnknownThingError,
    UnreachableError,
    rooms_from_file,
)
from tests.client.homes import FakeClient, thing
from tests.conftest import REPOSITORY, run_program
from training.datasets.jsonl import read_jsonl

VIEW = (math.radians(90), 5.0)
ROOMS = {
    "kitchen": [(-1.0, -3.0), (6.0, -3.0), (6.0, 3.0), (-1.0, 3.0)],
    "area 2": [(6.0, -3.0), (12.0, -3.0), (12.0, 3.0), (6.0, 3.0)],
}
POSE, BESIDE = (0.0, 0.0, 0.0), (7.0, 0.0, 0.0)
KITCHEN = [thing("stove", 2.0), thing("fridge", 3.0, 1.0), thing("toilet", 3.0, -1.0)]
ALARMS = ("out-of-place", "misplaced", "misdetection", "cleared")


@pytest.fixture
def client() -> FakeClient:
    return FakeClient()


def home(client: Any, **options: Any) -> Home:
    return Home(client, **{"rooms": ROOMS, "view": VIEW, **options})


def run(
    one: Home, seconds: range, seen: list[Any], pose: Any = POSE, **options: Any
) -> list[Event]:
    return [e for now in seconds for e in one.update(seen, pose, float(now), **options)]


def kinds(events: list[Event], *wanted: str) -> list[str]:
    return [event.kind for event in events if event.kind in (wanted or ALARMS)]


def test_an_alarm_is_one_event_and_so_is_its_end(client):
    client.odd = {"toilet"}
    one = home(client)
    events = run(one, range(20), KITCHEN)
    (alarm,) = [e for e in events if e.kind in ALARMS]
    assert (alarm.kind, alarm.label, alarm.room) == ("out-of-place", "toilet", "kitchen")
    assert 3.0 <= alarm.stamp - alarm.since + 1 <= 4.0
    assert [(e.kind, e.id) for e in one.alarms] == [("out-of-place", alarm.id)]
    client.odd = set()
    # Nothing has changed, so the home does not ask. Something new changes the answer.
    assert kinds(run(one, range(20, 40), KITCHEN)) == []
    events = run(one, range(40, 60), [*KITCHEN, thing("cup", 4.0)])
    assert kinds(events) == ["cleared"]
    assert one.alarms == []


def test_another_label_is_one_event(client):
    """The first detection has a swapped label. Later, two labels have equal votes."""
    one = home(client)
    seen = [[thing(label, 2.0), thing("fridge", 3.0)] for label in ("plant", "mirror")]
    order = [0] * 3 + [1] * 17 + [0] * 15 + [0, 1] * 10
    frames = [seen[which] for which in order]
    events = [e for now, frame in enumerate(frames) for e in one.update(frame, POSE, float(now))]
    plant, *_, change = [e for e in events if e.label in ("plant", "mirror")]
    assert kinds(events, "appeared", "relabelled") == ["appeared", "appeared", "relabelled"]
    assert (change.label, change.detail, change.id) == ("mirror", "plant", plant.id)


def test_a_rare_swap_raises_no_doubt(client):
    """The service compares the confidence with the context, so nine right looks count."""
    one = home(client)
    for now in range(10):
        label = "vase" if now == 4 else "toilet"
        one.update([thing("fridge", 2.0), thing(label, 3.0, 1.0)], POSE, float(now))
    (toilet,) = [o for o in one.scene()["objects"] if o["label"] == "toilet"]
    assert toilet["confidence"] > 0.99
    assert "alternatives" not in toilet


def test_a_changing_answer_raises_no_alarm(client):
    one, events = home(client, settings=Settings(step=0.0)), []
    for now in range(60):
        client.odd = {"toilet"} if now % 2 else set()
        # A cup that moves changes the question in each frame.
        events += one.update([*KITCHEN, thing("cup", 2.0 + 0.01 * now)], POSE, float(now))
    assert len(client.questions("outliers")) > 50
    assert kinds(events) == []


def test_alarms_out_of_view_stay(client):
    client.odd = {"toilet"}
    one = home(client)
    run(one, range(20), KITCHEN)
    client.odd = set()
    away = (0.0, 0.0, math.pi)
    events = run(one, range(20, 200), [thing("sink", -0.9, 0.1)], away)
    assert kinds(events) == []
    assert [alarm.kind for alarm in one.alarms] == ["out-of-place"]


@pytest.mark.parametrize(("rule", "kind"), [("misplaced", "misplaced"), ("unreal", "misdetection")])
def test_kinds_of_alarms(client, rule, kind):
    setattr(client, rule, {"toilet"})
    events = run(home(client), range(20), KITCHEN)
    assert kinds(events) == [kind]


def test_a_new_kind_of_alarm_is_one_event(client):
    client.misplaced = {"toilet"}
    one = home(client)
    events = run(one, range(20), KITCHEN)
    client.odd = {"toilet"}
    events += run(one, range(20, 40), [*KITCHEN, thing("cup", 4.0)])
    assert kinds(events) == ["misplaced", "out-of-place"]
    assert [e.detail for e in events if e.kind in ALARMS] == [None, "misplaced"]


def test_it_asks_only_about_changes_and_at_most_twice_a_second(client):
    one = home(client)
    for tick in range(300):
        one.update(KITCHEN, POSE, tick / 30)
    first = len(client.questions("outliers"))
    assert first <= 12
    run(one, range(10, 60), KITCHEN)
    assert len(client.questions("outliers")) - first <= 3
    question = client.questions("outliers")[-1]
    assert question["frame_id"] == "map"
    assert question["viewpoint"] == {"x": 0.0, "y": 0.0, "yaw": 0.0}
    assert question["room_type"] == "kitchen"
    assert question["unknown_labels"] == "nearest-or-ignore"
    assert all(0.8 < o["confidence"] <= 1 for o in question["objects"])


def test_names_that_are_no_room_types_get_a_type_that_does_not_flicker(client):
    one = home(client, room_candidates=["kitchen", "bathroom"])
    beside = [thing("stove", 8.0), thing("fridge", 9.0, 1.0)]
    events = run(one, range(20), beside, BESIDE)
    (settled,) = [e for e in events if e.kind == "room"]
    assert (settled.room, settled.label, one.room_type("area 2")) == ("area 2", *["kitchen"] * 2)
    assert client.questions("rooms")[0]["candidates"] == ["kitchen", "bathroom"]
    client.types = [("bathroom", 0.6), ("kitchen", 0.4)]
    events = []
    for now in range(20, 24):  # a doubtful change for a short time
        events += one.update([*beside, thing("cup", 8.5)], BESIDE, float(now))
    assert (kinds(events, "room"), one.room_type()) == ([], "kitchen")
    assert "room_type" not in client.questions("outliers")[-1]
    client.types = [("bathroom", 0.99), ("kitchen", 0.01)]
    events = run(one, range(24, 60), [*beside, thing("cup", 8.5), thing("towel", 9.5)], BESIDE)
    assert [(e.label, e.detail) for e in events if e.kind == "room"] == [("bathroom", "kitchen")]


def test_things_and_robots_stay_in_their_room_at_its_edges(client):
    one = home(client)
    run(one, range(5), [thing("towel", 6.1)], (4.0, 0.0, 0.0))  # 10 cm beyond the wall
    assert [track.room for track in one.things()] == ["kitchen"]
    run(one, range(5, 10), [thing("towel", 5.9)], (7.9, 0.0, math.pi))
    assert [track.room for track in one.things()] == ["kitchen"]
    run(one, range(10, 60), [thing("towel", 6.4)], (7.9, 0.0, math.pi))
    assert [track.room for track in one.things()] == ["area 2"]
    places = [(5.9, "area 2"), (5.7, "kitchen"), (6.1, "kitchen"), (6.3, "area 2"), (20, "area 2")]
    for x, room in places:
        one.update([], (x, 0.0, 0.0), 60.0)
        assert one.room == room


def test_a_room_without_polygons(client):
    one = home(client, rooms=None)
    events = run(one, range(20), [*KITCHEN, thing("bed", 4.9)])
    assert [(e.room, e.label) for e in events if e.kind == "room"] == [("", "kitchen")]
    run(one, range(20, 40), [thing("sofa", 9.0)], (7.9, 0.0, 0.0))
    # Things farther than 5 m are not around the robot.
    assert sorted(o["label"] for o in one.scene()["objects"]) == ["bed", "sofa"]
    named = home(client, rooms=None, view=None)
    run(named, range(30), ["stove", "toilet"], None, room="kitchen")
    assert named.room_type() == "kitchen"
    assert [o["label"] for o in named.scene("kitchen")["objects"]] == ["stove", "toilet"]


def test_a_lost_service_is_one_event_and_its_return_is_no_storm(client):
    one = home(client)
    run(one, range(10), KITCHEN)
    client.error, client.asked = UnreachableError("connection refused"), []
    more = [*KITCHEN, *(thing(f"cup {k}", 1.5 + 0.5 * k, 2.0 - k) for k in range(4))]
    events = run(one, range(10, 310), more)
    assert kinds(events, "service", *ALARMS) == ["service"]
    (lost,) = [e for e in events if e.kind == "service"]
    assert (lost.label, lost.detail) == ("lost", "connection refused")
    tries = [fields["timeout"] for _, _, fields in client.asked]
    assert len(tries) <= 16  # 2, 4, 8, 16, 30, 30, … seconds
    assert set(tries[1:]) == {0.3}
    client.error, client.odd = None, {"cup 1"}
    events = run(one, range(310, 400), more)
    assert kinds(events, "service", "appeared", "gone") == ["service"]
    assert kinds(events) == ["out-of-place"]


def test_a_refusal_counts_as_lost_but_an_invalid_detection_is_an_error(client):
    client.error = ProblemError("/problems/model-not-found", 404, "Unknown model", "no such model")
    events = run(home(client), range(10), KITCHEN)
    assert "Unknown model" in next(e.detail for e in events if e.kind == "service")
    client.error = InvalidRequestError.about("too long")
    with pytest.raises(InvalidRequestError, match="too long"):
        run(home(client), range(10), KITCHEN)


def test_a_confirmed_habit_stays_quiet_and_is_recorded(client, tmp_path):
    client.odd = {"toilet", "towel"}
    record = tmp_path / "scenes.jsonl"
    record.write_text('{"scene_id": "a", "objects": [{"id": "x", "label": "bed"}]}\n')
    one = home(client, record=record)
    seen = [*KITCHEN, thing("toilet", 4.0), thing("towel", 3.5)]
    assert kinds(run(one, range(20), seen)) == ["out-of-place"] * 3
    toilet = next(alarm.id for alarm in one.alarms if alarm.label == "toilet")
    cleared = one.confirm(toilet)
    assert [(e.kind, e.label) for e in cleared] == [("cleared", "toilet")] * 2
    assert one.confirmed == {("toilet", "kitchen")}
    more = [*seen, thing("toilet", 4.5, -2.0), thing("cup", 2.0, 1.0)]
    assert kinds(run(one, range(20, 60), more)) == []
    first, scene = read_jsonl(record)
    assert (first.scene_id, first.confirmed, scene.confirmed) == ("a", False, True)
    assert scene.room_type == "kitchen"
    labels = sorted(thing.label for thing in scene.objects)
    assert labels == ["fridge", "stove", "toilet", "toilet"]  # not the towel, an open alarm
    with pytest.raises(UnknownThingError, match="the home has no thing 't99', or it is gone"):
        one.confirm("t99")


def test_the_settled_type_of_a_room_is_recorded(client, tmp_path):
    one = home(client, record=tmp_path / "scenes.jsonl")
    run(one, range(20), [thing("stove", 8.0), thing("fridge", 9.0, 1.0)], BESIDE)
    assert one.confirm(one.things("area 2")[0].id) == []  # no alarm was on
    (scene,) = read_jsonl(tmp_path / "scenes.jsonl")
    assert (scene.room_type, scene.confirmed) == ("kitchen", True)


def test_other_rooms_are_not_confirmed(client):
    client.odd = {"toilet"}
    one = home(client)
    run(one, range(20), KITCHEN)
    one.confirm(one.alarms[0].id)
    beside = [thing("stove", 8.0), thing("toilet", 9.0, 1.0)]
    assert kinds(run(one, range(20, 40), beside, BESIDE)) == ["out-of-place"]


def test_questions_about_the_home(client):
    one = home(client)
    run(one, range(20), KITCHEN)
    run(one, range(20, 40), [thing("bed", 8.0), thing("lamp", 9.0, 1.0)], BESIDE)
    one.where("medicine", [{"room": "kitchen"}], top_k=3)
    (where,) = client.questions("where")
    kitchen, other = where["objects"]  # the rooms
    assert (kitchen["id"], kitchen["room_type"]) == ("kitchen", "kitchen")
    assert (other["id"], [o["label"] for o in other["objects"]]) == ("area 2", ["bed", "lamp"])
    assert (where["searched"], where["top_k"]) == ([{"room": "kitchen"}], 3)
    one.missing("kitchen", top_k=2)
    (missing,) = client.questions("missing")
    assert missing["coverage"] == pytest.approx(0.2 + 0.7 / 8)  # one of eight directions
    for turn in range(8):
        one.update([], (0.0, 0.0, turn * math.pi / 4), 40.0 + turn)
    assert one.coverage("kitchen") == pytest.approx(0.9)
    assert one.coverage("area 2") < 0.3


def test_an_id_leads_to_a_position_in_the_map(client):
    one = home(client)
    toilet = next(e.id for e in run(one, range(5), KITCHEN) if e.label == "toilet")
    assert one.thing(toilet)["position"] == pytest.approx([3.0, -1.0, 0.5])
    jumped = [thing(t["label"], t["position"][0] + 1.0, t["position"][1]) for t in KITCHEN]
    run(one, range(5, 8), jumped, (1.0, 0.0, 0.0))
    assert one.thing(toilet)["position"] == pytest.approx([4.0, -1.0, 0.5])
    with pytest.raises(UnknownThingError):
        one.thing("t99")


def test_the_file_of_a_home_has_the_rooms_of_its_question(client, tmp_path):
    one = home(client, path=tmp_path / "home.json")
    run(one, range(20), KITCHEN)
    run(one, range(20, 40), [thing("bed", 8.0), thing("lamp", 9.0, 1.0)], BESIDE)
    one.where("medicine")
    one.close()
    (where,) = client.questions("where")
    fields = rooms_from_file(tmp_path / "home.json")
    assert fields["rooms"] == where["objects"]
    assert len(fields["rooms"][0]["objects"]) == 3
    others = {name: where[name] for name in ("frame_id", "unknown_labels")}
    assert fields == {"rooms": where["objects"], **others}


def test_a_real_service(url: str) -> None:
    """The same calls reach a service, and its answers are read."""
    with Client(url, timeout=60) as client:
        one = Home(client, ROOMS, view=VIEW, settings=Settings(timeout=60.0))
        seen = [thing("bed", 2.0), thing("lamp", 3.0, 1.0), thing("desk", 3.0, -1.0)]
        events = run(one, range(12), seen)
        assert kinds(events, "service") == []
        assert len(kinds(events, "appeared")) == 3
        assert client.outliers(**one.scene("kitchen")).outliers
        assert one.missing().coverage == pytest.approx(one.coverage(), abs=0.01)
        assert all(track.probability > 0 for track in one.things())


# ------------------------------------------------------------------------------------- the package

WITHOUT_NUMPY = """
import sys
sys.modules["numpy"] = None  # importing it fails
from scene_client import Home
home = Home(None)
home.update([])
assert not {"httpx", "training", "app"} & sys.modules.keys(), sys.modules.keys()
"""


def test_a_home_needs_no_numpy():
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY / "clients" / "python")}
    run_program(sys.executable, "-c", WITHOUT_NUMPY, env=environment, cwd="/")


@pytest.mark.parametrize("pose", [POSE, None])
def test_two_frames_of_one_stamp_and_an_older_stamp(client, pose):
    """Two cameras share a stamp, and a recording starts again."""
    frame = KITCHEN if pose else ["stove", "fridge", "toilet"]
    one = home(client) if pose else home(client, rooms=None)
    for stamp in (1.0, 1.0, 2.0, 2.0, 0.0, 0.0, 1.0, 2.0, 3.0):
        one.update(frame[:2], pose, stamp, room="kitchen")
        one.update(frame[2:], pose, stamp, room="kitchen")
    assert {track.label for track in one.things()} == {"stove", "fridge", "toilet"}


def test_a_room_of_unknown_things_is_an_answer(client):
    """The service refuses a scene without any known label. It is not lost."""
    client.error = ProblemError("/problems/invalid-request", 422, "Invalid", "no known object")
    one = home(client)
    events = run(one, range(20), KITCHEN)
    assert kinds(events, "service") == []
    assert len(client.asked) <= 10
    client.error, client.odd = None, {"toilet"}
    assert kinds(run(one, range(20, 40), [*KITCHEN, thing("cup", 4.0)])) == ["out-of-place"]


def test_a_pose_or_a_position_that_is_not_finite_is_none(client):
    one = home(client)
    lost = {"label": "cup", "confidence": 0.9, "position": [math.nan, 0.0, 1.0]}
    events = run(one, range(5), [*KITCHEN, lost])
    assert {e.label for e in events if e.kind == "appeared"} == {"stove", "fridge", "toilet"}
    one.update(KITCHEN, (math.nan, 0.0, 0.0), 6.0)
    one.update(KITCHEN, (0.0, 0.0, math.inf), 7.0)


def test_a_long_room_name_is_no_room_type(client):
    one = home(client, rooms=None)
    run(one, range(5), KITCHEN, None, room="x" * 200)
    assert all("room_type" not in fields for fields in client.questions("outliers"))


@pytest.mark.parametrize(
    "corners",
    [
        [(0.0, 0.0), (1.0, 0.0)],
        [(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)],
        [(0.0, 0.0), (1.0, 0.0), (1.0, math.nan)],
        [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0, 0.0)],
        [0.0, 1.0, 2.0],
        7,
    ],
)
def test_a_polygon_without_area_is_refused(client, corners):
    with pytest.raises(InvalidRequestError, match="#/rooms/hall: must be a list of at least three"):
        home(client, rooms=ROOMS | {"hall": corners})


@pytest.mark.parametrize("pose", [(0.0, 0.0), (0.0, 0.0, "north"), {"x": 0.0, "y": 0.0}, 3.0])
def test_a_pose_of_another_form_is_refused_and_changes_nothing(client, pose):
    one = home(client)
    run(one, range(5), KITCHEN)
    before = one.matched
    with pytest.raises(InvalidRequestError, match="#/pose: must be x, y and yaw"):
        one.update([*KITCHEN, thing("cup", 4.0)], pose, 5.0)
    assert one.matched == before


@pytest.mark.parametrize(
    "wrong", [{"hit_rate": 1.0}, {"prior": 0.0}, {"hold": 0.0}, {"look": -1.0}, {"answers": 0}]
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="must be"):
        Settings(**wrong)


def test_where_asks_about_the_fullest_rooms(client):
    """At most 32 rooms, and an unnamed room has an id of its own."""
    names = ["here", *(f"room {k}" for k in range(40))]
    squares = [[(k, 0.0), (k + 0.9, 0.0), (k + 0.9, 1.0), (k, 1.0)] for k in range(41)]
    one = home(client, rooms=dict(zip(names, squares, strict=True)))
    run(one, range(5), [thing("cup", 40.5, 0.5)], (40.4, 0.1, 1.0))
    one.where("cup")
    (_, rooms, _) = client.asked[-1]
    assert len(rooms) == 32
    assert rooms[0]["id"] == "room 39"


def test_tracks_follow_a_new_name_of_their_room(client, tmp_path):
    with home(client, path=tmp_path / "home.json") as one:
        run(one, range(5), KITCHEN)
    renamed = {"cooking": ROOMS["kitchen"], "area 2": ROOMS["area 2"]}
    again = home(client, rooms=renamed, path=tmp_path / "home.json")
    assert {track.room for track in again.things()} == {"cooking"}
