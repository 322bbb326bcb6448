"""Traces: none by default, the framework's spans on request, and nothing a client made up in them.

The packages of the group `telemetry` belong to the development set, so a missing one is an error
here and never a skip.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from pydantic import ValidationError

from app.api import telemetry
from app.main import create_app
from app.settings import Settings
from tests.services import launch

SCENE = {"objects": ["bed", "lamp"]}
MARKER = "xyzzy"


@pytest.fixture
def exporter(monkeypatch: pytest.MonkeyPatch) -> InMemorySpanExporter:
    """Where the spans of every application go that is made while the test runs."""
    exporter = InMemorySpanExporter()
    configure = telemetry.configuration

    def configured(*, enabled: bool) -> Any:
        config = configure(enabled=enabled)
        provider = config.get("tracer_provider")
        if isinstance(provider, TracerProvider):
            provider.add_span_processor(SimpleSpanProcessor(exporter))
        return config

    monkeypatch.setattr(telemetry, "configuration", configured)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    return exporter


async def ask(settings: Settings, *requests: tuple[str, str]) -> None:
    app = create_app(settings)
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    # Without FastAPI's own lifespan, which would start the exporter to the address above.
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        for method, path in requests:
            await client.request(method, path, json=SCENE)


def served(exporter: InMemorySpanExporter) -> list[ReadableSpan]:
    return [span for span in exporter.get_finished_spans() if span.kind.name == "SERVER"]


@pytest.mark.anyio
async def test_there_are_no_spans_by_default(
    shared_store: Path, exporter: InMemorySpanExporter
) -> None:
    await ask(Settings(store=shared_store), ("POST", "/missing"))
    assert exporter.get_finished_spans() == ()


@pytest.mark.anyio
async def test_a_request_is_a_span_named_by_its_route(
    shared_store: Path, exporter: InMemorySpanExporter
) -> None:
    settings = Settings(store=shared_store, opentelemetry=True)
    await ask(settings, ("POST", "/missing"), ("GET", f"/models/{MARKER}?key={MARKER}"))
    first, second = served(exporter)
    assert (first.name, second.name) == ("POST /missing", "GET /models/{name}")
    assert first.resource.attributes["service.name"] == "scene-boltzmann"
    assert dict(second.attributes or {})["http.response.status_code"] == 404
    children = {
        span.name
        for span in exporter.get_finished_spans()
        if span.parent and first.context and span.parent.span_id == first.context.span_id
    }
    # The questions are not resolved by the framework, so it has no spans of their parts.
    assert children == set()
    assert MARKER not in "".join(span.to_json() for span in exporter.get_finished_spans())


@pytest.mark.anyio
async def test_probes_and_scrapes_are_not_traced(
    shared_store: Path, exporter: InMemorySpanExporter
) -> None:
    settings = Settings(store=shared_store, opentelemetry=True)
    paths = ("/health/live", "/health/ready", "/v2/health/ready", "/metrics", "/static/icon.svg")
    await ask(settings, *(("GET", path) for path in paths), ("GET", "/models"))
    assert [span.name for span in served(exporter)] == ["GET /models"]


@pytest.mark.parametrize(
    "module", ["opentelemetry.sdk.trace", "opentelemetry.exporter.otlp.proto.http"]
)
def test_missing_packages_are_named(
    shared_store: Path, monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4318")
    assert Settings(store=shared_store, opentelemetry=True).opentelemetry
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValidationError, match=r"SCENE_OPENTELEMETRY needs .*\.\[telemetry\]"):
        Settings(store=shared_store, opentelemetry=True)
    assert not Settings(store=shared_store).opentelemetry


def test_nowhere_to_send_is_refused(shared_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OTEL_EXPORTER_OTLP_ENDPOINT", raising=False)
    with pytest.raises(ValidationError, match=r"SCENE_OPENTELEMETRY needs OTEL_EXPORTER_OTLP"):
        Settings(store=shared_store, opentelemetry=True)


# ------------------------------------------------------------------------- a live collector


@contextmanager
def collector() -> Iterator[tuple[str, list[ExportTraceServiceRequest]]]:
    """A server that takes traces as a collector does, and what it has taken."""
    taken: list[ExportTraceServiceRequest] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            assert self.path == "/v1/traces"
            taken.append(ExportTraceServiceRequest.FromString(body))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", taken
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.slow
@pytest.mark.system
def test_a_collector_is_sent_the_spans(shared_store: Path, tmp_path: Path) -> None:
    with (
        collector() as (url, taken),
        launch(
            shared_store,
            tmp_path / "log",
            SCENE_OPENTELEMETRY="true",
            OTEL_EXPORTER_OTLP_ENDPOINT=url,
            OTEL_EXPORTER_OTLP_COMPRESSION="none",
        ) as service,
    ):
        # What has not been sent yet is sent before the process ends.
        assert service.client.post("/missing", json=SCENE).status_code == 200
    spans = [
        span.name
        for request in taken
        for of_resource in request.resource_spans
        for of_scope in of_resource.scope_spans
        for span in of_scope.spans
    ]
    assert spans.count("POST /missing") == 1
    assert not any("health" in name for name in spans)
    assert "opentelemetry" not in service.log.read_text()
