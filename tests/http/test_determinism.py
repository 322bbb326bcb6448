"""The same request gives the same bytes: alone, among others, under load, after a restart."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.load.connections import Connection, connect, prepared
from tests.services import LiveService, launch

pytestmark = pytest.mark.system

OTHERS = 31
SCENE: dict[str, Any] = {
    "objects": [
        "bed",
        {"id": "lamp_1", "label": "lamp", "confidence": 0.7},
        {"id": "desk_1", "label": "desk", "position": {"x": 1.0, "y": 0.2, "z": 0.4}},
        "chair",
        "chair",
    ],
    "relations": [{"subject": "lamp_1", "relation": "on-top", "object": "desk_1"}],
    "room_type": "bedroom",
    "seed": 2**60 + 1,
}
BATCH = {"scenes": [SCENE, {"objects": ["nothing known"]}, {"objects": ["sofa", "television"]}]}
REQUESTS = {
    "/relations": SCENE | {"include_opposites": True},
    "/missing": SCENE,
    "/outliers": SCENE | {"objects": [*SCENE["objects"], "toilet"]},
    "/rooms": SCENE,
    "/generate": SCENE | {"count": 4, "steps": 20},
    "/relations/batch": BATCH,
    "/missing/batch": BATCH,
    "/outliers/batch": BATCH,
    "/rooms/batch": BATCH,
}


def wire(path: str) -> bytes:
    """The request as it is asked every time."""
    return prepared(path, REQUESTS[path], {"x-request-id": "same"})


def others(path: str) -> list[bytes]:
    """Requests of the same kind that differ from it and from each other."""
    labels = ("bed", "lamp", "desk", "chair", "sofa", "sink", "book", "pillow", "table")
    made = []
    for k in range(OTHERS):
        scene = {"objects": [labels[(k + j) % 9] for j in range(1 + k % 8)], "seed": k}
        if path == "/generate":
            scene |= {"count": 1 + k % 3, "steps": 5 + k}
        made.append(prepared(path, {"scenes": [scene]} if path.endswith("/batch") else scene))
    return made


async def ask(port: int, requests: list[bytes]) -> list[bytes]:
    """Each on a connection of its own, all sent before any answer is read."""
    answers: dict[Connection, bytes] = {}
    finished = asyncio.Event()

    def answered(connection: Connection, status: int, body: bytes) -> None:
        assert status == 200
        answers[connection] = body
        if len(answers) == len(requests):
            finished.set()

    connections = await connect(port, len(requests), answered)
    for connection, request in zip(connections, requests, strict=True):
        connection.send(request)
    await asyncio.wait_for(finished.wait(), 60)
    for connection in connections:
        connection.close()
    return [answers[connection] for connection in connections]


@pytest.fixture(scope="module")
def alone(live: LiveService) -> dict[str, bytes]:
    """Each request's answer from a service that does nothing else."""

    async def every() -> dict[str, bytes]:
        return {path: (await ask(live.port, [wire(path)]))[0] for path in REQUESTS}

    return asyncio.run(every())


async def test_under_load_of_every_kind(live: LiveService, alone: dict[str, bytes]) -> None:
    mixed = [request for path in REQUESTS for request in others(path)[:8]]
    for path in REQUESTS:
        assert (await ask(live.port, [*mixed, wire(path), *mixed]))[len(mixed)] == alone[path]


@pytest.fixture
def restarted(shared_store: Path, tmp_path: Path) -> Iterator[LiveService]:
    """Another process over the same store."""
    with launch(shared_store, tmp_path / "log") as service:
        yield service


async def test_after_a_restart(restarted: LiveService, alone: dict[str, bytes]) -> None:
    # In another order, so that no answer depends on those before.
    for path in reversed(REQUESTS):
        assert await ask(restarted.port, [wire(path)]) == [alone[path]]
