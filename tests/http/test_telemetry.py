"""Traces: the framework's spans on request, without text from clients.

Without the setting, the packages are not imported: test_without_torch.py.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span
from pydantic import ValidationError

from app.settings import Settings
from tests.services import http_server, launch

SCENE = {"objects": ["bed", "lamp"]}
MARKER = "xyzzy"
UNTRACED = ("/health/live", "/health/ready", "/v2/health/ready", "/metrics", "/static/icon.svg")


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

        def log_message(self, *_: Any) -> None:
            """Nothing."""

    with http_server(Handler) as url:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", url)
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_COMPRESSION", "none")
        yield taken


@pytest.mark.system
def test_a_request_is_a_span_named_by_its_route(
    shared_store: Path, tmp_path: Path, taken: list[ExportTraceServiceRequest]
) -> None:
    """Probes and scrapes are none, and what a client made up is in none."""
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
