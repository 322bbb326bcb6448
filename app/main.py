"""The application and its lifespan; nothing else."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI

from app import __version__, api
from app.serving.runtime import Runtime
from app.settings import Settings

_DESCRIPTION = """
Ask a Boltzmann machine about a scene: how its objects stand to each other, what is missing, what
does not belong, what a scene like it would look like. Positions are metres in the axes of
`frame_id`; objects are named by their ids, or by their labels where those are unambiguous.
A robot whose scene changes all the time streams it: `GET /stream`, a WebSocket, takes updates and
answers with the newest answers; docs/stream.md is its contract.
Every failure is a problem document (RFC 9457) whose `type` a program can branch on.
The figures in the examples illustrate; a model's own depend on what it was trained on.
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """The service.

    Args:
        settings: by default those of the environment.

    Raises:
        pydantic.ValidationError: the environment's settings make no sense.
    """
    settings = settings or Settings()
    runtime = Runtime(settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # Before the first connection is accepted: nobody is kept waiting, and nobody sees a
        # service that is alive and cannot answer for want of a second's patience.
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
