"""Costly questions delay no quick ones, and work for departed clients ends."""

import asyncio
import gc
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from httpx import AsyncClient
from pydantic import ValidationError

from app.settings import Settings
from tests.http.stores import VOCABULARY
from tests.http.test_problems import problem
from tests.services import Pause, Replace, serve

LABELS = [entry.label for entry in VOCABULARY.objects if not entry.structure]
HOME = {"objects": LABELS[:4]}
LONG = {"X-Request-Timeout-Ms": "60000"}


async def test_quick_questions_pass_costly_ones(shared_store: Path, pause: Pause) -> None:
    async with serve(shared_store) as client:
        client.headers.update(LONG)
        paused = pause("outliers")
        large = {"objects": [LABELS[0]] * 33, "model": "general"}
        costly = [
            *(asyncio.ensure_future(client.post("/outliers", json=large)) for _ in range(4)),
            asyncio.ensure_future(client.post("/outliers/batch", json={"scenes": [large] * 4})),
            *(asyncio.ensure_future(client.get("/openapi.json")) for _ in range(24)),
        ]
        assert await asyncio.to_thread(paused.started.wait, 60)
        for size in range(1, 14):
            body = {"objects": LABELS[:size]}
            assert (await client.post("/missing", json=body)).is_success
            assert (await client.post("/relations", json=body)).is_success
            assert (await client.get("/health/live")).is_success
        assert not any(job.done() for job in costly)
        paused.release.set()
        assert all(answer.is_success for answer in await asyncio.gather(*costly))


def test_the_longest_deadline_is_no_shorter_than_the_default(shared_store: Path) -> None:
    with pytest.raises(ValidationError, match="at least SCENE_REQUEST_TIMEOUT_MS"):
        Settings(store=shared_store, request_timeout_ms=2_000, max_request_timeout_ms=1_000)


async def test_work_of_a_departed_client_ends(shared_store: Path, replace: Replace) -> None:
    begun, ended = threading.Event(), threading.Event()

    def endless(generate: Any, *args: Any, stop: Callable[[], bool], **options: Any) -> Any:
        begun.set()
        while not stop():
            time.sleep(0.001)
        ended.set()
        return generate(*args, stop=stop, **options)

    async with serve(shared_store) as client:
        replace("generate", endless)
        drawing = asyncio.ensure_future(client.post("/generate", json=HOME, headers=LONG))
        assert await asyncio.to_thread(begun.wait, 60)
        drawing.cancel()
        assert await asyncio.to_thread(ended.wait, 60)


async def test_a_memory_error_gets_503(shared_store, replace, caplog):
    def fail(*_: Any, **__: Any) -> Any:
        raise MemoryError

    async with serve(shared_store) as client:
        replace("outliers", fail)
        problem(await client.post("/outliers", json=HOME), 503, "bodies-full")
        assert "not enough memory" in caplog.text
        assert (await client.post("/missing", json=HOME)).is_success


# Reference cycles would keep bodies of megabytes until the collector runs, which is rare.
SCENE = {"objects": ["bed", "lamp", "desk"]}
CYCLE = {
    "objects": ["bed", "lamp"],
    "relations": [
        {"subject": "bed", "relation": "on-top", "object": "lamp"},
        {"subject": "lamp", "relation": "on-top", "object": "bed"},
    ],
}
CASES: dict[str, tuple[str, Any, int]] = {
    "relations": ("/relations", SCENE, 200),
    "missing": ("/missing", SCENE, 200),
    "outliers": ("/outliers", SCENE, 200),
    "rooms": ("/rooms", SCENE, 200),
    "generate": ("/generate", {"seed": 1, "steps": 2}, 200),
    "not JSON": ("/missing", b"{", 400),
    "unknown label": ("/missing", {"objects": ["bed", "Zq7"]}, 422),
    "unknown model": ("/missing", SCENE | {"model": "Zq7"}, 404),
    "contradiction": ("/outliers", CYCLE, 422),
    "batch": ("/missing/batch", {"scenes": [SCENE, None, CYCLE, SCENE | {"model": "Z"}, {}]}, 200),
    "full batch": ("/relations/batch", {"scenes": [SCENE] * 257}, 422),
}


async def status(app: Any, path: str, body: bytes) -> int:
    """Of an answer, by the ASGI protocol itself: clients leave cycles of their own."""
    headers = [(b"host", b"service"), (b"content-type", b"application/json")]
    scope = {"type": "http", "method": "POST", "path": path, "query_string": b"", "state": {}}
    scope |= {"headers": headers, "client": ("127.0.0.1", 1), "root_path": ""}
    events = [{"type": "http.request", "body": body, "more_body": False}]
    found: list[int] = []

    async def receive() -> dict[str, Any]:
        if not events:
            await anyio.sleep_forever()  # the client stays
        return events.pop()

    async def send(event: dict[str, Any]) -> None:
        if event["type"] == "http.response.start":
            found.append(event["status"])

    await app(scope, receive, send)
    return found[0]


@pytest.mark.parametrize("case", CASES)
async def test_no_cycle_keeps_a_request(client: AsyncClient, case: str) -> None:
    path, content, expected = CASES[case]
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    app: Any = client.app  # type: ignore[attr-defined]
    # The first request of a kind makes objects that stay.
    assert await status(app, path, body) == expected
    gc.collect()
    gc.disable()
    try:
        assert await status(app, path, body) == expected
        assert gc.collect() == 0
    finally:
        gc.enable()
