"""``GET /metrics`` and the access log: what the service tells of itself, and what it keeps."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from app.api import examples
from app.serving.logs import JSONFormatter
from tests.http.stores import corrupt, publish
from tests.http.test_problems import problem
from tests.services import serve

pytestmark = pytest.mark.anyio

SCENE = {"objects": ["bed", "lamp"]}


async def told(client: httpx.AsyncClient) -> dict[tuple[str, ...], float]:
    """(name, label values in the order of their names) → value."""
    response = await client.get("/metrics")
    assert response.status_code == 200
    return {
        (sample.name, *(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


def requests(found: dict[tuple[str, ...], float]) -> dict[tuple[str, ...], float]:
    """(method, outcome, route) → count, without those for the metrics themselves."""
    return {
        key[1:]: value
        for key, value in found.items()
        if key[0] == "scene_requests_total" and key[3] != "/metrics"
    }


async def test_the_text_is_what_prometheus_reads(client: httpx.AsyncClient) -> None:
    response = await client.get("/metrics")
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    families = {family.name: family for family in text_string_to_metric_families(response.text)}
    assert {f"scene_{kind}_duration_seconds" for kind in ("request", "queue", "compute")} <= set(
        families
    )
    assert all(family.documentation for family in families.values())


async def test_the_documented_example_is_of_this_service(shared_store: Path) -> None:
    example = examples.ANSWERS["show_metrics"]
    assert isinstance(example, str)
    async with serve(shared_store) as client:
        await client.post("/missing", json=SCENE)
        await client.post("/missing", json={"objects": ["nosuchthing"]})
        text = (await client.get("/metrics")).text
    # Line by line the same, but for the counts.
    for line in example.splitlines():
        assert line.rpartition(" ")[0] in text if line[0] != "#" else line in text


async def test_requests_are_told_by_template_method_and_outcome(shared_store: Path) -> None:
    async with serve(shared_store) as client:
        await client.post("/missing", json=SCENE)
        await client.post("/missing", json=SCENE)
        await client.post("/missing", json={"objects": ["nosuchthing"]})
        await client.post("/missing", content=b"{", headers={"Content-Type": "application/json"})
        await client.post("/missing", content=b" " * (2**21 + 1))
        await client.get("/models/secret-name/versions/9")
        await client.get("/models/home/versions/1.0.0")
        await client.get("/static/icon.svg")
        await client.get("/static/nothing")
        await client.get("/no/such/address")
        await client.post("/models/refresh")
        await client.request("MADEUP", "/missing")
        await client.request("MADEUP-TOO", "/made-up")
        found = await told(client)
    version = "/models/{name}/versions/{version}"
    assert requests(found) == {
        ("POST", "success", "/missing"): 2,
        ("POST", "unknown-labels", "/missing"): 1,
        ("POST", "not-json", "/missing"): 1,
        # Refused before any route was looked for.
        ("POST", "body-too-large", "-"): 1,
        ("GET", "model-not-found", version): 1,
        ("GET", "success", version): 1,
        ("GET", "success", "-"): 1,
        ("GET", "not-found", "-"): 2,
        ("POST", "unauthorized", "/models/refresh"): 1,
        ("-", "method-not-allowed", "/missing"): 1,
        ("-", "not-found", "-"): 1,
    }
    assert found["scene_request_duration_seconds_count", "/missing"] == 5


async def test_addresses_and_methods_that_are_made_up_add_no_series(
    client: httpx.AsyncClient,
) -> None:
    async def ask(number: int) -> None:
        await client.get(f"/nowhere/{number}")
        await client.get(f"/models/m{number}")
        await client.get(f"/problems/p{number}")
        await client.get(f"/static/s{number}")
        await client.request(f"METHOD{number}", f"/models/m{number}")
        await client.post("/missing", json={**SCENE, "model": f"m{number}"})

    await ask(0)
    before = set(await told(client))
    for number in range(1, 20):
        await ask(number)
    assert set(await told(client)) == before


async def test_a_defect_is_told(shared_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("broken")

    async with serve(shared_store) as client:
        monkeypatch.setattr("app.questions.missing", fail)
        problem(await client.post("/missing", json=SCENE), 500, "internal-error")
        found = await told(client)
    assert requests(found) == {("POST", "internal-error", "/missing"): 1}


async def test_work_is_told_by_model_and_question(shared_store: Path) -> None:
    async with serve(shared_store) as client:
        for path in ("relations", "missing", "outliers", "generate"):
            body = {**SCENE, "model": "plain", "seed": 1} | (
                {"steps": 1} if path == "generate" else {}
            )
            assert (await client.post(f"/{path}", json=body)).status_code == 200
        batch = {"scenes": [SCENE, {"objects": ["nosuchthing"]}, SCENE]}
        assert (await client.post("/missing/batch", json=batch)).status_code == 200
        found = await told(client)
    for question in ("relations", "missing", "outliers", "generate"):
        label = ("plain", question, "1.0.0")
        assert found["scene_compute_duration_seconds_count", *label] == 1
        assert found["scene_compute_duration_seconds_sum", *label] > 0
        assert found["scene_batch_rows_sum", *label] == 1
    assert found["scene_compute_duration_seconds_count", "home", "missing", "1.0.0"] == 2
    assert found["scene_batch_entries_total", "success", "missing"] == 2
    assert found["scene_batch_entries_total", "unknown-labels", "missing"] == 1
    assert found["scene_serialisation_duration_seconds_count",] == 5
    assert found["scene_serialisation_duration_seconds_sum",] > 0


async def test_reloads_are_told_with_refused_ones(store: Path, admin: dict[str, str]) -> None:
    async with serve(store) as client:

        async def refresh() -> int:
            return (await client.post("/models/refresh", headers=admin)).status_code

        async def move(model: str) -> int:
            url = "/models/aliases/default"
            return (await client.put(url, json={"model": model}, headers=admin)).status_code

        assert await refresh() == 200
        assert await move("home@1.1.0") == 200
        assert await move("home@7.0.0") == 404
        publish(store, "home", "2.0.0", seed=2)
        corrupt(store, "home", "2.0.0")
        assert await refresh() == 409
        found = await told(client)
        led = [key[5] for key in found if key[:2] == ("scene_model_info", "default")]
    assert led == ["1.1.0"]
    assert {key[1:]: n for key, n in found.items() if key[0] == "scene_reloads_total"} == {
        ("poll", "success"): 0,
        ("poll", "refused"): 0,
        ("poll", "failed"): 0,
        ("refresh", "success"): 1,
        ("refresh", "refused"): 1,
        ("refresh", "failed"): 0,
        ("alias", "success"): 1,
        ("alias", "refused"): 1,
        ("alias", "failed"): 0,
    }
    assert found["scene_ready_time_seconds",] >= found["scene_start_time_seconds",] > 0


async def test_metrics_can_be_switched_off(shared_store: Path) -> None:
    async with serve(shared_store, metrics=False) as client:
        assert (await client.post("/missing", json=SCENE)).status_code == 200
        problem(await client.get("/metrics"), 404, "not-found")
        assert "/metrics" not in (await client.get("/openapi.json")).json()["paths"]


# ------------------------------------------------------------------------------------ logs


def lines(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    return [
        json.loads(JSONFormatter().format(record))
        for record in caplog.records
        if record.name == "app.access"
    ]


async def test_a_request_is_one_line(
    client: httpx.AsyncClient, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "app.access"):
        await client.post("/missing", json=SCENE, headers={"X-Request-Id": "one"})
        await client.get("/nowhere?key=secret")
    first, second = lines(caplog)
    assert first.pop("latency_ms") >= first.pop("compute_ms") > 0
    assert first.pop("queue_ms") >= 0
    for line in (first, second):
        assert line.pop("process") == os.getpid()
        assert line.pop("time")
        assert line.pop("message")
    assert first == {
        "level": "info",
        "logger": "app.access",
        "request_id": "one",
        "method": "POST",
        "route": "/missing",
        "status": 200,
        "outcome": "success",
        "model": "home",
        "version": "1.0.0",
    }
    assert (second["route"], second["status"], second["outcome"]) == ("-", 404, "not-found")
    assert not {"model", "version", "compute_ms", "queue_ms"} & set(second)


async def test_a_batch_over_several_models_names_none(
    client: httpx.AsyncClient, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "app.access"):
        for models in (["default", "home@1.0.0"], ["default", "plain"]):
            scenes = [{**SCENE, "model": model} for model in models]
            await client.post("/missing/batch", json={"scenes": scenes})
    same, several = lines(caplog)
    assert same["model"] == "home"
    assert "model" not in several
    assert several["compute_ms"] > 0


async def test_lines_hold_nothing_a_client_made_up(
    client: httpx.AsyncClient, caplog: pytest.LogCaptureFixture
) -> None:
    marker = "XYZZY"
    with caplog.at_level(logging.DEBUG):
        await client.post(
            f"/missing?a={marker}",
            json={"objects": [marker], "model": marker},
            headers={"X-Admin-Key": marker, "X-Request-Id": f"{marker} no id", "Cookie": marker},
        )
        await client.request(marker, f"/{marker}")
    assert len(lines(caplog)) == 2
    assert marker not in json.dumps(lines(caplog))
