"""Helpers for tests of `/stream`: raw WebSocket messages, and random updates of a scene."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tests.http.stores import VOCABULARY
from tests.services import LiveService

LABELS = [entry.label for entry in VOCABULARY.objects]
ASK: dict[str, Any] = {
    "missing": {"top_k": 5},
    "outliers": {},
    "relations": {"top_k": 12, "include_opposites": True},
}


def opened(service: LiveService, **arguments: Any) -> AbstractContextManager[ClientConnection]:
    """Open a WebSocket to a service."""
    address = f"ws://127.0.0.1:{service.port}/stream"
    return connect(address, proxy=None, compression=None, **arguments)


def say(stream: ClientConnection, kind: str, **fields: Any) -> None:
    """Send one message."""
    stream.send(json.dumps({"type": kind, **fields}))


def hear(stream: ClientConnection) -> dict[str, Any]:
    """Receive the next message."""
    found: dict[str, Any] = json.loads(stream.recv(timeout=30))
    return found


def talk(stream: ClientConnection, kind: str, **fields: Any) -> dict[str, Any]:
    """Send one message, and receive the next one."""
    say(stream, kind, **fields)
    return hear(stream)


def posted(client: httpx.Client, scene: dict[str, Any], ask: dict[str, Any]) -> dict[str, Any]:
    """Send one request per question about a scene, and return the answers by question."""
    found = {}
    for question, options in ask.items():
        response = client.post(f"/{question}", json={**scene, **options})
        assert response.status_code == 200, response.text
        found[question] = {**response.json(), "request_id": ""}
    return found


def answered(message: dict[str, Any]) -> dict[str, Any]:
    """The answers in a message of the stream, by question."""
    assert message["type"] == "answer", message
    assert "problems" not in message
    questions = message.keys() - {"type", "seq", "superseded"}
    return {name: {**message[name], "request_id": ""} for name in questions}


def is_problem(message: dict[str, Any], status: int, slug: str, seq: int | None = None) -> None:
    """Check that a message is the expected problem."""
    assert message["type"] == "problem", message
    assert message.get("seq") == seq
    is_document(message["problem"], status, slug)


def is_document(document: dict[str, Any], status: int, slug: str) -> None:
    """Check that a problem document has the expected type and status, and a request id."""
    assert document["type"] == f"/problems/{slug}"
    assert document["status"] == status
    assert document["request_id"]


def closed(stream: Any) -> tuple[int, str]:
    """Read a stream until it closes, and return the close code and reason."""
    try:
        while True:
            stream.recv(timeout=30)
    except ConnectionClosed as ended:
        return (1006, "") if ended.rcvd is None else (ended.rcvd.code, ended.rcvd.reason)


def updates(count: int, seed: int, *, poses: bool = True) -> Iterator[tuple[dict, dict]]:
    """Random updates of a room of up to 20 objects, each with the resulting scene."""
    draw = random.Random(seed)
    objects: dict[str, dict[str, Any]] = {}
    scene: dict[str, Any] = {}
    for number in range(count):
        update: dict[str, Any] = {}
        if len(objects) > 4 and draw.random() < 0.2:
            update["remove"] = draw.sample(sorted(objects), draw.randint(1, 3))
            for name in update["remove"]:
                del objects[name]
        update["objects"] = []
        for name in draw.sample([f"thing_{k}" for k in range(20)], draw.randint(1, 3)):
            thing = {"id": name, "label": objects.get(name, {}).get("label", draw.choice(LABELS))}
            if poses:
                thing["position"] = {axis: round(draw.uniform(0, 3), 2) for axis in "xyz"}
            if draw.random() < 0.3:
                thing["confidence"] = round(draw.uniform(0.2, 1), 2)
            objects[name] = thing
            update["objects"].append(thing)
        if number % 97 == 50:
            update["room_type"] = draw.choice([None, "bedroom", "bathroom"])
        if number % 53 == 20:
            update["stamp"] = {"sec": number, "nanosec": 0}
        scene |= {name: update[name] for name in ("room_type", "stamp") if name in update}
        yield update, {**scene, "objects": list(objects.values())}
