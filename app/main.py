"""The application: wiring and lifespan."""

import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from starlette.exceptions import HTTPException

from app import __version__
from app.api import confirm, health, models, openapi, pages, problems, questions, scenes, telemetry
from app.api.gateway import gateway
from app.serving.runtime import Runtime
from app.settings import Settings

_DESCRIPTION = """
Ask a Boltzmann machine about a scene: which relations hold between its objects, which objects are
missing, which objects do not belong, which room it is, and what a similar scene looks like. Or ask
where in a home a thing is.
Positions are in metres, in the axes of `frame_id`. Objects are named by their ids, or by their
labels if only one object has the label.
Every failure is a problem document (RFC 9457). Its `type` identifies the problem type.
The figures in the examples are illustrations. Real figures depend on the model.
"""


def create_app(settings: Settings) -> FastAPI:
    """Create the application of the service."""
    runtime = Runtime(settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # The server accepts connections only after this call has loaded the models.
        await runtime.start()
        yield
        runtime.stop()

    app = openapi.DocumentedAPI(
        lifespan=lifespan,
        title="Scene reasoning",
        description=_DESCRIPTION,
        version=__version__,
        openapi_url=None,  # `openapi.show_document` serves the document
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        openapi_tags=list(openapi.TAGS),
        generate_unique_id_function=openapi.operation_id,
        telemetry=telemetry.configuration(enabled=settings.opentelemetry),
    )
    app.state.settings = settings
    app.state.runtime = runtime
    app.add_exception_handler(HTTPException, problems.handle)
    app.add_middleware(gateway, settings=settings, runtime=runtime)
    _add_routes(app, settings)
    return app


def _add_routes(app: FastAPI, settings: Settings) -> None:
    """Add all routes, and keep the set of their paths in `app.state.paths`."""
    app.router.routes += questions.router.routes + scenes.router.routes
    if app.state.runtime.recorder is not None:
        app.router.routes += confirm.router.routes
    routers = [models.router, health.router, *([health.monitoring] if settings.metrics else [])]
    for router in routers:
        app.include_router(router)
    pages.install(app, docs=settings.docs)
    if settings.docs:
        app.add_route("/openapi.json", openapi.show_document, include_in_schema=False)
    every = itertools.chain(app.routes, *(router.routes for router in routers))
    app.state.paths = {route.path for route in every if hasattr(route, "path")}
