"""The HTTP layer: routes, problem documents (RFC 9457), middleware and documentation pages."""

from __future__ import annotations

import itertools
from typing import Any

from fastapi import FastAPI
from starlette.types import Lifespan

from app.api import health, models, openapi, pages, problems, questions, telemetry
from app.api.body import Bodies, JSONRoute
from app.api.gateway import Gateway
from app.serving.runtime import Runtime
from app.settings import Settings


def build(
    settings: Settings, runtime: Runtime, lifespan: Lifespan[Any], **metadata: str
) -> FastAPI:
    """Build the application that serves ``runtime`` over HTTP.

    Args:
        settings: settings of the service, such as limits, keys and allowed origins.
        runtime: owner of the models and of the queue of requests.
        lifespan: context manager that starts and stops ``runtime``.
        **metadata: title, description and version of the API for the documentation.
    """
    app = openapi.DocumentedAPI(
        lifespan=lifespan,
        openapi_url="/openapi.json" if settings.docs else None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        openapi_tags=list(openapi.TAGS),
        generate_unique_id_function=openapi.operation_id,
        telemetry=telemetry.configuration(enabled=settings.opentelemetry),
        **metadata,  # type: ignore[arg-type]
    )
    app.state.settings = settings
    app.state.runtime = runtime
    app.state.bodies = Bodies(settings)
    problems.install(app)
    routes = (*questions.router.routes, *questions.batches.routes)
    asked = [route for route in routes if isinstance(route, JSONRoute)]
    # FastAPI creates the OpenTelemetry traces, so traced requests must pass through its router.
    direct = (
        {}
        if settings.opentelemetry
        else {settings.root_path + route.path: route for route in asked}
    )
    app.add_middleware(Gateway, settings=settings, runtime=runtime, direct=direct)
    app.router.routes.extend(asked)
    routers = [
        # `models.administration` stands before `models.router`, because both have the same paths.
        # The first route with a path sets the Allow header of a 405 response.
        models.administration,
        models.changes,
        models.router,
        health.router,
        health.protocol,
        *([health.monitoring] if settings.metrics else []),
    ]
    for router in routers:
        app.include_router(router)
    pages.install(app, docs=settings.docs)
    every = itertools.chain(app.routes, *(router.routes for router in routers))
    app.state.paths = {route.path for route in every if hasattr(route, "path")}
    return app
