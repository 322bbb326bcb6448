"""Liveness, readiness (the default model has answered in the warm-up) and metrics."""

import asyncio
import re
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from time import monotonic
from typing import Final
from uuid import uuid4

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4 as CONTENT_TYPE

from app import __version__, errors
from app.api.models import RuntimeDep
from app.api.openapi import error_responses
from app.api.problems import MEDIA_TYPE
from app.serving.runtime import Runtime
from scene_client import schemas

router = APIRouter(tags=["health"])
monitoring = APIRouter(tags=["monitoring"])
_get = partial(router.get, response_model_exclude_none=True)
# Load balancers may check health with HEAD. OpenAPI describes only GET.
_head = partial(router.head, include_in_schema=False, response_model_exclude_none=True)

# Maximum number of failures in an answer, because load balancers ask often and without a key.
_FAILURES = 10

HUNG_SECONDS: Final = 10.0
"""Time in seconds without an iteration of the event loop after which the health port says so."""

_BEAT: Final = 0.5  # seconds between two notes that the event loop runs
# Limits of the health port: bytes and seconds of a request, and number of connections.
_HEAD, _SECONDS, _CONNECTIONS = 4096, 5.0, 64


@_head("/health/live")
@_get("/health/live", summary="Is the process alive?", responses=error_responses())
async def health_live() -> schemas.Health:
    """Return status 200 while the process runs, even if the models are not usable."""
    return _live()


@_head("/health/ready")
@_get(
    "/health/ready", summary="Does a default model answer?", responses=error_responses("readiness")
)
async def health_ready(runtime: RuntimeDep) -> schemas.Health:
    """Return status 200 if a model answers for the alias `default`, else status 503.

    If the version at which the alias points is not usable, the newest usable version of its model
    answers. The answer lists refused versions and unusable aliases with their reasons.
    """
    return _ready(runtime)


def _live() -> schemas.Health:
    return schemas.Health(status="live", version=__version__)


def _ready(runtime: Runtime) -> schemas.Health:
    runtime.check_ready()
    failures = list(runtime.models.failures.values())[:_FAILURES]
    return schemas.Health(status="ready", failures=failures or None)


class HealthPort:
    """Answer health checks on a port and a thread of its own, however busy the event loop is.

    The answers are those of the routes. If the event loop has not run for `HUNG_SECONDS`, both
    checks have status 503.
    """

    def __init__(self, runtime: Runtime, listeners: list[socket.socket]) -> None:
        self._listeners, self._ran_at = listeners, monotonic()
        self._connections: dict[asyncio.StreamWriter, None] = {}  # the oldest first
        self._checks: dict[bytes, Callable[[], schemas.Health]] = {
            b"/health/live": _live,
            b"/health/ready": partial(_ready, runtime),
        }

    async def watch(self) -> None:
        """Answer checks about the event loop that runs this method, until its cancellation."""
        threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True).start()
        while True:
            self._ran_at = monotonic()
            await asyncio.sleep(_BEAT)

    async def _serve(self) -> None:
        for listener in self._listeners:
            await asyncio.start_server(self._converse, sock=listener, limit=_HEAD)
        await asyncio.Event().wait()  # for ever

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request, and close its connection."""
        self._connections[writer] = None
        if len(self._connections) > _CONNECTIONS:
            # Silent connections must not keep checks out, so the oldest one ends.
            next(iter(self._connections)).transport.abort()
        with suppress(
            OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError
        ):
            async with asyncio.timeout(_SECONDS):
                writer.write(self._answer(await reader.readuntil(b"\r\n\r\n")))
                await writer.drain()
        del self._connections[writer]
        writer.close()

    def _answer(self, head: bytes) -> bytes:
        """Return the response to the head of a request."""
        status, media_type = 200, "application/json"
        try:
            answer: schemas.Health | schemas.Problem = self._health(head)
        except errors.ServiceError as error:
            status, media_type = error.status, MEDIA_TYPE
            answer = error.describe(str(uuid4()))
        body = answer.model_dump_json(exclude_none=True).encode()
        fields = f"Content-Type: {media_type}\r\nContent-Length: {len(body)}\r\nConnection: close"
        start = f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\n{fields}\r\n\r\n".encode()
        return start if head.startswith(b"HEAD ") else start + body

    def _health(self, head: bytes) -> schemas.Health:
        """Return the answer to a check, or raise ServiceError."""
        request = re.match(rb"(?:GET|HEAD) (/[a-z/]+)(?:\?\S*)? HTTP/", head)
        check = self._checks.get(request[1]) if request else None
        if check is None:
            raise errors.NotFoundError("This port answers only GET /health/live and /health/ready.")
        pause = monotonic() - self._ran_at
        if pause > HUNG_SECONDS:
            raise errors.NotReadyError(f"The event loop has not run for {pause:.0f} seconds.")
        return check()


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
