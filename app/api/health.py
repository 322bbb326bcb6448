"""Liveness and readiness, on `/health` routes and on the routes of the Open Inference Protocol.

The process is live if it answers a request. The process is ready if its default model has answered
a question during the warm-up. The module also has the route of the metrics.
"""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse

from app import __version__
from app.api.models import Reference, RuntimeDep
from app.api.openapi import error_responses
from app.serving.metrics import CONTENT_TYPE
from scene_client import schemas

router = APIRouter(tags=["health"])
protocol = APIRouter(prefix="/v2", tags=["inference protocol"])
monitoring = APIRouter(tags=["monitoring"])

# Maximum number of failures in an answer, because load balancers ask often and without a key.
_FAILURES = 10

_READINESS_ERRORS = error_responses("readiness")
_LOADED_ERRORS = error_responses("admission", "models", "name", "model")


# Load balancers may check health with HEAD. OpenAPI describes only GET.
@router.head("/health/live", include_in_schema=False, response_model_exclude_none=True)
@router.get(
    "/health/live",
    summary="Is the process alive?",
    responses=error_responses(),
    response_model_exclude_none=True,
)
async def health_live() -> schemas.Health:
    """Return status 200 while the process runs, even if the models are not usable."""
    return schemas.Health(status="live")


@router.head("/health/ready", include_in_schema=False, response_model_exclude_none=True)
@router.get(
    "/health/ready",
    summary="Is the default model usable?",
    responses=_READINESS_ERRORS,
    response_model_exclude_none=True,
)
async def health_ready(runtime: RuntimeDep) -> schemas.Health:
    """Return status 200 if the default model is usable, else status 503.

    The answer lists refused versions and unusable aliases with their reasons.
    """
    runtime.check_ready()
    failures = list(runtime.models.failures.values())[:_FAILURES]
    return schemas.Health(status="ready", failures=failures or None)


@protocol.get("", summary="Server metadata", responses=error_responses("admission"))
async def server_metadata() -> schemas.ServerMetadata:
    """Return the name and the version of the server."""
    return schemas.ServerMetadata(name="scene-boltzmann", version=__version__, extensions=[])


@protocol.head("/health/live", include_in_schema=False)
@protocol.get("/health/live", summary="Is the process alive?", responses=error_responses())
async def server_live() -> schemas.ServerLive:
    """Run the same check as `GET /health/live`."""
    return schemas.ServerLive(live=True)


@protocol.head("/health/ready", include_in_schema=False)
@protocol.get("/health/ready", summary="Is the default model usable?", responses=_READINESS_ERRORS)
async def server_ready(runtime: RuntimeDep) -> schemas.ServerReady:
    """Run the same check as `GET /health/ready`."""
    runtime.check_ready()
    return schemas.ServerReady(ready=True)


@protocol.get("/models/{name}", summary="Model metadata", responses=_LOADED_ERRORS)
async def model_metadata(name: Reference, runtime: RuntimeDep) -> schemas.ModelMetadata:
    """Return versions and variant of a model, named by an alias, `name` or `name@version`."""
    models = runtime.models
    reference = models.resolve(name).reference
    return schemas.ModelMetadata(
        name=reference.name,
        versions=list(models.store.versions[reference.name]),
        platform=f"numpy_{reference.variant}",
    )


@protocol.head("/models/{name}/ready", include_in_schema=False)
@protocol.get("/models/{name}/ready", summary="Is this model usable?", responses=_LOADED_ERRORS)
async def model_ready(name: Reference, runtime: RuntimeDep) -> schemas.ModelReady:
    """Return status 200 if the model is usable, 404 if it does not exist, or else 503."""
    model = runtime.models.resolve(name)
    return schemas.ModelReady(name=model.reference.name, ready=True)


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
