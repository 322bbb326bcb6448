"""Liveness, readiness (the default model has answered in the warm-up) and metrics."""

from functools import partial

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4 as CONTENT_TYPE

from app import __version__
from app.api.models import RuntimeDep
from app.api.openapi import error_responses
from scene_client import schemas

router = APIRouter(tags=["health"])
monitoring = APIRouter(tags=["monitoring"])
_get = partial(router.get, response_model_exclude_none=True)
# Load balancers may check health with HEAD. OpenAPI describes only GET.
_head = partial(router.head, include_in_schema=False, response_model_exclude_none=True)

# Maximum number of failures in an answer, because load balancers ask often and without a key.
_FAILURES = 10


@_head("/health/live")
@_get("/health/live", summary="Is the process alive?", responses=error_responses())
async def health_live() -> schemas.Health:
    """Return status 200 while the process runs, even if the models are not usable."""
    return schemas.Health(status="live", version=__version__)


@_head("/health/ready")
@_get(
    "/health/ready", summary="Does a default model answer?", responses=error_responses("readiness")
)
async def health_ready(runtime: RuntimeDep) -> schemas.Health:
    """Return status 200 if a model answers for the alias `default`, else status 503.

    If the version at which the alias points is not usable, the newest usable version of its model
    answers. The answer lists refused versions and unusable aliases with their reasons.
    """
    runtime.check_ready()
    failures = list(runtime.models.failures.values())[:_FAILURES]
    return schemas.Health(status="ready", failures=failures or None)


@monitoring.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=PlainTextResponse,
    responses=error_responses(),
)
async def show_metrics(runtime: RuntimeDep) -> PlainTextResponse:
    """Return counters, gauges and histograms in the text format of Prometheus.

    docs/operations.md explains each metric.
    """
    return PlainTextResponse(await runtime.metrics.exposition(), media_type=CONTENT_TYPE)
