"""Batches: one entry a scene, in order, each as if it had come alone."""

from __future__ import annotations

import math
from typing import Any

import httpx
import pytest

from tests.services import Replace, defect

pytestmark = pytest.mark.anyio

ENTRIES: list[Any] = [
    {"objects": ["bed", "lamp"]},
    {"objects": ["bed", "droid"]},
    "no scene at all",
    {"objects": ["bed", {"label": "lamp", "confidence": 3}]},
    {"objects": ["bed", "lamp"], "model": "nobody"},
    {"objects": []},
    {"objects": ["bed", "chair"], "model": "plain"},
]
QUESTIONS = ["relations", "missing", "outliers"]


@pytest.mark.parametrize("question", QUESTIONS)
async def test_every_entry_gets_its_own_result_or_problem(
    client: httpx.AsyncClient, question: str
) -> None:
    response = await client.post(f"/{question}/batch", json={"scenes": ENTRIES})
    assert response.status_code == 200
    answer = response.json()
    assert answer["request_id"] == response.headers["x-request-id"]
    assert [entry["status"] for entry in answer["results"]] == [200, 422, 422, 422, 404, 422, 200]
    for entry in answer["results"]:
        assert ("result" in entry) == (entry["status"] == 200)
        assert ("problem" in entry) == (entry["status"] != 200)
    unknown = answer["results"][1]["problem"]
    assert unknown["type"] == "/problems/unknown-labels"
    assert unknown["errors"][0]["pointer"] == "#/scenes/1/objects/1"
    assert answer["results"][2]["problem"]["errors"][0]["pointer"] == "#/scenes/2"
    pointer = answer["results"][3]["problem"]["errors"][0]["pointer"]
    assert pointer == "#/scenes/3/objects/1/confidence"


@pytest.mark.parametrize("question", QUESTIONS)
async def test_results_are_those_of_single_requests(
    client: httpx.AsyncClient, question: str
) -> None:
    headers = {"X-Request-Id": "one"}
    batch = await client.post(f"/{question}/batch", json={"scenes": ENTRIES}, headers=headers)
    for entry, scene in zip(batch.json()["results"], ENTRIES, strict=True):
        alone = await client.post(f"/{question}", json=scene, headers=headers)
        assert alone.status_code == entry["status"]
        if entry["status"] == 200:
            assert alone.json() == entry["result"]
        else:
            assert alone.json()["type"] == entry["problem"]["type"]


@pytest.mark.parametrize("scenes", [[], [{"objects": ["bed"]}] * 257, {}, None])
async def test_a_batch_holds_1_to_256_scenes(client: httpx.AsyncClient, scenes: Any) -> None:
    response = await client.post("/relations/batch", json={"scenes": scenes})
    assert response.status_code == 422
    assert response.json()["errors"][0]["pointer"] == "#/scenes"


@pytest.mark.parametrize("fault", ["raised", math.nan])
async def test_a_defect_spoils_one_entry_only(
    client: httpx.AsyncClient, replace: Replace, fault: Any
) -> None:
    def fail_on_sofas(outliers: Any, artifact: Any, scene: Any, **parameters: Any) -> Any:
        found = outliers(artifact, scene, **parameters)
        if all(thing.label != "sofa" for thing in scene.objects):
            return found
        if fault == "raised":
            defect()
        first, *others = found.outliers
        return found._replace(outliers=(first._replace(log_odds=fault), *others))

    replace("outliers", fail_on_sofas)
    scenes = [{"objects": ["bed"]}, {"objects": ["sofa"]}, {"objects": ["lamp"]}]
    response = await client.post("/outliers/batch", json={"scenes": scenes})
    assert [entry["status"] for entry in response.json()["results"]] == [200, 500, 200]
    assert response.json()["results"][1]["problem"]["type"] == "/problems/internal-error"
    assert "secret" not in response.text
    assert (await client.post("/outliers", json=scenes[1])).status_code == 500


async def test_a_name_may_be_that_of_what_is_no_number(client: httpx.AsyncClient) -> None:
    objects = [{"id": "NaN", "label": "bed"}, {"id": "-Infinity", "label": "lamp"}]
    answer = (await client.post("/outliers", json={"objects": objects})).json()
    assert {entry["object"] for entry in answer["outliers"]} == {"NaN", "-Infinity"}
