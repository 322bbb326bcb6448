"""What a session keeps and answers, without a connection: what requests would say of its scene."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Iterator
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.changes import applied
from app.messages import Ask, Open, Update, Whole
from app.schemas import (
    Answer,
    Detection,
    MissingRequest,
    OutliersRequest,
    RelationsRequest,
)
from app.serving import questions
from app.serving.answers import written
from app.serving.errors import RequestError, UnknownModelError
from app.serving.metrics import Unmeasured
from app.serving.queue import Ticket
from app.serving.reading import Limits
from app.serving.runtime import Runtime
from app.serving.session import Session
from app.serving.stream import PARKED_BYTES, Ending, SceneState, Streams, StreamSession
from tests.http.stores import make_store

ASK = {"missing": {"top_k": 4}, "outliers": {}, "relations": {"top_k": 6}}
IDS = [f"thing_{k}" for k in range(5)]
LABELS = ["bed", "lamp", "chair", "desk", "toilet", "floor"]


class Service:
    """A runtime, and a loop to ask it on."""

    def __init__(self, store: Path, limits: Limits | None = None) -> None:
        self.runner = asyncio.Runner()
        self.runtime = Runtime(store, limits or Limits(), 256, Unmeasured(), poll=0)
        self.runner.run(self.runtime.start())

    def view(self) -> Session:
        return self.runtime.session("request", Ticket(monotonic() + 60))

    def answer(self, session: StreamSession) -> Any:
        message, failures = self.runner.run(session.answer(self.view()))
        assert not failures
        return message

    def take(self, session: StreamSession, **message: Any) -> None:
        forms = {"open": Open, "update": Update, "scene": Whole}
        form = forms[message["type"]].model_validate(message)
        session.take(form, self.view())

    def asked(self, objects: list[Any], **fields: Any) -> dict[str, Any]:
        """The lists that one request of each kind answers with."""
        lists: dict[str, Any] = {}
        if not objects:
            names = ("missing", "outliers", "misplaced", "relations", "disagreements")
            return {name: [] for name in names}
        for kind, question, own in (
            (MissingRequest, questions.missing, ASK["missing"]),
            (OutliersRequest, questions.outliers, ASK["outliers"]),
            (RelationsRequest, questions.relations, ASK["relations"]),
        ):
            request = kind.model_validate({"objects": objects, **fields, **own})
            answer = self.runner.run(question(self.view(), request))  # type: ignore[operator]
            lists |= json.loads(written(answer))
        envelope = set(Answer.model_fields) - {"observed_relations"} | {"coverage", "threshold"}
        return {name: entries for name, entries in lists.items() if name not in envelope}


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
def test_any_messages_come_to_what_one_request_with_the_final_scene_says(
    service: Service, steps: list[tuple[str, Any]]
) -> None:
    session = StreamSession()
    service.take(session, type="open", ask=ASK)
    scene: dict[str, Any] = {}
    room: dict[str, Any] = {}
    known: dict[str, Any] = {}
    for step, value in [*steps, ("answer", None)]:
        seq = session.seq + 1
        match step:
            case "set":
                service.take(session, type="update", seq=seq, objects=value)
                scene |= {thing["id"]: thing for thing in value}
            case "remove":
                there = [name for name in value if name in scene]
                service.take(session, type="update", seq=seq, remove=there)
                for name in there:
                    del scene[name]
            case "room":
                service.take(session, type="update", seq=seq, room_type=value)
                room = {"room_type": value}
            case "whole":
                service.take(session, type="scene", seq=seq, objects=value)
                scene, room = {thing["id"]: thing for thing in value}, {}
            case "answer":
                message = service.answer(session)
                known = applied({} if message.full else known, message.changes, message.dropped)
                assert message.seq == session.seq
    assert known == service.asked(list(scene.values()), **room)


def test_a_message_that_makes_no_sense_changes_nothing(service: Service) -> None:
    session = StreamSession()
    service.take(session, type="open")
    service.take(session, type="update", seq=1, objects=["bed", {"id": "a", "label": "lamp"}])
    state = session.state
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
            service.take(session, **{"type": "update", "seq": 2, **message})
        assert [fault.location for fault in refused.value.faults] == places
        assert (session.state, session.seq, session.pending) == (state, 1, 1)
    with pytest.raises(UnknownModelError):
        service.take(session, type="update", seq=2, model="nowhere")
    assert session.state is state


def test_what_only_the_scene_holds_is_pointed_at_there(service: Service) -> None:
    session = StreamSession()
    service.take(session, type="open", unknown_labels="ignore")
    service.take(session, type="update", seq=1, objects=[{"id": "a", "label": "gizmo"}, "bed"])
    with pytest.raises(RequestError) as refused:
        service.take(session, type="update", seq=2, unknown_labels="error")
    (fault,) = refused.value.faults
    assert fault.location == ("session", "objects", "a", "label")
    message = service.answer(session)
    assert message.ignored == ["a"]


def test_relations_are_kept_by_ids_and_go_with_their_objects(service: Service) -> None:
    session = StreamSession()
    things = [{"id": "a", "label": "lamp"}, {"id": "b", "label": "desk"}, "bed"]
    stated = [
        {"subject": "lamp", "relation": "on-top", "object": "b"},
        {"subject": "bed", "relation": "left", "object": "b"},
    ]
    service.take(session, type="open", ask=ASK)
    service.take(session, type="update", seq=1, objects=things, relations=stated)
    # A second lamp: the first is meant all the same.
    service.take(session, type="update", seq=2, objects=[{"id": "c", "label": "lamp"}])
    message = service.answer(session)
    by_id = [{**stated[0], "subject": "a"}, stated[1]]
    expected = service.asked([*things, {"id": "c", "label": "lamp"}], relations=by_id)
    assert applied({}, message.changes, message.dropped) == expected
    service.take(session, type="update", seq=3, remove=["a"])
    message = service.answer(session)
    expected = service.asked([things[1], "bed", {"id": "c", "label": "lamp"}], relations=by_id[1:])
    session.start_over()
    assert applied({}, service.answer(session).changes, ()) == expected


def test_poses_are_read_again_whenever_something_moves(service: Service) -> None:
    def lamp(height: float) -> dict[str, Any]:
        return {"id": "lamp", "label": "lamp", "position": {"x": 2.0, "y": 0.0, "z": height}}

    desk = {"id": "desk", "label": "desk", "position": {"x": 2.0, "y": 0.0, "z": 0.4}}
    session = StreamSession()
    service.take(session, type="open", ask=ASK)
    service.take(session, type="update", seq=1, objects=[desk, lamp(1.0)])
    lists = applied({}, service.answer(session).changes, ())
    assert {"subject": "lamp", "relation": "on-top", "object": "desk"} in lists[
        "observed_relations"
    ]
    service.take(session, type="update", seq=2, objects=[lamp(1.8)])
    lists = applied(lists, service.answer(session).changes, ())
    assert lists == service.asked([desk, lamp(1.8)])
    relations = [entry["relation"] for entry in lists["observed_relations"]]
    assert "above" in relations
    assert "on-top" not in relations


def test_one_answer_covers_all_that_came_before_it(service: Service) -> None:
    session = StreamSession()
    service.take(session, type="open")
    for seq in (3, 4, 9):
        service.take(session, type="update", seq=seq, objects=["bed"])
    message = service.answer(session)
    assert (message.seq, message.superseded, message.revision, message.full) == (9, 2, 1, True)
    message = service.answer(session)
    assert (message.seq, message.superseded, message.revision, message.full) == (9, 0, 2, False)
    assert message.changes == {}


def test_alarms_tell_who_became_an_outlier_and_who_no_longer_is_one(service: Service) -> None:
    session = StreamSession()
    service.take(session, type="open", ask={"outliers": {"threshold": 0.0}})
    service.take(session, type="update", seq=1, objects=["bed", "lamp"])
    assert sorted(service.answer(session).alarms.raised) == ["bed", "lamp"]
    service.take(session, type="update", seq=2, objects=["desk"], remove=["bed"])
    alarms = service.answer(session).alarms
    assert (alarms.raised, alarms.cleared) == (["desk"], ["bed"])
    service.take(session, type="update", seq=3, ask={"outliers": {"threshold": 1.0}})
    alarms = service.answer(session).alarms
    assert (alarms.raised, sorted(alarms.cleared)) == ([], ["desk", "lamp"])


def test_a_question_that_fails_leaves_the_others_their_answers(service: Service) -> None:
    session = StreamSession()
    ask = {"missing": {"at": {"relation": "on-top", "object": "desk"}}, "outliers": {}}
    service.take(session, type="open", ask=ask)
    service.take(session, type="update", seq=1, objects=["desk", "bed"])
    lists = applied({}, service.answer(session).changes, ())
    assert set(lists) == {"missing", "outliers", "misplaced"}
    service.take(session, type="update", seq=2, remove=["desk"])
    message, failures = service.runner.run(session.answer(service.view()))
    (fault,) = failures["missing"].faults
    assert fault.location == ("ask", "missing", "at", "object")
    assert message.dropped == ["missing"]
    lists = applied(lists, message.changes, message.dropped)
    assert [entry["object"] for entry in lists["outliers"]] == ["bed"]


def test_no_number_that_is_not_finite_is_told(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = questions.reasoning.outliers

    def broken(artifact: Any, scene: Any, **parameters: Any) -> Any:
        found = real(artifact, scene, **parameters)
        first, *others = found.outliers
        return found._replace(outliers=(first._replace(probability=math.nan), *others))

    session = StreamSession()
    service.take(session, type="open", ask=ASK)
    service.take(session, type="update", seq=1, objects=["desk", "bed"])
    with monkeypatch.context() as patch:
        patch.setattr(questions.reasoning, "outliers", broken)
        with pytest.raises(ValueError, match="not finite"):
            service.answer(session)
    # In the order of the schemas, whatever the hashes of their names are.
    lists = applied({}, service.answer(session).changes, ())
    assert list(lists) == ["missing", "outliers", "misplaced", "relations", "disagreements"]


def test_another_model_starts_from_nothing(service: Service) -> None:
    session = StreamSession()
    service.take(session, type="open")
    service.take(session, type="update", seq=1, objects=["bed", "lamp"])
    service.answer(session)
    service.take(session, type="update", seq=2, model="candidate")
    message = service.answer(session)
    assert message.full
    assert message.model.version == "1.1.0"


def test_no_scene_is_larger_than_the_service_allows(tmp_path: Path) -> None:
    small = Service(make_store(tmp_path / "store"), Limits(objects=3, relations=1))
    try:
        session = StreamSession()
        small.take(session, type="open", objects=["bed", "lamp"])
        with pytest.raises(RequestError) as refused:
            small.take(session, type="update", seq=1, objects=["desk", "chair"])
        assert refused.value.faults[0].location == ("objects",)
        small.take(session, type="update", seq=1, objects=["desk", "chair"], remove=["bed"])
        assert list(session.state.objects) == ["lamp", "desk", "chair"]
    finally:
        small.runtime.stop()
        small.runner.close()


def test_a_scene_that_is_put_away_comes_back_the_same(service: Service) -> None:
    session = StreamSession()
    service.take(
        session,
        type="open",
        ask={"missing": {"top_k": 3}, "relations": {}},
        timeout_ms=500,
        room_type="bedroom",
        objects=["bed", {"label": "lamp", "position": {"x": 0.1, "y": 0.2, "z": 0.3}}],
        relations=[{"subject": "lamp", "relation": "left", "object": "bed"}],
    )
    found = SceneState.load(session.state.dump())
    assert found == session.state
    assert found.ask.missing is not None
    assert found.ask.missing.model_fields_set == {"top_k"}
    assert isinstance(found.ask, Ask)


def ends() -> tuple[list[Ending], Any]:
    said: list[Ending] = []
    return said, said.append


def test_sessions_are_kept_for_a_while_and_only_so_many(service: Service) -> None:
    async def run() -> None:
        streams = Streams(2, 0.2, Unmeasured())
        sessions = [StreamSession() for _ in range(3)]
        for session in sessions:
            _, end = ends()
            streams.bind(session, end)
            streams.part(session, end, keep=True)
        # The oldest made room.
        assert list(streams.parked) == [session.id for session in sessions[1:]]
        assert streams.find(sessions[0].id) is None
        found = streams.find(sessions[2].id)
        assert found is not None
        streams.bind(found, ends()[1])
        assert list(streams.parked) == [sessions[1].id]
        await asyncio.sleep(0.4)
        assert streams.parked == {}
        assert streams.find(sessions[1].id) is None

    service.runner.run(run())


def test_sessions_that_are_kept_take_only_so_much_memory(service: Service) -> None:
    async def run() -> None:
        streams = Streams(1000, 60, Unmeasured())
        # Of the largest scenes there are: some hundred kilobytes each.
        text = "x" * 100
        relation = [
            {"subject": f"{k}{text}"[:100], "relation": "left", "object": f"{k + 1}{text}"[:100]}
            for k in range(250)
        ]
        message = Whole.model_validate({"type": "scene", "seq": 1, "relations": relation * 10})
        things = {
            f"{k}{text}"[:100]: Detection(id=f"{k}{text}"[:100], label="bed") for k in range(256)
        }
        for _ in range(100):
            session = StreamSession()
            session.state = SceneState(things, {"relations": message.relations})
            streams.bind(session, print)
            streams.part(session, print, keep=True)
            assert sum(streams.parked.values()) <= PARKED_BYTES
        assert 2 < len(streams.parked) < 100

    service.runner.run(run())


def test_a_session_has_one_stream(service: Service) -> None:
    async def run() -> None:
        streams = Streams(2, 60, Unmeasured())
        session = StreamSession()
        (said, end), (_, other) = ends(), ends()
        streams.bind(session, end)
        assert streams.find(session.id) is session
        streams.bind(session, other)
        assert said == [Ending.REPLACED]
        streams.part(session, end, keep=False)
        assert streams.find(session.id) is session
        streams.part(session, other, keep=False)
        assert streams.find(session.id) is None

    service.runner.run(run())
