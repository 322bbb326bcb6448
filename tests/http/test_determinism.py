"""The same request gives the same bytes: alone, under load of every kind, after a restart."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.load.connections import prepared
from tests.chaos.load import ConstantLoad
from tests.services import LiveService

pytestmark = pytest.mark.system

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
    **{f"/{name}/batch": BATCH for name in ("relations", "missing", "outliers", "rooms")},
}
LABELS = ("bed", "lamp", "desk", "chair", "sofa", "sink", "book", "pillow", "table")


def others() -> list[bytes]:
    """Requests of each kind that differ from those above and from each other."""
    made = []
    for path in REQUESTS:
        for k in range(8):
            scene = {"objects": [LABELS[(k + j) % 9] for j in range(1 + k)], "seed": k}
            if path == "/generate":
                scene |= {"count": 1 + k % 3, "steps": 5 + k}
            made.append(prepared(path, {"scenes": [scene]} if path.endswith("/batch") else scene))
    return made


def ask(service: LiveService, path: str) -> bytes:
    headers = {"X-Request-Id": "same"}
    response = service.client.post(path, json=REQUESTS[path], headers=headers)
    assert response.status_code == 200
    return response.content


@pytest.fixture(scope="module")
def alone(live: LiveService) -> dict[str, bytes]:
    """The answers of a service without other requests."""
    return {path: ask(live, path) for path in REQUESTS}


def test_answers_under_load_are_the_same(live: LiveService, alone: dict[str, bytes]) -> None:
    def judge(_: int, status: int, __: object) -> str | None:
        return None if status == 200 else f"status {status}"

    with ConstantLoad(live.port, others(), judge, connections=24) as load:
        for _ in range(3):
            assert {path: ask(live, path) for path in REQUESTS} == alone
    load.tally.check()
