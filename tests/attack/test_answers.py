"""Small requests for huge answers: refused by name before the answer is built."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from itertools import cycle, islice
from typing import Any

import httpx
import pytest

from scene_client.schemas import MAX_BATCH
from tests.http.stores import VOCABULARY
from tests.http.test_problems import problem
from tests.services import client_of_service

LABELS = [entry.label for entry in VOCABULARY.objects if not entry.structure]
LIMIT = 4 * 2**20
SMALL = 2**16


limited = client_of_service(max_answer_bytes=SMALL)


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
    assert [entry["status"] for entry in results[:2]] == [200] * 2
    assert {entry["status"] for entry in results[4:]} == {422}
    last = results[-1]["problem"]
    assert last["type"] == "/problems/answer-too-large"
    assert last["errors"][0]["pointer"] == f"#/scenes/{MAX_BATCH - 1}/top_k"
    assert "Lower `top_k`" in last["errors"][0]["message"]


def crowd(objects: int, letter: str = "😀") -> dict[str, Any]:
    """Objects that all stand beside each other."""
    found = scene(objects, letter)
    for place, thing in enumerate(found["objects"]):
        thing["position"] = {"x": place % 16 * 0.02, "y": place // 16 * 0.02, "z": 0.0}
        thing["size"] = {"x": 0.5, "y": 0.5, "z": 0.01}
    return found


@pytest.mark.parametrize(
    ("question", "letter", "options", "parameter"),
    [
        ("relations", "😀", LARGEST, "top_k"),
        ("missing", "😀", {}, "top_k"),
        ("outliers", "😀", {}, "objects"),
        ("outliers", "x", {"frame_id": "f" * 256}, "objects"),
    ],
)
async def test_single_answers_have_the_same_limit(
    limited: httpx.AsyncClient,
    question: str,
    letter: str,
    options: dict[str, Any],
    parameter: str,
) -> None:
    """Whatever it is made of: the largest scene that is answered has an answer within the limit."""

    async def ask(objects: int) -> httpx.Response:
        return await limited.post(f"/{question}", json=crowd(objects, letter) | options)

    await check_the_largest(ask, 128, parameter)


async def test_drawn_scenes_have_the_same_limit(limited: httpx.AsyncClient) -> None:
    async def ask(count: int) -> httpx.Response:
        body = {"objects": LABELS[:8], "count": count, "steps": 2, "seed": 0}
        return await limited.post("/generate", json=body)

    await check_the_largest(ask, 64, "count")


async def check_the_largest(
    ask: Callable[[int], Awaitable[httpx.Response]], refused: int, parameter: str
) -> None:
    """Of a size that is answered has an answer within the limit, and not far below it."""
    document = problem(await ask(refused), 422, "answer-too-large")
    assert document["errors"][0]["pointer"] == f"#/{parameter}"
    answered, largest = 1, await ask(1)
    while refused - answered > 1:
        middle = (answered + refused) // 2
        answer = await ask(middle)
        if answer.is_success:
            answered, largest = middle, answer
        else:
            problem(answer, 422, "answer-too-large")
            assert len(answer.content) < 2**12
            refused = middle
    assert largest.is_success
    assert SMALL / 8 < len(largest.content) <= SMALL
