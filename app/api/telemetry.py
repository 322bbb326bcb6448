"""Traces for OpenTelemetry: the framework's own spans, off unless an operator asks for them.

Traces alone: metrics are Prometheus' (`app/serving/metrics.py`), and log records would carry
messages of exceptions to another system.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from typing import Any, Final

from fastapi.telemetry import TelemetryConfig

from app import __version__

_SERVICE: Final = "scene-boltzmann"
# Asked every few seconds by machines: their spans would bury the others.
_UNTRACED: Final = ("/health", "/v2/health", "/metrics", "/static")
# The framework takes these over as the client sent them.
_MADE_UP: Final = ("url.path", "url.query", "http.request.method_original")
_REDACTED: Final = "REDACTED"


def configuration(*, enabled: bool) -> TelemetryConfig:
    """What `FastAPI` is told; off, it looks for no provider at all.

    Where spans go is said by OpenTelemetry's own variables (``OTEL_EXPORTER_OTLP_ENDPOINT`` and
    others); `Settings` has checked that the packages are there.
    """
    if not enabled:
        return TelemetryConfig(tracing=False, metrics=False, logs=False, auto_configure=False)
    # Not there unless the group `telemetry` is installed.
    from opentelemetry.context import Context
    from opentelemetry.sdk.resources import SERVICE_NAME, SERVICE_VERSION, Resource
    from opentelemetry.sdk.trace import Span, SpanProcessor, TracerProvider

    class Redaction(SpanProcessor):
        """Takes out of a span what a client may have made up; `http.route` says what was asked."""

        def on_start(self, span: Span, parent_context: Context | None = None) -> None:
            for name in _MADE_UP:
                if name in (span.attributes or {}):
                    span.set_attribute(name, _REDACTED)

    name = os.environ.get("OTEL_SERVICE_NAME", _SERVICE)
    resource = Resource.create({SERVICE_NAME: name, SERVICE_VERSION: __version__})
    provider = TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(Redaction())
    return TelemetryConfig(
        tracing=True,
        metrics=False,
        logs=False,
        # The exporter is made when the application starts, in the process that serves.
        auto_configure=True,
        tracer_provider=provider,
        exclude=_is_untraced,
    )


def _is_untraced(scope: MutableMapping[str, Any]) -> bool:
    path: str = scope["path"]
    return path.startswith(_UNTRACED)
