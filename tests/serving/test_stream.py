"""A stream's scene and answers, without a connection: the answers of requests with that scene."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.serving import questions
from app.serving.answers import written
from app.serving.errors import DeadlinePassedError, RequestError, UnknownModelError
from app.serving.metrics import Metrics
from app.serving.request import Request
from app.serving.runtime import Runtime
from app.serving.stream import Streams, StreamScene, TokenBucket
from app.settings import Settings
from scene_client.schemas import MissingRequest, OutliersRequest, RelationsRequest
from scene_client.stream_messages import Open, Update, Whole
from tests.http.stores import make_store

ASK = {"missing": {"top_k": 4}, "outliers": {}, "relations": {"top_k": 6}}
IDS = [f"thing_{k}" for k in range(5)]
LABELS = ["bed", "lamp", "chair", "desk", "toilet", "floor"]


class Service:
    """A runtime, and a loop to ask it on."""

    def __init__(self, store: Path, **settings: Any) -> None:
        self.runner = asyncio.Runner()
        self.runtime = Runtime(Settings(store=store, store_poll=0, **settings))
        self.runner.run(self.runtime.start())

    def view(self) -> Request:
        return self.runtime.request(monotonic() + 60, "request")

    def answer(self, scene: StreamScene) -> dict[str, Any]:
        message, errors = self.runner.run(scene.answer(self.view()))
        assert not errors
        found: dict[str, Any] = json.loads(written(message))
        return found

    def take(self, scene: StreamScene, **message: Any) -> None:
        forms = {"open": Open, "update": Update, "scene": Whole}
        form = forms[message["type"]].model_validate(message)
        scene.take(form, self.view())

    def asked(self, objects: list[Any], **fields: Any) -> dict[str, Any]:
        """The answers to one request of each kind, by question."""
        found: dict[str, Any] = {}
        for kind, question in (
            (MissingRequest, questions.missing),
            (OutliersRequest, questions.outliers),
            (RelationsRequest, questions.relations),
        ):
            name = question.__name__
            request = kind.model_validate({"objects": objects, **fields, **ASK[name]})
            answer = self.runner.run(question(self.view(), request))  # type: ignore[operator]
            found[name] = json.loads(written(answer))
        return found


def answers(message: dict[str, Any]) -> dict[str, Any]:
    return {name: message[name] for name in ("missing", "outliers", "relations") if name in message}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    found = Service(make_store(tmp_path_factory.mktemp("store")))
    yield found
    found.runtime.stop()
    found.runner.close()


METRES = st.integers(-20, 20).map(lambda n: n / 10)
POSITIONS = st.fixed_dictionaries({"x": METRES, "y": METRES, "z": METRES})
THINGS = st.fixed_dictionaries(
    {"id": st.sampled_from(IDS), "label": st.sampled_from(LABELS)},
    optional={"position": POSITIONS, "confidence": st.sampled_from([0.25, 0.5, 1.0])},
)
STEPS = st.lists(
    st.one_of(
        st.tuples(
            st.just("set"), st.lists(THINGS, min_size=1, max_size=3, unique_by=lambda t: t["id"])
        ),
        st.tuples(st.just("remove"), st.lists(st.sampled_from(IDS), min_size=1, unique=True)),
        st.tuples(st.just("room"), st.sampled_from([None, "bedroom", "office"])),
        st.tuples(st.just("whole"), st.lists(THINGS, max_size=4, unique_by=lambda t: t["id"])),
        st.tuples(st.just("answer"), st.none()),
    ),
    max_size=12,
)


@settings(max_examples=60)
@given(steps=STEPS)
def test_any_messages_come_to_the_answers_of_requests_with_the_final_scene(
    service: Service, steps: list[tuple[str, Any]]
) -> None:
    stream = StreamScene()
    service.take(stream, type="open", ask=ASK)
    scene: dict[str, Any] = {}
    room: dict[str, Any] = {}
    for step, value in steps:
        seq = stream.seq + 1
        match step:
            case "set":
                service.take(stream, type="update", seq=seq, objects=value)
                scene |= {thing["id"]: thing for thing in value}
            case "remove":
                there = [name for name in value if name in scene]
                service.take(stream, type="update", seq=seq, remove=there)
                for name in there:
                    del scene[name]
            case "room":
                service.take(stream, type="update", seq=seq, room_type=value)
                room = {"room_type": value}
            case "whole":
                service.take(stream, type="scene", seq=seq, objects=value)
                scene, room = {thing["id"]: thing for thing in value}, {}
            case "answer":
                service.answer(stream)
    message = service.answer(stream)
    assert message["seq"] == stream.seq
    assert stream.pending == 0
    if scene:
        assert answers(message) == service.asked(list(scene.values()), **room)
    else:
        lists = {"missing", "outliers", "misplaced", "relations", "disagreements"}
        found = {
            name: own[name] for own in answers(message).values() for name in lists & own.keys()
        }
        assert found == {name: [] for name in lists}


def test_a_message_that_makes_no_sense_changes_nothing(service: Service) -> None:
    stream = StreamScene()
    service.take(stream, type="open")
    service.take(stream, type="update", seq=1, objects=["bed", {"id": "a", "label": "lamp"}])
    before = service.answer(stream)
    for message, places in (
        ({"objects": ["bad"]}, [("objects", 0)]),
        ({"objects": [{"id": "a", "label": "bad"}]}, [("objects", 0, "label")]),
        ({"objects": ["bed", "bed"]}, [("objects", 1, "id")]),
        ({"remove": ["bed", "nobody"]}, [("remove", 1)]),
        ({"room_type": "cellar"}, [("room_type",)]),
        (
            {"relations": [{"subject": "a", "relation": "left", "object": "sofa"}]},
            [("relations", 0, "object")],
        ),
        (
            {
                "relations": [
                    {"subject": "a", "relation": name, "object": "bed"}
                    for name in ("left", "right")
                ]
            },
            [("relations", 1)],
        ),
        ({"seq": 1}, [("seq",)]),
    ):
        with pytest.raises(RequestError) as refused:
            service.take(stream, **{"type": "update", "seq": 2, **message})
        assert [fault.location for fault in refused.value.faults] == places
        assert (stream.seq, stream.pending) == (1, 0)
    with pytest.raises(UnknownModelError):
        service.take(stream, type="update", seq=2, model="nowhere")
    assert service.answer(stream) == before


def test_a_fault_of_the_kept_scene_is_located_there(service: Service) -> None:
    stream = StreamScene()
    service.take(stream, type="open", unknown_labels="ignore")
    service.take(stream, type="update", seq=1, objects=[{"id": "a", "label": "gizmo"}, "bed"])
    with pytest.raises(RequestError) as refused:
        service.take(stream, type="update", seq=2, unknown_labels="error")
    (fault,) = refused.value.faults
    assert fault.location == ("scene", "objects", "a", "label")
    assert service.answer(stream)["missing"]["ignored"] == ["a"]


def test_relations_go_with_their_objects(service: Service) -> None:
    stream = StreamScene()
    things = [{"id": "a", "label": "lamp"}, {"id": "b", "label": "desk"}, "bed"]
    stated = [
        {"subject": "a", "relation": "on-top", "object": "b"},
        {"subject": "bed", "relation": "left", "object": "b"},
    ]
    service.take(stream, type="open", ask=ASK)
    service.take(stream, type="update", seq=1, objects=things, relations=stated)
    assert answers(service.answer(stream)) == service.asked(things, relations=stated)
    service.take(stream, type="update", seq=2, remove=["a"])
    expected = service.asked(things[1:], relations=stated[1:])
    assert answers(service.answer(stream)) == expected


def test_relations_are_derived_again_after_each_move(service: Service) -> None:
    def lamp(height: float) -> dict[str, Any]:
        return {"id": "lamp", "label": "lamp", "position": {"x": 2.0, "y": 0.0, "z": height}}

    desk = {"id": "desk", "label": "desk", "position": {"x": 2.0, "y": 0.0, "z": 0.4}}
    stream = StreamScene()
    service.take(stream, type="open", ask=ASK)
    service.take(stream, type="update", seq=1, objects=[desk, lamp(1.0)])
    observed = service.answer(stream)["missing"]["observed_relations"]
    assert {"subject": "lamp", "relation": "on-top", "object": "desk"} in observed
    service.take(stream, type="update", seq=2, objects=[lamp(1.8)])
    found = answers(service.answer(stream))
    assert found == service.asked([desk, lamp(1.8)])
    relations = [entry["relation"] for entry in found["missing"]["observed_relations"]]
    assert "above" in relations
    assert "on-top" not in relations


def test_what_is_asked_holds_until_something_else_is(service: Service) -> None:
    stream = StreamScene()
    service.take(stream, type="open", objects=["bed"])
    assert answers(service.answer(stream)).keys() == {"missing", "outliers"}
    service.take(stream, type="update", seq=1, ask={"relations": {}})
    service.take(stream, type="scene", seq=2, objects=["lamp"])
    assert answers(service.answer(stream)).keys() == {"relations"}
    service.take(stream, type="update", seq=3, ask=None)
    assert answers(service.answer(stream)).keys() == {"missing", "outliers"}


def test_a_late_answer_covers_its_messages(service: Service) -> None:
    stream = StreamScene()
    service.take(stream, type="open", objects=["bed"])
    service.take(stream, type="update", seq=1, objects=["lamp"])
    late = service.runtime.request(monotonic() - 1, "request")
    message, errors = service.runner.run(stream.answer(late))
    assert message == {"type": "answer", "seq": 1, "superseded": 0}
    assert {name: type(error) for name, error in errors.items()} == {
        "missing": DeadlinePassedError,
        "outliers": DeadlinePassedError,
    }
    assert stream.pending == 0


def test_a_label_that_another_model_lacks_is_a_problem_of_each_question(service: Service) -> None:
    stream = StreamScene()
    service.take(stream, type="open", objects=[{"id": "a", "label": "lamp"}])
    scene = stream._scene
    stream._scene = scene.after(Update(type="update", seq=1, objects=["no such class"]))
    message, errors = service.runner.run(stream.answer(service.view()))
    assert answers(message) == {}
    assert errors.keys() == {"missing", "outliers"}
    for error in errors.values():
        assert isinstance(error, RequestError)
        assert error.faults[0].location == ("scene", "objects", "no such class")


def test_another_model_answers_from_the_next_message_on(service: Service) -> None:
    stream = StreamScene()
    service.take(stream, type="open", objects=["bed", "lamp"])
    assert service.answer(stream)["missing"]["model"]["version"] == "1.0.0"
    service.take(stream, type="update", seq=2, model="candidate")
    assert service.answer(stream)["missing"]["model"]["version"] == "1.1.0"


def test_no_scene_is_larger_than_the_service_allows(tmp_path: Path) -> None:
    small = Service(make_store(tmp_path / "store"), max_objects=3, max_relations=1)
    try:
        stream = StreamScene()
        small.take(stream, type="open", objects=["bed", "lamp"])
        with pytest.raises(RequestError) as refused:
            small.take(stream, type="update", seq=1, objects=["desk", "chair"])
        assert refused.value.faults[0].location == ("objects",)
        small.take(stream, type="update", seq=1, objects=["desk", "chair"], remove=["bed"])
        outliers = small.answer(stream)["outliers"]["outliers"]
        assert {entry["object"] for entry in outliers} == {"lamp", "desk", "chair"}
    finally:
        small.runtime.stop()
        small.runner.close()


def test_a_rate_limit_lets_bursts_pass_and_slows_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr("app.serving.stream.monotonic", lambda: now)
    bucket = TokenBucket(rate=10, burst=3)
    assert [bucket.take(1) for _ in range(5)] == pytest.approx([0, 0, 0, 0.1, 0.2])
    now += 0.25
    assert bucket.take(0.5) == pytest.approx(0)
    assert bucket.take(0.5) == pytest.approx(0.05)
    now += 60
    assert [bucket.take(1) for _ in range(4)] == pytest.approx([0, 0, 0, 0.1])


def test_places_are_counted_and_drained_once() -> None:
    streams = Streams(2, Metrics())
    ended: list[str] = []
    with streams.place(lambda: ended.append("first")):
        assert not streams.is_full
        with streams.place(lambda: ended.append("second")):
            assert streams.is_full
            streams.drain()
            streams.drain()
    assert sorted(ended) == ["first", "second"]
    assert not streams.is_full
