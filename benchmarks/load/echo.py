"""``python -m benchmarks.load.echo PORT``: the service without a model.

The same schemas, routes, strict bodies, middleware and server; answers of the usual size are built
from the names of the request, and mean nothing.
"""

from __future__ import annotations

import sys
from typing import Any

import uvicorn
from fastapi import APIRouter, FastAPI

from app.api import middleware, problems
from app.api.body import JSONRoute
from app.api.dependencies import RequestId
from app.serving.logs import log_config
from app.serving.metrics import Metrics, Unmeasured
from app.settings import Settings
from scene_client.schemas import (
    Because,
    Detection,
    Disagreement,
    ExpectedRelation,
    Health,
    MisplacedRelation,
    MissingAnswer,
    MissingObject,
    MissingRequest,
    ModelReference,
    ObservedRelation,
    Offset,
    Outlier,
    OutliersAnswer,
    OutliersRequest,
    Placement,
    RelationsAnswer,
    RelationsRequest,
    SceneRequest,
    Vector,
)

# So many relations a posed object are derived in the rooms that are asked about.
_DERIVED = 3

# With as many digits as a model's.
_PROBABILITY, _LOG_ODDS = 0.08022543832794828, -0.659896969795227

_MODEL = ModelReference(name="echo", version="1.0.0", variant="triway", digest="0" * 64)

router = APIRouter(route_class=JSONRoute)


def _names(request: SceneRequest) -> list[str]:
    return [
        entry if isinstance(entry, str) else entry.id or entry.label for entry in request.objects
    ]


def _derived(request: SceneRequest) -> list[ObservedRelation] | None:
    names = [entry.id or "" for entry in request.objects if isinstance(entry, Detection)]
    if not names:
        return None
    return [
        ObservedRelation(names[k % len(names)], "left", names[-1 - k % len(names)])
        for k in range(_DERIVED * len(names))
    ]


def _envelope(request: SceneRequest, request_id: str) -> dict[str, Any]:
    return {
        "model": _MODEL,
        "request_id": request_id,
        "frame_id": request.frame_id,
        "stamp": request.stamp,
        "observed_relations": _derived(request),
    }


def _because(names: list[str]) -> list[Because]:
    return [Because(names[k % len(names)], _LOG_ODDS) for k in range(3)]


@router.post("/relations", response_model_exclude_none=True)
async def relations(request: RelationsRequest, request_id: RequestId) -> RelationsAnswer:
    names = _names(request)
    return RelationsAnswer(
        **_envelope(request, request_id),
        relations=[
            ExpectedRelation(
                subject=names[k % len(names)],
                relation="left",
                object=names[-1 - k % len(names)],
                probability=_PROBABILITY,
            )
            for k in range(request.top_k)
        ],
        disagreements=[
            Disagreement(
                subject=relation.subject,
                object=relation.object,
                observed=[relation.relation],
                expected="front",
                probability=_PROBABILITY,
                observed_probability=_PROBABILITY,
            )
            for relation in (request.relations or _derived(request) or [])[: request.top_k : 3]
        ],
    )


@router.post("/missing", response_model_exclude_none=True)
async def missing(request: MissingRequest, request_id: RequestId) -> MissingAnswer:
    names = _names(request)
    return MissingAnswer(
        **_envelope(request, request_id),
        missing=[
            MissingObject(
                label=names[k % len(names)],
                probability=_PROBABILITY,
                log_odds=_LOG_ODDS,
                placements=[
                    Placement(
                        relation="left",
                        object=names[p % len(names)],
                        probability=_PROBABILITY,
                        offset=Offset(Vector(0.123, -1.234, 0.5), Vector(0.4, 0.3, 0.2), 123),
                    )
                    for p in range(3)
                ],
                because=_because(names),
            )
            for k in range(request.top_k)
        ],
    )


@router.post("/outliers", response_model_exclude_none=True)
async def outliers(request: OutliersRequest, request_id: RequestId) -> OutliersAnswer:
    names = _names(request)
    return OutliersAnswer(
        **_envelope(request, request_id),
        outliers=[
            Outlier(
                object=name,
                label=name,
                probability=_PROBABILITY,
                log_odds=_LOG_ODDS,
                is_outlier=False,
                because=_because(names),
            )
            for name in names
        ],
        misplaced=[
            MisplacedRelation(
                subject=relation.subject,
                relation=relation.relation,
                object=relation.object,
                probability=_PROBABILITY,
            )
            for relation in request.relations or _derived(request) or ()
        ],
    )


def build(settings: Settings) -> FastAPI:
    """The echo, with the middleware of the service."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.state.settings = settings
    problems.install(app)
    middleware.install(app, settings, Metrics() if settings.metrics else Unmeasured())
    app.include_router(router)

    @app.get("/health/ready")
    async def ready() -> Health:
        return Health(status="ready")

    return app


if __name__ == "__main__":
    settings = Settings()
    uvicorn.run(
        build(settings),
        port=int(sys.argv[1]),
        http="httptools",
        ws="none",
        log_config=log_config(settings.log_level, settings.log_format),
        access_log=False,
        server_header=False,
    )
