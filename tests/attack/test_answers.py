"""Small requests for huge answers: refused by name before the answer is built."""

from __future__ import annotations

import json
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.serving import answers
from scene_client.schemas import MAX_BATCH
from tests.http.stores import VOCABULARY
from tests.services import launch, serve

pytestmark = pytest.mark.anyio

LABELS = [entry.label for entry in VOCABULARY.objects if not entry.structure]
LIMIT = 16 * 2**20


def scene(objects: int, letter: str = "x", **parameters: Any) -> dict[str, Any]:
    """A scene whose ids have 128 characters."""
    ids = [f"{number}".rjust(128, letter) for number in range(objects)]
    things = [
        {"id": name, "label": label}
        for name, label in zip(ids, islice(cycle(LABELS), objects), strict=True)
    ]
    return {"objects": things, **parameters}


LARGEST = {"top_k": 4096, "include_opposites": True}
BATCH = {"scenes": [scene(23, **LARGEST)] * MAX_BATCH}


async def test_the_answer_to_a_batch_has_a_limit(client: httpx.AsyncClient) -> None:
    """It had 319 MB."""
    answer = await client.post("/relations/batch", json=BATCH)
    assert answer.status_code == 200
    assert len(answer.content) <= LIMIT
    results = answer.json()["results"]
    assert [entry["status"] for entry in results[:8]] == [200] * 8
    assert {entry["status"] for entry in results[16:]} == {422}
    problem = results[-1]["problem"]
    assert problem["type"] == "/problems/answer-too-large"
    assert problem["errors"][0]["pointer"] == f"#/scenes/{MAX_BATCH - 1}/top_k"
    assert "lower `top_k`" in problem["errors"][0]["message"]


async def test_a_batch_within_the_limit_is_answered_as_before(client: httpx.AsyncClient) -> None:
    batch = {"scenes": [scene(23)] * MAX_BATCH}
    answer = await client.post("/relations/batch", json=batch)
    assert {entry["status"] for entry in answer.json()["results"]} == {200}


async def test_the_largest_single_question_is_answered(client: httpx.AsyncClient) -> None:
    answer = await client.post("/relations", json=scene(256, **LARGEST))
    assert answer.status_code == 200
    assert len(answer.json()["relations"]) == 4096
    assert len(answer.content) < LIMIT


def crowd(objects: int, letter: str = "😀") -> dict[str, Any]:
    """Objects that all stand beside each other."""
    found = scene(objects, letter)
    for place, thing in enumerate(found["objects"]):
        thing["position"] = {"x": place % 16 * 0.02, "y": place // 16 * 0.02, "z": 0.0}
        thing["size"] = {"x": 0.5, "y": 0.5, "z": 0.01}
    return found


@pytest.mark.parametrize(
    ("question", "body", "parameter"),
    [
        ("relations", scene(256, "😀", **LARGEST), "top_k"),
        ("missing", crowd(64), "top_k"),
        ("outliers", scene(256, "😀"), "objects"),
        ("generate", scene(64, count=64), "count"),
    ],
)
async def test_single_answers_have_the_same_limit(
    shared_store: Path, question: str, body: dict[str, Any], parameter: str
) -> None:
    async with serve(shared_store, max_answer_bytes=2**16) as client:
        answer = await client.post(f"/{question}", json=body)
        assert answer.status_code == 422, len(answer.content)
        problem = answer.json()
        assert problem["type"] == "/problems/answer-too-large"
        assert problem["errors"][0]["pointer"] == f"#/{parameter}"
        assert len(answer.content) < 2**12


@pytest.mark.parametrize("question", ["relations", "missing", "outliers", "generate"])
@pytest.mark.parametrize("body", [scene(40), crowd(24), {"objects": LABELS}])
async def test_no_answer_is_larger_than_estimated(
    client: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch, question: str, body: dict[str, Any]
) -> None:
    sizes: list[int] = []

    def note(size: Any, reading: Any, *_: Any) -> None:
        sizes.append(answers.estimated_size(size, reading, reading.longest_name()))

    monkeypatch.setattr(answers, "require_size", note)
    for variant in ("", "plain", "deep"):
        asked = {**body, **({"model": variant} if variant else {}), "frame_id": "f" * 256}
        answer = await client.post(f"/{question}", json=asked)
        assert answer.status_code == 200, answer.text
        assert len(answer.content) <= sizes.pop()


@pytest.mark.slow
def test_memory_stays_bounded(shared_store: Path, tmp_path: Path) -> None:
    """It grew by 700 MB."""
    with launch(shared_store, tmp_path / "log") as service:
        service.client.post("/relations", json=scene(23, **LARGEST))
        before = peak(service.process.pid)
        body = json.dumps(BATCH).encode()
        headers = {"Content-Type": "application/json"}
        answer = service.client.post("/relations/batch", content=body, headers=headers)
        assert answer.status_code == 200
        assert peak(service.process.pid) - before < 150 * 2**20


def peak(pid: int) -> int:
    """The largest resident memory so far, in bytes."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024
