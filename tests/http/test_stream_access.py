"""Streams over real sockets: who may have one, how it ends, and what is counted."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from scene_client import ProblemError, StreamClient, UnreachableError
from tests.chaos.wire import Wire, exchange
from tests.http.stores import make_store
from tests.http.streams import closed, hear, is_document, opened, say, talk
from tests.http.test_problems import problem
from tests.services import DEFECTIVE, LiveService, launch

pytestmark = pytest.mark.system

API_KEY = "a-key-for-all-who-ask-0123456789"
PAGE = "https://panel.example"


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
