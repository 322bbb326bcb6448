"""Streams over real sockets: their answers are those of requests with the same scene."""

from __future__ import annotations

import asyncio
import json
import random
import re
import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.api.catalogue import PROBLEM_TYPES
from scene_client import (
    InvalidRequestError,
    StreamClient,
    StreamClosedError,
    StreamProblemError,
    UnreachableError,
)
from tests.conftest import REPOSITORY
from tests.http.stores import make_store, publish
from tests.http.streams import (
    ASK,
    answered,
    hear,
    is_document,
    is_problem,
    opened,
    posted,
    say,
    talk,
    updates,
)
from tests.services import ADMIN_KEY, LiveService, launch

pytestmark = pytest.mark.system

DOCUMENT = (REPOSITORY / "docs" / "stream.md").read_text("utf-8")


# --------------------------------------------------------------------------- the same answers


@pytest.mark.anyio
async def test_many_updates_come_to_the_answers_of_requests(live: LiveService) -> None:
    """Sometimes one at a time, sometimes many."""
    url = f"http://127.0.0.1:{live.port}"
    scene: dict[str, Any] = {}
    pauses = {0, 1, 2, 3, 399, *random.Random(1).sample(range(400), 40)}
    covered = 0
    async with StreamClient(url, ask=ASK) as stream:
        for number, (update, scene) in enumerate(updates(400, 7)):  # noqa: B007
            sent = await stream.update(**update)
            while number in pauses:
                answer = await anext(stream)
                covered += 1 + answer.superseded
                if answer.seq == sent:
                    break
        assert covered == 400
        assert stream.answer is answer
        expected = posted(live.client, scene, ASK)
        for question, own in expected.items():
            found = getattr(answer, question)
            form = type(found)
            assert found.model_copy(update={"request_id": ""}) == form.model_validate(own)
        assert expected["missing"]["observed_relations"]


IDS = [f"thing_{k}" for k in range(5)]
METRES = st.integers(-20, 20).map(lambda n: n / 10)
THINGS = st.lists(
    st.fixed_dictionaries(
        {"id": st.sampled_from(IDS), "label": st.sampled_from(["bed", "lamp", "desk", "floor"])},
        optional={
            "position": st.fixed_dictionaries(dict.fromkeys("xyz", METRES)),
            "confidence": st.sampled_from([0.25, 0.5, 1.0]),
        },
    ),
    max_size=4,
    unique_by=lambda thing: thing["id"],
)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("set"), THINGS.filter(len)),
        st.tuples(st.just("remove"), st.lists(st.sampled_from(IDS), min_size=1, unique=True)),
        st.tuples(st.just("room"), st.sampled_from([None, "bedroom", "office"])),
        st.tuples(st.just("whole"), THINGS),
        st.tuples(st.just("answer"), st.none()),
    ),
    max_size=12,
)


def newest(stream: Any, seq: int) -> dict[str, Any]:
    """The answer that covers a message."""
    while (answer := hear(stream)).get("seq") != seq:
        assert answer["type"] == "answer"
    return answer


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=STEPS)
def test_any_messages_come_to_the_answers_of_requests_with_the_final_scene(
    live: LiveService, steps: list[tuple[str, Any]]
) -> None:
    scene: dict[str, Any] = {}
    room: dict[str, Any] = {}
    seq = 1
    with opened(live) as stream:
        talk(stream, "open", ask=ASK)
        say(stream, "scene", seq=1, objects=[])
        for step, value in steps:
            seq += step != "answer"
            match step:
                case "set":
                    say(stream, "update", seq=seq, objects=value)
                    scene |= {thing["id"]: thing for thing in value}
                case "remove":
                    there = [name for name in value if scene.pop(name, None)]
                    say(stream, "update", seq=seq, remove=there)
                case "room":
                    say(stream, "update", seq=seq, room_type=value)
                    room = {"room_type": value}
                case "whole":
                    say(stream, "scene", seq=seq, objects=value)
                    scene, room = {thing["id"]: thing for thing in value}, {}
                case "answer":
                    say(stream, "ping")
                    while hear(stream)["type"] != "pong":
                        pass
        say(stream, "update", seq=seq + 1, **room)
        answer = newest(stream, seq + 1)
    if scene:
        expected = {"objects": list(scene.values()), **room}
        assert answered(answer) == posted(live.client, expected, ASK)
    else:
        lists = {"missing", "outliers", "misplaced", "relations", "disagreements"}
        found = [own[name] for own in answered(answer).values() for name in lists & own.keys()]
        assert found == [[]] * len(lists)


def test_relations_go_with_their_objects(live: LiveService) -> None:
    things = [{"id": "a", "label": "lamp"}, {"id": "b", "label": "desk"}, "bed"]
    stated = [
        {"subject": "a", "relation": "on-top", "object": "b"},
        {"subject": "bed", "relation": "left", "object": "b"},
    ]
    with opened(live) as stream:
        talk(stream, "open", ask=ASK)
        scene = {"objects": things, "relations": stated}
        answer = talk(stream, "update", seq=1, **scene)
        assert answered(answer) == posted(live.client, scene, ASK)
        scene = {"objects": things[1:], "relations": stated[1:]}
        answer = talk(stream, "update", seq=2, remove=["a"])
        assert answered(answer) == posted(live.client, scene, ASK)


def test_what_is_asked_holds_until_something_else_is(live: LiveService) -> None:
    """And so does the model."""
    with opened(live) as stream:
        talk(stream, "open")
        answer = talk(stream, "update", seq=1, objects=["bed"])
        assert answered(answer).keys() == {"missing", "outliers"}
        talk(stream, "update", seq=2, ask={"relations": {}}, model="candidate")
        answer = talk(stream, "scene", seq=3, objects=["lamp"])
        assert answered(answer).keys() == {"relations"}
        assert answer["relations"]["model"]["version"] == "1.1.0"
        answer = talk(stream, "update", seq=4, ask=None)
        assert answered(answer).keys() == {"missing", "outliers"}


def test_a_late_answer_covers_its_messages(live: LiveService) -> None:
    objects = [{"id": str(k), "label": "bed"} for k in range(250)]
    with opened(live) as stream:
        talk(stream, "open", timeout_ms=1, ask={"relations": {"top_k": 4096}})
        # On a busy machine, an answer can be complete before its deadline is checked.
        for seq in range(1, 100):
            answer = talk(stream, "scene", seq=seq, objects=objects)
            assert (answer["seq"], answer["superseded"]) == (seq, 0)
            if "problems" in answer:
                break
        is_document(answer["problems"]["relations"], 504, "deadline-passed")
        # It has counted: the next one is about the next message alone.
        answer = talk(stream, "scene", seq=100, objects=["bed"])
        assert (answer["seq"], answer["superseded"]) == (100, 0)


def test_no_scene_is_larger_than_a_request_may_have(live: LiveService) -> None:
    def things(first: int, last: int) -> list[dict[str, str]]:
        return [{"id": str(k), "label": "bed"} for k in range(first, last)]

    with opened(live) as stream:
        talk(stream, "open", ask={"outliers": {}})
        talk(stream, "update", seq=1, objects=things(0, 200))
        refused = talk(stream, "update", seq=2, objects=things(200, 257))
        is_problem(refused, 422, "invalid-request", 2)
        assert refused["problem"]["errors"][0]["pointer"] == "#/objects"
        answer = talk(stream, "update", seq=3, objects=things(200, 257), remove=["0"])
        assert len(answer["outliers"]["outliers"]) == 256


def test_a_flood_is_answered_about_its_newest_state_only(live: LiveService) -> None:
    """Many updates come while the client reads nothing: they are merged, none is kept."""
    scene: dict[str, Any] = {}
    with opened(live) as stream:
        talk(stream, "open", ask=ASK)
        before = live.memory
        count = 0
        for turn in range(3):
            for update, scene in updates(500, turn):  # noqa: B007 - the last is used
                count += 1
                say(stream, "update" if count % 500 != 1 else "scene", seq=count, **update)
        grown = live.memory - before
        answers = covered = 0
        while True:
            answer = hear(stream)
            answers += 1
            covered += 1 + answer["superseded"]
            if answer["seq"] == count:
                break
        assert covered == count
        assert answers < count / 2
        assert answered(answer) == posted(live.client, scene, ASK)
        assert grown < 16 * 2**20
        # Nothing is left over: the next message is the answer to a ping.
        assert talk(stream, "ping") == {"type": "pong"}


def test_a_fast_stream_is_slowed_down_and_others_are_not(live: LiveService) -> None:
    """By the numbers of the documentation: so many messages a second after a burst."""
    (pace,) = re.findall(r"(\d+) small messages a second", DOCUMENT)
    ((share, burst),) = re.findall(r"(\d+) % of a core, with a burst of (\d+) s", DOCUMENT)
    later = int(pace) // 2
    count = round(int(pace) * 100 / int(share) * int(burst)) + later
    with opened(live) as fast, opened(live) as other:
        talk(fast, "open")
        talk(other, "open")
        hearing = threading.Thread(target=lambda: [hear(fast) for _ in range(count)])
        hearing.start()
        began = time.monotonic()
        for _ in range(count):
            say(fast, "ping")
        waits = []
        while hearing.is_alive():
            asked = time.monotonic()
            assert talk(other, "ping") == {"type": "pong"}
            waits.append(time.monotonic() - asked)
            time.sleep(0.01)
        assert time.monotonic() - began > later / int(pace)
        assert sorted(waits)[len(waits) // 2] < 0.05


def test_the_server_limits_the_deadlines_of_streams(live: LiveService) -> None:
    with opened(live) as stream:
        refused = talk(stream, "open", timeout_ms=60_001)
        is_problem(refused, 422, "invalid-request")
        assert refused["problem"]["errors"][0]["pointer"] == "#/timeout_ms"
        assert talk(stream, "open", timeout_ms=60_000)["type"] == "opened"


def test_a_question_that_fails_alone_carries_its_problem(live: LiveService) -> None:
    with opened(live) as stream:
        ask = {"missing": {"at": {"relation": "on-top", "object": "desk"}}, "outliers": {}}
        talk(stream, "open", ask=ask)
        answer = talk(stream, "update", seq=1, objects=["bed"])
        assert "missing" not in answer
        assert [entry["object"] for entry in answer["outliers"]["outliers"]] == ["bed"]
        is_document(answer["problems"]["missing"], 422, "invalid-request")
        (error,) = answer["problems"]["missing"]["errors"]
        assert error["pointer"] == "#/ask/missing/at/object"


# -------------------------------------------------------------------------------- bad messages


@pytest.mark.parametrize(
    ("text", "slug", "seq"),
    [
        ("{", "not-json", None),
        ('{"type": "update", "seq": 2, "objects": [NaN]}', "not-json", None),
        ('{"type": "update", "seq": 2, "seq": 3}', "not-json", None),
        ('{"type": "update", "seq": 2, "objects": ["\\ud800"]}', "not-json", None),
        ("[" * 10_000, "not-json", None),
        (b'{"type": "ping"}', "unsupported-media-type", None),
        ("[]", "invalid-request", None),
        ('{"type": "upd\\u0000ate", "seq": 2}', "invalid-request", 2),
        ('{"type": ["update"], "seq": 2}', "invalid-request", 2),
        ('{"type": "update", "objects": ["bed"]}', "invalid-request", None),
        ('{"type": "update", "seq": "2"}', "invalid-request", None),
        ('{"type": "update", "seq": 2, "set": ["bed"]}', "invalid-request", 2),
        ('{"type": "update", "seq": 2, "objects": [{"label": 1}]}', "invalid-request", 2),
        ('{"type": "update", "seq": 2, "ask": {}}', "invalid-request", 2),
        ('{"type": "scene", "seq": 2, "objects": ["gizmo"]}', "unknown-labels", 2),
        ('{"type": "update", "seq": 2, "model": "nowhere"}', "model-not-found", 2),
        ('{"type": "open"}', "invalid-request", None),
        ('{"type": "get"}', "invalid-request", None),
        ('{"type": "open", "session": "a"}', "invalid-request", None),
        ('{"type": "ping", "seq": 1, "extra": 0}', "invalid-request", 1),
    ],
)
def test_a_bad_message_is_named_and_changes_nothing(
    live: LiveService, text: str | bytes, slug: str, seq: int | None
) -> None:
    with opened(live) as stream:
        talk(stream, "open", ask=ASK)
        talk(stream, "update", seq=1, objects=["bed", "lamp"])
        stream.send(text)
        is_problem(hear(stream), PROBLEM_TYPES[slug].status, slug, seq)
        # Whatever the scene is, it has still these two objects.
        answer = talk(stream, "update", seq=3, room_type=None)
        assert answered(answer) == posted(live.client, {"objects": ["bed", "lamp"]}, ASK)


def test_a_fault_is_pointed_at_in_the_message_or_the_kept_scene(live: LiveService) -> None:
    pair = {"subject": "a", "object": "bed"}
    both = [pair | {"relation": name} for name in ("left", "right")]
    cases: list[tuple[dict[str, Any], str]] = [
        ({"objects": ["bad"]}, "#/objects/0"),
        ({"objects": [{"id": "a", "label": "bad"}]}, "#/objects/0/label"),
        ({"objects": ["bed", "bed"]}, "#/objects/1"),
        ({"remove": ["bed", "nobody"]}, "#/remove/1"),
        ({"room_type": "cellar"}, "#/room_type"),
        ({"relations": [pair | {"relation": "left", "object": "sofa"}]}, "#/relations/0/object"),
        ({"relations": both}, "#/relations/1"),
        ({"seq": 1}, "#/seq"),
    ]
    with opened(live) as stream:
        talk(stream, "open")
        objects = ["bed", {"id": "a", "label": "lamp"}]
        before = answered(talk(stream, "update", seq=1, objects=objects))
        for changed, pointer in cases:
            refused = talk(stream, "update", **{"seq": 2, **changed})
            assert refused["type"] == "problem"
            assert [error["pointer"] for error in refused["problem"]["errors"]] == [pointer]
        assert answered(talk(stream, "update", seq=2, room_type=None)) == before
        unknown = {"id": "b", "label": "gizmo"}
        answer = talk(stream, "update", seq=3, objects=[unknown], unknown_labels="ignore")
        assert answer["missing"]["ignored"] == ["b"]
        refused = talk(stream, "update", seq=4, unknown_labels="error")
        is_problem(refused, 422, "unknown-labels", 4)
        assert refused["problem"]["errors"][0]["pointer"] == "#/scene/objects/b/label"


def test_the_first_message_opens(live: LiveService) -> None:
    with opened(live) as stream:
        for message in ({"type": "update", "seq": 1}, {"type": "scene", "seq": 2}):
            stream.send(json.dumps(message))
            is_problem(hear(stream), 422, "invalid-request", message.get("seq"))  # type: ignore[arg-type]
        is_problem(talk(stream, "open", model="nowhere"), 404, "model-not-found")
        is_problem(talk(stream, "open", room_type="cellar"), 422, "unknown-labels")
        # Every one of these left the stream as it was.
        assert talk(stream, "ping") == {"type": "pong"}
        assert talk(stream, "open")["type"] == "opened"


# --------------------------------------------------------------------------------- the client


@pytest.mark.anyio
async def test_a_client_is_told_and_goes_on(live: LiveService) -> None:
    async with StreamClient(f"http://127.0.0.1:{live.port}", ask=ASK) as stream:
        await stream.update(["bed"])
        await anext(stream)
        refused = await stream.update(["gizmo"])
        with pytest.raises(StreamProblemError) as told:
            await anext(stream)
        assert told.value.seq == refused
        assert told.value.problem.type == "/problems/unknown-labels"
        assert "#/objects/0: the model does not know this label" in str(told.value)
        with pytest.raises(InvalidRequestError, match=r"#/relations/0/1: must be .*mean on-top"):
            await stream.update(relations=[("bed", "on_top", "bed")])
        sent = await stream.replace(["bed", "desk"])
        async for answer in stream:
            assert answer.seq == sent
            break
        await stream.close()
        assert [answer async for answer in stream] == []
    with pytest.raises(StreamClosedError):
        await stream.ping()
    with pytest.raises(StreamClosedError):
        await stream.update(["bed"])


@pytest.mark.anyio
async def test_a_service_that_does_not_open_the_stream_is_unreachable() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        address = rf"ws://127.0.0.1:{port}/stream: no answer within 0.1 s"
        with pytest.raises(UnreachableError, match=address):
            async with StreamClient(f"http://user:secret@127.0.0.1:{port}", timeout=0.1):
                pass


@pytest.mark.slow
@pytest.mark.anyio
async def test_a_client_connects_again_and_sends_the_whole_scene(tmp_path: Path) -> None:
    store = make_store(tmp_path / "store")
    service = launch(store, tmp_path / "first")
    port = service.port
    url = f"http://127.0.0.1:{port}"
    scene = {"objects": ["desk", {"id": "a", "label": "lamp"}, "chair"], "room_type": "office"}
    async with StreamClient(url, ask=ASK, objects=["bed"]) as stream:
        await anext(stream)
        await stream.update(["desk", {"id": "a", "label": "lamp"}], room_type="office")
        await anext(stream)
        await stream.update(["gizmo"])
        with pytest.raises(StreamProblemError):
            await anext(stream)
        waiting = asyncio.create_task(anext(stream))
        await asyncio.to_thread(service.stop)
        # While there is no service, the client goes on.
        for _ in range(20):
            await stream.ping()
            await asyncio.sleep(0.05)
        last = await stream.update(["chair"], remove=["bed"])
        service = await asyncio.to_thread(launch, store, tmp_path / "second", port=port)
        try:
            answer = await waiting
            while answer.seq < last:
                answer = await anext(stream)
            expected = posted(service.client, scene, ASK)["missing"]
            assert answer.missing is not None
            found = answer.missing.model_copy(update={"request_id": ""})
            assert found == type(found).model_validate(expected)
            # It goes on as before, with numbers that go on.
            assert await stream.update(remove=["a"]) == last + 1
            assert (await anext(stream)).seq == last + 1
        finally:
            await asyncio.to_thread(service.stop)


@pytest.mark.slow
@pytest.mark.anyio
async def test_a_client_gives_up_after_a_while(tmp_path: Path) -> None:
    service = launch(make_store(tmp_path / "store"), tmp_path / "log")
    async with StreamClient(f"http://127.0.0.1:{service.port}", reconnect=1.0) as stream:
        await asyncio.to_thread(service.stop)
        with pytest.raises(StreamClosedError) as ended:
            await anext(stream)
        assert ended.value.code in {1001, 1012}
        assert f"within 1 s: ws://127.0.0.1:{service.port}/stream: " in str(ended.value)
        with pytest.raises(StreamClosedError):
            await stream.update(["bed"])


# -------------------------------------------------------------------------------- model swaps


@pytest.mark.slow
def test_the_next_answer_is_of_the_model_that_was_promoted(tmp_path: Path) -> None:
    service = launch(make_store(tmp_path / "store"), tmp_path / "log")
    with service, opened(service) as stream:
        talk(stream, "open", ask=ASK)
        answer = talk(stream, "update", seq=1, objects=["bed", "lamp"])
        assert answer["missing"]["model"]["version"] == "1.0.0"
        response = service.client.put(
            "/models/aliases/default",
            json={"model": "home@1.1.0"},
            headers={"X-Admin-Key": ADMIN_KEY},
        )
        assert response.status_code == 200
        answer = talk(stream, "update", seq=2, objects=["desk"])
        assert answer["missing"]["model"]["version"] == "1.1.0"
        scene = {"objects": ["bed", "lamp", "desk"]}
        assert answered(answer) == posted(service.client, scene, ASK)
        # A label that the next model lacks is a fault of the kept scene.
        publish(tmp_path / "store", "small", "1.0.0", classes=3, alias="default")
        admin = {"X-Admin-Key": ADMIN_KEY}
        assert service.client.post("/models/refresh", headers=admin).status_code == 200
        refused = talk(stream, "update", seq=3, objects=["bed"])
        is_problem(refused, 422, "unknown-labels", 3)
        assert refused["problem"]["errors"][0]["pointer"] == "#/scene/objects/desk"
