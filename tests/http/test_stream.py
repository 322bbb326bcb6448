"""Streams over real sockets: their answers are those of requests with the same scene."""

from __future__ import annotations

import asyncio
import json
import random
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from app.api.catalogue import PROBLEM_TYPES
from scene_client import (
    ProblemError,
    StreamClient,
    StreamClosedError,
    StreamProblemError,
    UnreachableError,
)
from tests.chaos.wire import Wire, exchange
from tests.conftest import REPOSITORY
from tests.http.stores import make_store, publish
from tests.http.streams import ASK, answered, hear, opened, posted, say, talk, updates
from tests.http.test_problems import problem
from tests.services import ADMIN_KEY, DEFECTIVE, LiveService, launch

pytestmark = pytest.mark.system

API_KEY = "a-key-for-all-who-ask-0123456789"
PAGE = "https://panel.example"
DOCUMENT = (REPOSITORY / "docs" / "stream.md").read_text("utf-8")


def is_problem(message: dict[str, Any], status: int, slug: str, seq: int | None = None) -> None:
    assert message["type"] == "problem", message
    assert message.get("seq") == seq
    is_document(message["problem"], status, slug)


def is_document(document: dict[str, Any], status: int, slug: str) -> None:
    assert document["type"] == f"/problems/{slug}"
    assert document["status"] == status
    assert document["request_id"]


def closed(stream: Any) -> tuple[int, str]:
    """How a stream was closed; what was still sent is read."""
    try:
        while True:
            stream.recv(timeout=30)
    except ConnectionClosed as ended:
        return (1006, "") if ended.rcvd is None else (ended.rcvd.code, ended.rcvd.reason)


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
        answer = talk(stream, "update", seq=1, objects=objects)
        assert (answer["seq"], answer["superseded"]) == (1, 0)
        is_document(answer["problems"]["relations"], 504, "deadline-passed")
        # It has counted: the next one is about the next message alone.
        answer = talk(stream, "scene", seq=2, objects=["bed"])
        assert (answer["seq"], answer["superseded"]) == (2, 0)


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
    ((share, burst),) = re.findall(r"(\d+) % of a core, and (\d+) s at once", DOCUMENT)
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
        ({"objects": ["bed", "bed"]}, "#/objects/1/id"),
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


# -------------------------------------------------------------------------------- who may


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """A service with keys, with pages of one other origin, and of little patience and room."""
    folder = tmp_path_factory.mktemp("guarded")
    with launch(
        make_store(folder / "store"),
        folder / "log",
        SCENE_API_KEY=API_KEY,
        SCENE_CORS_ORIGINS=PAGE,
        SCENE_CLIENT_TIMEOUT="2",
        SCENE_STREAM_IDLE="1.5",
        SCENE_MAX_STREAMS="3",
        SCENE_MAX_BODY_BYTES="20000",
    ) as service:
        yield service


KEY = {"X-API-Key": API_KEY}


def refused(service: LiveService, **arguments: Any) -> tuple[dict[str, Any], httpx.Headers]:
    """The problem that a handshake is answered with, and its headers."""
    with pytest.raises(InvalidStatus) as found, opened(service, **arguments):
        pass
    response = found.value.response
    headers = httpx.Headers(list(response.headers.raw_items()))
    assert headers["content-type"] == "application/problem+json"
    document = json.loads(response.body or b"null")
    assert document["request_id"] == headers["x-request-id"]
    assert document["status"] == response.status_code
    return document, headers


def test_a_stream_needs_the_key_and_takes_it_as_any_request(guarded: LiveService) -> None:
    for wrong in ({}, {"X-API-Key": API_KEY[:-1]}, {"Authorization": f"Basic {API_KEY}"}):
        document, headers = refused(guarded, additional_headers=wrong)
        is_document(document, 401, "unauthorized")
        assert headers["www-authenticate"] == "Bearer"
    for headers in (KEY, {"Authorization": f"Bearer {API_KEY}"}):
        with opened(guarded, additional_headers=headers) as stream:
            assert talk(stream, "open")["type"] == "opened"


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        (None, True),
        (PAGE, True),
        ("http://127.0.0.1:{port}", True),
        ("https://127.0.0.1:{port}", True),
        ("http://127.0.0.1", False),
        ("http://127.0.0.1:1", False),
        ("http://localhost:{port}", False),
        ("https://other.example", False),
        (PAGE + ".other.example", False),
        ("http://panel.example", False),
        ("null", False),
        ("ftp://127.0.0.1:{port}", False),
        ("127.0.0.1:{port}", False),
        ("http://", False),
    ],
)
def test_pages_of_other_origins_open_no_stream(
    guarded: LiveService, origin: str | None, allowed: bool
) -> None:
    page = None if origin is None else origin.format(port=guarded.port)
    arguments: dict[str, Any] = {"origin": page, "additional_headers": KEY}
    if allowed:
        with opened(guarded, **arguments) as stream:
            talk(stream, "open")
    else:
        document, _ = refused(guarded, **arguments)
        is_document(document, 403, "origin-refused")


def test_a_client_is_told_why_it_has_no_stream(guarded: LiveService) -> None:
    async def connect(url: str) -> None:
        async with StreamClient(url):
            pass

    with pytest.raises(ProblemError) as refusal:
        asyncio.run(connect(f"http://127.0.0.1:{guarded.port}"))
    assert (refusal.value.status, refusal.value.type) == (401, "/problems/unauthorized")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(UnreachableError):
        asyncio.run(connect(f"http://127.0.0.1:{port}"))


def test_no_more_streams_than_there_is_room_for(guarded: LiveService) -> None:
    with ExitStack() as streams:
        for _ in range(3):
            streams.enter_context(opened(guarded, additional_headers=KEY))
        document, headers = refused(guarded, additional_headers=KEY)
        is_document(document, 503, "too-many-streams")
        assert int(headers["retry-after"]) > 0
        # Requests have nothing to do with it.
        response = guarded.client.post("/missing", json={"objects": ["bed"]}, headers=KEY)
        assert response.status_code == 200
    for _ in range(100):
        try:
            with opened(guarded, additional_headers=KEY) as stream:
                talk(stream, "open")
            break
        except InvalidStatus:
            time.sleep(0.05)
    else:
        pytest.fail("a place is lost")


@pytest.mark.slow
def test_who_is_silent_loses_the_place(guarded: LiveService) -> None:
    with opened(guarded, additional_headers=KEY) as stream:
        assert closed(stream) == (1008, "stream-idle")
    with opened(guarded, additional_headers=KEY) as stream:
        talk(stream, "open", objects=["bed"])
        hear(stream)
        for _ in range(2):
            time.sleep(1)
            assert talk(stream, "ping") == {"type": "pong"}
        assert closed(stream) == (1008, "stream-idle")


def test_a_message_may_be_as_large_as_a_body(guarded: LiveService) -> None:
    with opened(guarded, additional_headers=KEY) as stream:
        assert talk(stream, "open")["limits"]["max_message_bytes"] == 20_000
        text = json.dumps({"type": "update", "seq": 1, "objects": ["bed"]})
        stream.send(text + " " * (20_000 - len(text)))
        assert hear(stream)["seq"] == 1
        stream.send(" " * 20_001)
        assert closed(stream)[0] == 1009


@pytest.mark.anyio
async def test_a_client_that_does_not_read_loses_its_place(guarded: LiveService) -> None:
    """Its answers are not kept: messages are merged while one answer waits."""
    url = f"ws://127.0.0.1:{guarded.port}/stream"
    before = guarded.memory
    deaf = await connect(
        url, additional_headers=KEY, proxy=None, compression=None, max_queue=1, ping_interval=None
    )
    ask = {"relations": {"top_k": 4096, "include_opposites": True}, "missing": {"top_k": 16}}
    await deaf.send(json.dumps({"type": "open", "ask": ask}))
    await deaf.recv()
    deaf.transport.pause_reading()
    seq = 0
    began = time.monotonic()
    line = None
    with suppress(ConnectionClosed, TimeoutError):
        while (line := _end_of_stream(guarded)) is None and time.monotonic() - began < 60:
            seq += 1
            objects = [{"id": f"{k}", "label": "bed"} for k in range(seq % 40, 60)]
            async with asyncio.timeout(10):
                await deaf.send(json.dumps({"type": "scene", "seq": seq, "objects": objects}))
            await asyncio.sleep(0.01)
    line = line or _end_of_stream(guarded)
    assert line is not None
    assert time.monotonic() - began > 1
    assert guarded.memory - before < 32 * 2**20
    # Most messages have been merged, and few of the answers were made.
    assert line["messages"] > 2 * line["answers"]
    deaf.transport.abort()


def _end_of_stream(service: LiveService) -> dict[str, Any] | None:
    """The newest line of the log about a stream of many messages, if its stream has ended."""
    lines = [json.loads(line) for line in service.log.read_text().splitlines()]
    found = [line for line in lines if line.get("route") == "/stream" and "answers" in line]
    return next((line for line in reversed(found) if line["messages"] > 20), None)


# ---------------------------------------------------------------------------------- the end


def test_a_service_that_ends_takes_its_leave(tmp_path: Path) -> None:
    service = launch(make_store(tmp_path / "store"), tmp_path / "log", SCENE_DRAIN_SECONDS="1")
    with opened(service) as stream, opened(service) as unopened:
        talk(stream, "open")
        talk(stream, "update", seq=1, objects=["bed"])
        began = time.monotonic()
        service.process.send_signal(signal.SIGTERM)
        assert closed(stream) == closed(unopened) == (1001, "draining")
    service.client.close()
    service.process.wait(timeout=30)
    assert service.process.returncode == -signal.SIGTERM
    assert time.monotonic() - began < 15
    log = service.log.read_text()
    assert "Application shutdown complete" in log
    assert "Traceback" not in log
    assert "timeout graceful shutdown" not in log


@pytest.fixture(scope="module")
def defective(
    shared_store: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[LiveService]:
    """A service that has a defect in one question."""
    log = tmp_path_factory.mktemp("defective") / "log"
    with launch(
        shared_store, log, program=("-c", DEFECTIVE.format(message="of course"))
    ) as service:
        yield service


@pytest.mark.slow
def test_a_defect_ends_its_stream_alone(defective: LiveService) -> None:
    before = defective.log.read_text().count("of course")
    with opened(defective) as other, opened(defective) as stream:
        talk(other, "open", ask={"outliers": {}})
        request = stream.response.headers["x-request-id"]  # type: ignore[union-attr]
        talk(stream, "open")
        say(stream, "update", seq=1, objects=["bed"], room_type="bedroom")
        assert closed(stream) == (1011, "")
        assert talk(other, "update", seq=1, objects=["bed"])["type"] == "answer"
    log = defective.log.read_text()
    assert log.count("of course") == before + 1
    (line,) = [
        entry
        for entry in map(json.loads, log.splitlines())
        if entry.get("request_id") == request and entry.get("route") == "/stream"
    ]
    assert line["outcome"] == "internal-error"


def test_a_connection_outlives_a_defect(defective: LiveService) -> None:
    before = defective.log.read_text().count("ZeroDivisionError")
    body = b'{"objects": ["bed", "chair", "lamp"], "room_type": "bedroom"}'
    request = (
        b"POST /missing HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        b"Content-Length: " + str(len(body)).encode() + b"\r\n\r\n" + body
    )
    answers, is_closed = exchange(defective.port, Wire("", [request] * 3, (500,) * 3))
    assert not is_closed
    assert [answer.status for answer in answers] == [500] * 3
    assert all(b"/problems/internal-error" in answer.body for answer in answers)
    # Each is in the log once, under its id.
    assert defective.log.read_text().count("ZeroDivisionError") == before + 3


# ----------------------------------------------------------------------------------- HTTP


def test_who_does_not_ask_for_a_websocket_is_told_to(live: LiveService) -> None:
    for headers in ({}, {"Connection": "upgrade", "Upgrade": "h2c"}):
        response = live.client.get("/stream", headers=headers)
        problem(response, 426, "upgrade-required")
        assert response.headers["upgrade"] == "websocket"
    response = live.client.get("/stream", headers={"Connection": "upgrade", "Upgrade": "websocket"})
    assert response.status_code == 400
    problem(live.client.post("/stream", json={}), 405, "method-not-allowed")


# ------------------------------------------------------------------------------- what is told


def counted(service: LiveService) -> dict[tuple[str, ...], float]:
    text = service.client.get("/metrics").text
    return {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name.startswith(("scene_stream", "scene_requests"))
    }


@pytest.mark.slow
def test_streams_are_counted_and_logged(tmp_path: Path) -> None:
    with launch(make_store(tmp_path / "store"), tmp_path / "log") as service:
        with opened(service) as stream:
            talk(stream, "open")
            for seq in (1, 2):
                talk(stream, "update", seq=seq, objects=["bed"])
            talk(stream, "update", seq=3, objects=["gizmo"])
            stream.send('{"type": "noise"}')
            hear(stream)
            assert counted(service)["scene_streams",] == 1
        found = counted(service)
        assert found["scene_streams",] == 0
        messages = {key[:0:-1]: value for key, value in found.items() if "messages_total" in key[0]}
        assert messages == {
            ("open", "success"): 1,
            ("update", "success"): 2,
            ("update", "unknown-labels"): 1,
            ("-", "invalid-request"): 1,
        }
        assert found["scene_stream_answers_total", "success"] == 2
        assert found["scene_stream_superseded_total",] == 0
        assert found["scene_requests_total", "GET", "success", "/stream"] == 1
        (line,) = [
            entry
            for entry in map(json.loads, service.log.read_text().splitlines())
            if entry.get("route") == "/stream"
        ]
        assert (line["status"], line["outcome"], line["close_code"]) == (101, "success", 1000)
        assert (line["messages"], line["answers"], line["superseded"]) == (5, 2, 0)
        assert (line["model"], line["version"]) == ("home", "1.0.0")
        assert line["compute_ms"] > 0
