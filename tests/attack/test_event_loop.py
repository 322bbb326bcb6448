"""Unread logs, departed clients, floods of refusals and a busy event loop: others are served."""

import asyncio
import json
import math
import os
import signal
import socket
import struct
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, ExitStack, closing, contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.serving.admission import Ticket
from benchmarks.load.connections import prepared
from tests.services import (
    PATIENCE,
    LiveService,
    begin,
    free_port,
    launch,
    live_service,
    serve,
    wait_until,
)

SCENE = {"objects": ["bed", "lamp"]}
QUEUED = 50  # lines that wait for the reader of the log, at most

FEW_LINES = f"""
import sys
import app.serving.logs
app.serving.logs.MOST_LINES = {QUEUED}
from app.__main__ import main
sys.exit(main())
"""
"""A program for `begin`: a service whose queue of log lines is short."""


@contextmanager
def unread(store: Path, pipe: Path, *program: str) -> Iterator[tuple[HTTPConnection, int]]:
    """Run a service that logs into a pipe without a reader.

    Yield a connection to the service and the other end of the pipe. The service must end on
    SIGTERM.
    """
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    port = free_port()
    process = begin(store, pipe, program=program or ("-m", "app"), SCENE_PORT=str(port))

    def listens() -> bool:
        with suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
            return True
        return process.poll() is not None

    try:
        wait_until(listens)
        with closing(HTTPConnection("127.0.0.1", port, timeout=PATIENCE)) as connection:
            yield connection, end
        process.terminate()
        assert process.wait(timeout=PATIENCE) == -signal.SIGTERM
    finally:
        process.kill()
        process.wait(timeout=PATIENCE)
        os.close(end)


def ask(connection: HTTPConnection, count: int) -> None:
    for _ in range(count):
        connection.request("GET", "/models")
        with connection.getresponse() as response:
            assert response.status == 200
            response.read()


@pytest.mark.system
def test_an_unread_log_stops_nothing(shared_store: Path, tmp_path: Path) -> None:
    """The lines of 2,000 requests exceed the pipe; without a queue, the service waits for ever."""
    with unread(shared_store, tmp_path / "log") as (connection, _):
        ask(connection, 2_000)


@pytest.mark.system
def test_every_log_line_is_written_or_counted(shared_store: Path, tmp_path: Path) -> None:
    lines = list[str]()

    def read() -> None:
        os.set_blocking(end, True)
        with os.fdopen(os.dup(end)) as log:
            lines.extend(log)

    reader = threading.Thread(target=read)
    with unread(shared_store, tmp_path / "log", "-c", FEW_LINES) as (connection, end):
        ask(connection, 2_000)
        reader.start()
        wait_until(lambda: any("log lines are lost" in line for line in lines))
        ask(connection, 10)
    reader.join(PATIENCE)
    entries = [json.loads(line) for line in lines]
    written = sum(entry["logger"] == "app.access" for entry in entries)
    lost = sum(
        int(entry["message"].split()[0]) for entry in entries if entry["logger"] == "app.log"
    )
    assert lost > 2_000 - QUEUED - 1_500
    assert written + lost == 2_010
    # The end of the process writes the waiting lines.
    assert entries[-1]["message"].startswith("Finished server process")


service = live_service()


@pytest.mark.system
def test_departed_clients_are_no_defects(service: LiveService) -> None:
    """Clients send several requests and reset the connection during the answer to the first one."""
    batch = prepared("/missing/batch", {"scenes": [SCENE] * 64})
    health = b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n"
    refused = b"GET /models HTTP/1.1\r\nHost: evil.example\r\n\r\n"
    for request in (batch, prepared("/missing", SCENE), health, refused):
        for _ in range(20):
            with socket.create_connection(("127.0.0.1", service.port)) as connection:
                reset = struct.pack("ii", 1, 0)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
                connection.sendall(request * 20)
    pending = 'scene_pending{lane="%s"} 0.0'
    wait_until(lambda: pending % "slow" in service.client.get("/metrics").text)
    assert 'outcome="internal-error"' not in service.client.get("/metrics").text
    log = [json.loads(line) for line in service.log.read_text().splitlines()]
    assert [entry for entry in log if entry["level"] == "error"] == []
    assert max(entry.get("status", 0) for entry in log) < 500


KEY = "incorrect-zebra-capacitor-nail"


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/health/live", {}, 200),
        ("/models", {"Host": "evil.example"}, 421),
        ("/models", {"X-API-Key": "wrong"}, 401),
        ("/models", {"X-Request-Timeout-Ms": "soon"}, 400),
        ("/nowhere", {}, 404),
    ],
)
async def test_cheap_answers_take_turns(shared_store, path, headers, status):
    """Behind 200 cheap requests of one client, the question of another client waits for a few."""
    answered = list[tuple[str, int]]()
    async with serve(shared_store, api_key=KEY) as client, AsyncExitStack() as stack:
        app = client.app  # type: ignore[attr-defined]

        async def send(address: str, method: str, path: str, **request: Any) -> None:
            transport = httpx.ASGITransport(app, client=(address, 1))
            sender = httpx.AsyncClient(transport=transport, base_url="http://service")
            await stack.enter_async_context(sender)
            response = await sender.request(method, path, **request)
            answered.append((address, response.status_code))

        lane = app.state.runtime.admission.quick
        holders = [Ticket("holder", math.inf) for _ in range(lane.free_slots)]
        for holder in holders:
            await holder.enter(lane, 1)
        flood = {"X-API-Key": KEY} | headers
        sent = [send("10.0.0.1", "GET", path, headers=flood) for _ in range(200)]
        sent.append(send("10.0.0.2", "POST", "/missing", json=SCENE, headers={"X-API-Key": KEY}))
        every = asyncio.gather(*sent)
        for _ in range(300):
            await asyncio.sleep(0)
        assert answered == []
        for holder in holders:
            holder.leave()
        await every
    assert answered.index(("10.0.0.2", 200)) < 20
    assert answered.count(("10.0.0.1", status)) == 200


BUSY = """
import sys
from pathlib import Path
import app.api.health
from app.__main__ import main
from app.questions.missing import MISSING

answer, begun, release = MISSING.answer, Path({begun!r}), Path({release!r})

def busy(model, scene, *args, **parameters):
    if len(scene.objects) == 5:
        begun.touch()
        while not release.exists():
            pass
    return answer(model, scene, *args, **parameters)

MISSING.answer = busy
app.api.health.HUNG_SECONDS = {hung}
sys.exit(main())
"""
"""A program for `launch`: a question about five objects holds the loop until a file exists."""


@pytest.mark.system
@pytest.mark.parametrize(("hung", "status"), [(1e9, 200), (0.1, 503)], ids=["busy", "hung"])
def test_health_checks_of_a_busy_event_loop(shared_store, tmp_path, hung, status):
    begun, release, port = tmp_path / "begun", tmp_path / "release", free_port()
    program = BUSY.format(begun=str(begun), release=str(release), hung=hung)

    def check(path: str) -> tuple[int, str]:
        response = httpx.get(f"http://127.0.0.1:{port}/health/{path}", timeout=PATIENCE)
        assert response.headers["connection"] == "close"
        document = response.json()
        return response.status_code, document.get("detail", document["status"])

    with (
        launch(
            *(shared_store, tmp_path / "log"),
            program=("-c", program),
            SCENE_HEALTH_PORT=str(port),
        ) as service,
        ThreadPoolExecutor() as pool,
        ExitStack() as stack,
    ):
        five = {"objects": ["bed", "lamp", "desk", "chair", "sofa"]}
        question = pool.submit(service.client.post, "/missing", json=five)
        try:
            wait_until(begun.exists, service.log)
            wait_until(lambda: check("live")[0] == status)
            for _ in range(100):  # silent connections
                address = ("127.0.0.1", port)
                stack.enter_context(socket.create_connection(address, timeout=PATIENCE))
            for path in ("live", "ready") * 10:
                answered, text = check(path)
                assert answered == status
                assert text == path or text.startswith("The event loop has not run for ")
            assert not question.done()
        finally:
            release.touch()
        assert question.result().status_code == 200
        wait_until(lambda: check("live") == (200, "live"))
        wait_until(lambda: check("ready") == (200, "ready"))
