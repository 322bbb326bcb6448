"""The application and its lifespan."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI

from app import __version__, api
from app.serving.runtime import Runtime
from app.settings import Settings

_DESCRIPTION = """
Ask a Boltzmann machine four questions about a scene: which relations hold between its objects,
which objects are missing, which objects do not belong, and what a similar scene looks like.
Positions are in metres, in the axes of `frame_id`. Objects are named by their ids, or by their
labels if only one object has the label.
Every failure is a problem document (RFC 9457). Its `type` identifies the problem type.
The figures in the examples are illustrations. Real figures depend on the model.
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """Create the application of the service.

    Args:
        settings: settings of the service. None means that the function reads the settings from
            environment variables.

    Raises:
        pydantic.ValidationError: an environment variable contains an invalid setting.
    """
    settings = settings or Settings()
    runtime = Runtime(settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # The server accepts connections only after this call has loaded the models.
        await runtime.start()
        yield
        runtime.stop()

    return api.build(
        settings,
        runtime,
        lifespan,
        title="Scene reasoning",
        description=_DESCRIPTION,
        version=__version__,
    )
