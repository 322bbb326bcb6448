"""Batches: one entry a scene, in order, each as if it had come alone."""

from __future__ import annotations

import math
from typing import Any

import httpx
import pytest

from app.questions import QUESTIONS
from tests.services import Replace, defect

ENTRIES: list[Any] = [
    {"objects": ["bed", "lamp"]},
    {"objects": ["bed", "droid"]},
    "no scene at all",
    {"objects": ["bed", {"label": "lamp", "confidence": 3}]},
    {"objects": ["bed", "lamp"], "model": "nobody"},
    {"objects": []},
    {"objects": ["bed", "chair"], "model": "plain"},
]
NAMES = [question.name for question in QUESTIONS if not question.samples]


@pytest.mark.parametrize("question", NAMES)
async def test_every_entry_gets_the_result_or_problem_of_a_single_request(
    client: httpx.AsyncClient, question: str
) -> None:
    headers = {"X-Request-Id": "one"}
    response = await client.post(f"/{question}/batch", json={"scenes": ENTRIES}, headers=headers)
    assert response.status_code == 200
    answer = response.json()
    assert answer["request_id"] == "one"
    assert [entry["status"] for entry in answer["results"]] == [200, 422, 422, 422, 404, 422, 200]
    for number, (entry, scene) in enumerate(zip(answer["results"], ENTRIES, strict=True)):
        alone = await client.post(f"/{question}", json=scene, headers=headers)
        expected = alone.json()
        for error in expected.get("errors", []):
            error["pointer"] = error["pointer"].replace("#", f"#/scenes/{number}")
        part = "result" if alone.is_success else "problem"
        assert entry == {"status": alone.status_code, part: expected}


@pytest.mark.parametrize("scenes", [[], [{"objects": ["bed"]}] * 257, {}, None])
async def test_a_batch_holds_1_to_256_scenes(client: httpx.AsyncClient, scenes: Any) -> None:
    response = await client.post("/relations/batch", json={"scenes": scenes})
    assert response.status_code == 422
    assert response.json()["errors"][0]["pointer"] == "#/scenes"


@pytest.mark.parametrize("fault", ["raised", math.nan])
async def test_a_defect_affects_one_entry(
    client: httpx.AsyncClient, replace: Replace, fault: Any
) -> None:
    def fail_on_sofas(outliers: Any, artifact: Any, scene: Any, **parameters: Any) -> Any:
        answer = outliers(artifact, scene, **parameters)
        if any(thing.label == "sofa" for thing in scene.objects):
            if fault == "raised":
                defect()
            answer["outliers"][0]["log_odds"] = fault
        return answer

    replace("outliers", fail_on_sofas)
    scenes = [{"objects": ["bed"]}, {"objects": ["sofa"]}, {"objects": ["lamp"]}]
    response = await client.post("/outliers/batch", json={"scenes": scenes})
    assert [entry["status"] for entry in response.json()["results"]] == [200, 500, 200]
    assert response.json()["results"][1]["problem"]["type"] == "/problems/internal-error"
    assert "secret" not in response.text
    assert (await client.post("/outliers", json=scenes[1])).status_code == 500


async def test_an_id_may_be_the_text_nan(client: httpx.AsyncClient) -> None:
    objects = [{"id": "NaN", "label": "bed"}, {"id": "-Infinity", "label": "lamp"}]
    answer = (await client.post("/outliers", json={"objects": objects})).json()
    assert {entry["object"] for entry in answer["outliers"]} == {"NaN", "-Infinity"}
