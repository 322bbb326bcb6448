"""Plain ASGI middleware: request ids and access lines, and the limit on bodies.

None of it derives from `BaseHTTPMiddleware`, three of which cost three quarters of the throughput.
"""

from __future__ import annotations

import logging
import re
import time
import uuid
from collections.abc import Callable
from typing import Final

from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import ProblemError, respond
from app.api.turnstile import Turnstile
from app.settings import Settings

REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._~:-]{1,128}")
_access = logging.getLogger("app.access")


def install(
    app: FastAPI, settings: Settings, is_draining: Callable[[], bool] = lambda: False
) -> None:
    """Add all of it to an application.

    Args:
        is_draining: whether nothing new is to be begun.
    """
    app.add_middleware(BodyLimit, limit=settings.max_body_bytes)
    app.add_middleware(
        Turnstile,
        limit=settings.queue_rows,
        timeout=settings.request_timeout_ms / 1e3,
        is_draining=is_draining,
    )
    # Added last, so outermost: an answer of those above carries the id as well.
    app.add_middleware(RequestContext, access_log=settings.access_log)


class RequestContext:
    """Gives every request an id, echoes it as ``X-Request-Id``, and writes one line about it.

    A client's own id is kept if it is made of 1–128 unreserved URI characters or colons; any other
    is replaced, so that logs and answers hold nothing a client made up.
    """

    def __init__(self, app: ASGIApp, *, access_log: bool = True) -> None:
        self.app = app
        self.access_log = access_log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if REQUEST_ID.fullmatch(given) else str(uuid.uuid4())
        scope.setdefault("state", {})["request_id"] = request_id
        status = 500
        began = time.perf_counter()

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)["X-Request-Id"] = request_id
            await send(message)

        try:
            await self.app(scope, receive, send_with_id)
        finally:
            if self.access_log:
                milliseconds = (time.perf_counter() - began) * 1e3
                _access.info(
                    "%s %s %d %.2f ms",
                    scope["method"],
                    _route(scope),
                    status,
                    milliseconds,
                    extra={"request_id": request_id, "status": status},
                )


def _route(scope: Scope) -> str:
    """The template of the route that answered: what was asked may hold anything."""
    return getattr(scope.get("route"), "path", "-")


class BodyLimit:
    """Refuses bodies over ``limit`` bytes: by Content-Length at once, chunked ones as they come."""

    def __init__(self, app: ASGIApp, *, limit: int) -> None:
        self.app = app
        self.limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        declared = Headers(scope=scope).get("content-length", "")
        # Servers have checked that it is a number; len() guards int() where one has not.
        if declared.isdecimal() and (len(declared) > 18 or int(declared) > self.limit):
            await respond(Request(scope), self._too_large())(scope, receive, send)
            return
        received = 0

        async def receive_within_limit() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self.limit:
                raise self._too_large()
            return message

        await self.app(scope, receive_within_limit, send)

    def _too_large(self) -> ProblemError:
        return ProblemError(
            catalogue.BODY_TOO_LARGE, f"The body must not be larger than {self.limit} bytes."
        )
