"""``GET /metrics`` and the access log."""

import asyncio
import json
import re
import shutil
import sys
import uuid
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest
from httpx import AsyncClient
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span
from prometheus_client.parser import text_string_to_metric_families
from pydantic import ValidationError

from app.registry import AliasTarget, Store
from app.settings import Settings
from tests.conftest import REPOSITORY
from tests.http.stores import publish
from tests.http.test_problems import problem
from tests.services import (
    PATIENCE,
    LiveService,
    Pause,
    Replace,
    defect,
    http_server,
    launch,
    load_changes,
    serve,
    wait_until,
)

SCENE = {"objects": ["bed", "lamp"]}
FINDINGS = {f"scene_{name}_total" for name in ("objects", "alarms", "unknown_labels", "warnings")}
OPERATIONS = (REPOSITORY / "docs" / "operations.md").read_text("utf-8")


def documented_metrics() -> dict[str, tuple[str, set[str], str]]:
    """The kind, labels and meaning of every metric, as the documentation lists them."""
    rows = re.findall(r"^\| `(scene_\w+)` \| (\w+) \|(.*?)\| (.+?) \|$", OPERATIONS, re.MULTILINE)
    label = re.compile(r"`(\w+)`")
    listed = {name: (kind, set(label.findall(labels)), text) for name, kind, labels, text in rows}
    assert len(listed) == len(rows)
    return listed


async def samples(client: AsyncClient) -> dict[tuple[str, ...], float]:
    """(name, label values in the order of their names) → value."""
    response = await client.get("/metrics")
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    return {
        (sample.name, *(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


def requests(found: dict[tuple[str, ...], float]) -> dict[tuple[str, ...], float]:
    """(outcome, route) → count, without those for the metrics themselves."""
    return {
        key[1:]: value
        for key, value in found.items()
        if key[0] == "scene_requests_total" and key[2] != "/metrics"
    }


async def test_requests_are_counted_by_route(shared_store: Path, replace: Replace) -> None:
    version = "/models/{name}/versions/{version}"
    sent: list[tuple[str, str, Any, str, str]] = [
        ("POST", "/outliers", SCENE, "internal-error", "/outliers"),
        ("POST", "/missing", SCENE, "success", "/missing"),
        ("POST", "/missing", SCENE, "success", "/missing"),
        ("POST", "/missing", {"objects": ["nosuchthing"]}, "unknown-labels", "/missing"),
        ("POST", "/missing", {"objects": [float("nan")]}, "not-json", "/missing"),
        # The service refuses this body before it looks for a route.
        ("POST", "/missing", "x" * 2**21, "body-too-large", "-"),
        ("POST", "/missing", SCENE | {"model": "secret-name"}, "model-not-found", "/missing"),
        ("GET", "/models/secret-name/versions/9", None, "model-not-found", version),
        ("GET", "/models/home/versions/1.0.0", None, "success", version),
        ("GET", "/static/icon.svg", None, "success", "-"),
        ("GET", "/static/nothing", None, "not-found", "-"),
        ("GET", "/no/such/address", None, "not-found", "-"),
        ("MADEUP", "/missing", None, "method-not-allowed", "/missing"),
        ("MADEUP-TOO", "/made-up", None, "not-found", "-"),
    ]
    headers = {"Content-Type": "application/json"}
    async with serve(shared_store) as client:
        replace("outliers", defect)
        for method, path, body, *_ in sent:
            content = None if body is None else json.dumps(body)
            await client.request(method, path, content=content, headers=headers)
        found = await samples(client)
    assert requests(found) == Counter((outcome, route) for *_, outcome, route in sent)
    assert found["scene_request_duration_seconds_count", "/missing"] == 6
    # Unknown paths, methods and models add no metrics.
    made_up = {"secret-name", "MADEUP", "MADEUP-TOO", "/made-up", "/no/such/address"}
    assert not made_up & {part for key in found for part in key}


async def test_alarms_unknown_labels_and_warnings_are_counted(tmp_path: Path) -> None:
    publish(tmp_path, "home", "1.0.0", alias="default")
    publish(tmp_path, "unsure", "1.0.0", calibration={})
    labels = ["sofa", "nightstand", "nigthstand", "toilet", "bed lamp", "flux capacitor"]
    relations = [{"subject": "sofa", "relation": "front", "object": "nightstand"}]
    scene = {"objects": labels, "relations": relations, "unknown_labels": "nearest-or-ignore"}
    async with serve(tmp_path) as client:

        async def ask(path: str, body: dict[str, Any]) -> dict[str, Any]:
            answer = await client.post(path, json=body)
            assert answer.status_code == 200
            return answer.json()

        alarming = scene | {"threshold": 0.0, "sensitivity": "high"}
        batch = await ask("/outliers/batch", {"scenes": [alarming, {"objects": ["nonsense"]}]})
        answers = [batch["results"][0]["result"], await ask("/outliers", alarming)]
        await ask("/rooms", scene)
        unsure = await ask("/outliers", {"objects": ["bed"], "model": "unsure"})
        found = await samples(client)
    alarms = {
        "outlier": sum(entry["is_outlier"] for one in answers for entry in one["outliers"]),
        "misplaced": sum(entry["is_misplaced"] for one in answers for entry in one["misplaced"]),
    }
    assert all(alarms.values())
    assert [warning["code"] for warning in unsure["warnings"]] == ["not-judged"]
    counted = {key: value for key, value in found.items() if value and key[0] in FINDINGS}
    assert counted == {
        ("scene_objects_total", "home", "outliers", "1.0.0"): 12,
        ("scene_objects_total", "home", "rooms", "1.0.0"): 6,
        ("scene_objects_total", "unsure", "outliers", "1.0.0"): 1,
        **{("scene_alarms_total", kind, "home", "1.0.0"): n for kind, n in alarms.items()},
        ("scene_unknown_labels_total", "home", "ignored", "1.0.0"): 3,
        ("scene_unknown_labels_total", "home", "guessed", "1.0.0"): 6,
        ("scene_warnings_total", "not-judged", "unsure", "1.0.0"): 1,
    }
    # Prometheus needs the zero before the first alarm.
    assert found["scene_alarms_total", "misplaced", "unsure", "1.0.0"] == 0


async def test_metrics_can_be_switched_off(shared_store: Path) -> None:
    async with serve(shared_store, metrics=False, request_timeout_ms=60_000) as client:
        assert (await client.post("/missing", json=SCENE)).status_code == 200
        problem(await client.get("/metrics"), 404, "not-found")
        assert "/metrics" not in (await client.get("/openapi.json")).json()["paths"]


async def test_model_info_has_every_alias(own: AsyncClient, store: Path) -> None:
    Store(store).set_alias("night", AliasTarget(name="home"))
    await load_changes(own)
    infos = {key[1:] for key in await samples(own) if key[0] == "scene_model_info"}
    expected = set()
    for alias, name, variant, version in (
        ("default", "home", "triway", "1.0.0"),
        ("candidate", "home", "triway", "1.1.0"),
        ("night", "home", "triway", "1.1.0"),
        ("", "plain", "rbm", "1.0.0"),
        ("", "general", "gbm", "0.1.0"),
    ):
        listed = (await own.get(f"/models/{name}/versions/{version}")).json()
        expected.add((alias, listed["digest"], name, variant, version))
    assert infos == expected


async def test_removed_models_have_no_metrics(own: AsyncClient, store: Path, pause: Pause) -> None:

    async def names(of: str) -> set[str]:
        return {key[0] for key in await samples(own) if of in key}

    async def ask(model: str, objects: int = 2) -> int:
        body = {"objects": ["bed"] * objects, "model": model}
        return (await own.post("/missing", json=body)).status_code

    assert await ask("plain") == await ask("home@1.0.0") == 200
    everything = await names("home")
    assert {"scene_objects_total", "scene_alarms_total", "scene_model_info"} <= everything
    assert await names("plain") == everything
    # A request that still holds the old snapshot reports late.
    served = own.app.state.runtime.models.served  # type: ignore[attr-defined]
    paused = pause("missing", lambda model: model is served["plain", "1.0.0"].model)
    late = asyncio.ensure_future(ask("plain", 33))  # on a thread
    assert await asyncio.to_thread(paused.started.wait, PATIENCE)
    shutil.rmtree(store / "plain")
    await load_changes(own)
    assert await names("plain") == set()
    assert await names("home") == everything
    paused.release.set()
    assert await late == 200
    assert await names("plain") == set()
    publish(store, "plain", "1.0.0", variant="rbm")
    await load_changes(own)
    assert await ask("plain") == 200
    assert (await samples(own))["scene_objects_total", "plain", "missing", "1.0.0"] == 2


@pytest.mark.system
def test_the_documentation_lists_every_metric(live: LiveService) -> None:
    live.client.post("/missing/batch", json={"scenes": [SCENE]})
    live.client.get("/models")
    text = live.client.get("/metrics").text
    metrics = {}
    for family in text_string_to_metric_families(text):
        name = family.name + ("_total" if family.type == "counter" else "")
        labels = {label for sample in family.samples for label in sample.labels} - {"le"}
        metrics[name] = (family.type, labels, family.documentation)
    assert documented_metrics() == metrics
    explained = re.findall(r"^\| (`.+?) \|", OPERATIONS, re.MULTILINE)
    assert {label for _, labels, _ in metrics.values() for label in labels} <= set(
        re.findall(r"`(\w+)`", " ".join(explained))
    )


def line(service: LiveService, method: str, path: str, **arguments: Any) -> dict[str, Any]:
    """Send a request, and return its line of the log."""
    identity = uuid.uuid4().hex
    service.client.request(method, path, headers={"X-Request-Id": identity}, **arguments)
    # The service writes the line after the answer.
    wait_until(lambda: f'"{identity}"' in service.log.read_text(), service.log)
    lines = map(json.loads, service.log.read_text().splitlines())
    (entry,) = (entry for entry in lines if entry.get("request_id") == identity)
    assert entry.pop("process") == service.process.pid
    for name in ("time", "message", "request_id"):
        assert entry.pop(name)
    return entry


@pytest.mark.system
def test_a_request_is_one_line(live: LiveService) -> None:
    answered = line(live, "POST", "/missing", json=SCENE)
    assert answered.pop("latency_ms") >= answered.pop("compute_ms") > 0
    assert answered.pop("queue_ms") >= 0
    common = {"level": "info", "logger": "app.access"}
    expected = {"method": "POST", "route": "/missing", "status": 200, "outcome": "success"}
    assert answered == common | expected | {"model": "home", "version": "1.0.0"}
    refused = line(live, "GET", "/nowhere?key=secret")
    assert refused.pop("latency_ms") > 0
    expected = {"method": "GET", "route": "-", "status": 404, "outcome": "not-found"}
    assert refused == common | expected


MARKER = "xyzzy"
UNTRACED = ("/health/live", "/health/ready", "/metrics", "/static/icon.svg")


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[ExportTraceServiceRequest]]:
    """What a collector of traces has taken, which the environment names."""
    taken: list[ExportTraceServiceRequest] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            assert self.path == "/v1/traces"
            taken.append(ExportTraceServiceRequest.FromString(body))
            self.send_response(200)
            self.end_headers()

    with http_server(Handler) as url:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", url)
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_COMPRESSION", "none")
        yield taken


@pytest.mark.system
def test_spans_have_names_of_routes(shared_store, tmp_path, taken):
    with launch(shared_store, tmp_path / "log", SCENE_OPENTELEMETRY="true") as service:
        service.client.post("/missing", json=SCENE)
        for path in UNTRACED:
            service.client.get(path)
        service.client.get(f"/models/{MARKER}?key={MARKER}")
    # What has not been sent yet is sent before the service ends.
    assert "opentelemetry" not in service.log.read_text()
    resources = [part for request in taken for part in request.resource_spans]
    spans = [span for part in resources for scope in part.scope_spans for span in scope.spans]
    spans = [span for span in spans if span.kind == Span.SPAN_KIND_SERVER]
    assert [span.name for span in spans] == ["POST /missing", "GET /models/{name}"]
    attributes = {entry.key: entry.value for entry in spans[1].attributes}
    assert attributes["http.response.status_code"].int_value == 404
    resource = {entry.key: entry.value for entry in resources[0].resource.attributes}
    assert resource["service.name"].string_value == "scene-boltzmann"
    assert MARKER not in str(taken)


def test_missing_packages_are_named(shared_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4318")
    assert Settings(store=shared_store, opentelemetry=True).opentelemetry
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http", None)
    with pytest.raises(ValidationError, match=r"SCENE_OPENTELEMETRY needs .*\.\[telemetry\]"):
        Settings(store=shared_store, opentelemetry=True)
    assert not Settings(store=shared_store).opentelemetry
