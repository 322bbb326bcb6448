"""OpenTelemetry traces. FastAPI creates the spans. Traces are off by default.

Prometheus reads the metrics (`app/serving/metrics.py`). The service does not send log records,
because these contain exception messages.
"""

import os
from typing import Final

from fastapi.telemetry import TelemetryConfig

from app import __version__

# Orchestrators and Prometheus poll these paths every few seconds, and pages load static files.
# So spans of these requests would be more numerous than all other spans.
_UNTRACED: Final = ("/health", "/metrics", "/static")
# FastAPI copies these span attributes from the request, so they may contain private data.
_REDACTED: Final = ("url.path", "url.query", "http.request.method_original")


def configuration(*, enabled: bool) -> TelemetryConfig:
    """Return the telemetry configuration for `FastAPI`. `Settings` has checked the packages."""
    if not enabled:
        return TelemetryConfig(tracing=False, metrics=False, logs=False, auto_configure=False)
    from opentelemetry.context import Context
    from opentelemetry.sdk.resources import SERVICE_VERSION, Resource
    from opentelemetry.sdk.trace import Span, SpanProcessor, TracerProvider

    class Redaction(SpanProcessor):
        """Redact the span attributes that contain text from the client."""

        def on_start(self, span: Span, parent_context: Context | None = None) -> None:
            for name in _REDACTED:
                if name in (span.attributes or {}):
                    span.set_attribute(name, "REDACTED")

    os.environ.setdefault("OTEL_SERVICE_NAME", "scene-boltzmann")
    resource = Resource.create({SERVICE_VERSION: __version__})
    provider = TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(Redaction())
    return TelemetryConfig(
        tracing=True,
        metrics=False,
        logs=False,
        # With True, FastAPI starts the exporter together with the application.
        auto_configure=True,
        tracer_provider=provider,
        exclude=lambda scope: str(scope["path"]).startswith(_UNTRACED),
    )
