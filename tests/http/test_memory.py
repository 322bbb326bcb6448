"""A request frees its memory with its answer, without the garbage collector.

Reference cycles would keep bodies of megabytes until the collector runs, which is rare.
"""

from __future__ import annotations

import gc
import json
from typing import Any

import anyio
import httpx
import pytest

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
    "batch": (
        "/missing/batch",
        {"scenes": [SCENE, None, CYCLE, SCENE | {"model": "Zq7"}, {}]},
        200,
    ),
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
async def test_no_cycle_keeps_a_request(client: httpx.AsyncClient, case: str) -> None:
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
