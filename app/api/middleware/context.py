"""Ids, log lines and metrics: what every request gets, whatever becomes of it."""

from __future__ import annotations

import logging
import re
import time
import uuid
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue
from app.serving.metrics import Metrics
from app.serving.record import SUCCESS, RequestRecord

CANCELLED: Final = "cancelled"
"""The outcome of a request that the server gave up while it stopped."""
OTHER: Final = "other"
"""The outcome of a failure without a problem document, as of an asset's impossible range."""

REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._~:-]{1,128}")

# A client may make up a method; these are what RFC 9110 and RFC 5789 define.
_METHODS: Final = frozenset(
    ("GET", "HEAD", "POST", "PUT", "DELETE", "CONNECT", "OPTIONS", "TRACE", "PATCH")
)

# A response to a request or to a handshake, or a stream that opens.
_BEGINNINGS = frozenset(
    ("http.response.start", "websocket.http.response.start", "websocket.accept")
)
_SWITCHED: Final = 101

_access = logging.getLogger("app.access")


class RequestContext:
    """Gives every request an id, echoes it as ``X-Request-Id``, counts it and writes a line.

    A stream is one request, whose line is written at its end.

    A client's own id is kept if it is made of 1–128 unreserved URI characters or colons; any other
    is replaced, so that logs and answers hold nothing a client made up.
    """

    def __init__(self, app: ASGIApp, *, metrics: Metrics, access_log: bool = True) -> None:
        self.app = app
        self.metrics = metrics
        self.access_log = access_log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if REQUEST_ID.fullmatch(given) else str(uuid.uuid4())
        record = RequestRecord()
        state = scope.setdefault("state", {})
        state["request_id"] = request_id
        state["record"] = record
        status = 500
        began = time.perf_counter()

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] in _BEGINNINGS:
                status = message.get("status", _SWITCHED)
                message.setdefault("headers", [])
                MutableHeaders(scope=message)["X-Request-Id"] = request_id
                if record.answered_at is not None and status < 400:
                    self.metrics.serialised(time.perf_counter() - record.answered_at)
            await send(message)

        try:
            await self.app(scope, receive, send_with_id)
        except Exception:
            # The problem is sent by the server's own handler, outside of all middleware.
            status, record.outcome = 500, catalogue.INTERNAL_ERROR.slug
            raise
        except BaseException:
            record.outcome = CANCELLED
            raise
        finally:
            seconds = time.perf_counter() - began
            if status >= 400 and record.outcome == SUCCESS:
                record.outcome = OTHER
            asked = scope.get("method", "GET")
            method = asked if asked in _METHODS else "-"
            route = _route(scope)
            took = None if status == _SWITCHED else seconds
            self.metrics.answered(route, method, record.outcome, took)
            if self.access_log and _access.isEnabledFor(logging.INFO):
                _access.info(
                    "%s %s %d %.2f ms",
                    method,
                    route,
                    status,
                    seconds * 1e3,
                    extra={
                        "request_id": request_id,
                        "method": method,
                        "route": route,
                        "status": status,
                        "latency_ms": round(seconds * 1e3, 3),
                        **record.known(),
                    },
                )


def _route(scope: Scope) -> str:
    """The template of the route that answered: what was asked may hold anything."""
    return getattr(scope.get("route"), "path", "-")
