"""The steps of a request before its route: ASGI middleware with one concern each."""

import logging
import re
from asyncio import CancelledError
from collections.abc import Sequence
from time import perf_counter
from typing import Any, Final
from uuid import uuid4

from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.access import API_KEY, TIMEOUT_HEADER, HostCheck, KeyCheck
from app.api.problems import answer, from_exception
from app.api.turns import Deadline, Size, Turn
from app.serving.request import SUCCESS, Record
from app.serving.runtime import Runtime
from app.settings import Settings

_REQUEST_ID: Final = re.compile(rb"[A-Za-z0-9._~:-]{1,128}")

# These headers stop browsers from guessing the media type and from sending a Referer.
_ALWAYS: Final = ((b"x-content-type-options", b"nosniff"), (b"referrer-policy", b"no-referrer"))
_POLICY: Final = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'")
_NOT_KEPT: Final = (b"cache-control", b"no-store")

_access = logging.getLogger("app.access")


def gateway(app: ASGIApp, settings: Settings, runtime: Runtime) -> ASGIApp:
    """Return the application behind its steps. The last line is the first step of a request."""
    steps: ASGIApp = Turn(app, runtime.admission)
    steps = Size(steps, settings, runtime.bodies)
    steps = Deadline(steps, app, settings, runtime)
    if settings.api_key is not None:
        steps = KeyCheck(steps, settings.api_key)
    steps = Failures(steps)
    if settings.cors_origins:
        headers = "Authorization", "Content-Type", API_KEY, "X-Request-Id", TIMEOUT_HEADER
        steps = CORSMiddleware(
            steps,
            allow_origins=settings.cors_origins,
            allow_methods=("GET", "POST"),
            allow_headers=headers,
            expose_headers=("Retry-After", "X-Request-Id"),
        )
    if (names := settings.accepted_hosts) is not None:
        steps = HostCheck(steps, names)
    return Recorded(steps, app, settings, runtime)


class Recorded:
    """Complete the headers of each response, and record the request in metrics and access log.

    The header `X-Request-Id` of the response and the access log contain the id of the request. The
    client may choose an id of 1 to 128 unreserved URI characters or colons. The application
    ``other`` gets everything but requests, such as the start of the service.
    """

    def __init__(self, app: ASGIApp, other: ASGIApp, settings: Settings, runtime: Runtime) -> None:
        self._app, self._other, self._runtime = app, other, runtime
        self._has_log = settings.access_log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":  # lifespan, or a WebSocket: no route accepts one
            await self._other(scope, receive, send)
            return
        began = perf_counter()
        headers = scope["headers"]
        request_id = next((value for name, value in headers if name == b"x-request-id"), b"")
        if not _REQUEST_ID.fullmatch(request_id):
            request_id = str(uuid4()).encode()
        upgrades = any(name == b"upgrade" for name, _ in headers)
        record = Record()
        scope.setdefault("state", {}).update(request_id=request_id.decode(), record=record)

        async def send_completed(message: Message) -> None:
            if message["type"] == "http.response.start":
                record.status = message["status"]
                message["headers"] = _with_defaults(message.get("headers", ()), request_id)
                # While draining, the client's next request must go to another replica. After a
                # request to upgrade, the parser would read its body as the next request.
                if self._runtime.draining or upgrades:
                    message["headers"].append((b"connection", b"close"))
            await send(message)

        try:
            await self._app(scope, receive, send_completed)
        except CancelledError:  # the server shuts down
            record.outcome = "cancelled"
            raise
        finally:
            self._record(scope, record, perf_counter() - began)

    def _record(self, scope: Scope, record: Record, seconds: float) -> None:
        """Write the metrics and the access log of a request."""
        status = record.status or 500
        if status >= 400 and record.outcome == SUCCESS:
            # A static file answers an invalid Range header without a problem document.
            record.outcome = "other"
        method = scope["method"]  # the server refuses others than the registered ones
        # The log contains the template of the route, because a raw path may contain private data.
        route = getattr(scope.get("route"), "path", "-")
        self._runtime.metrics.answered(route, record.outcome, seconds)
        if self._has_log and _access.isEnabledFor(logging.INFO):
            message = f"{method} {route} {status} {seconds * 1e3:.2f} ms"
            # `_access.info` would search the stack for its caller, which no format shows.
            line = logging.LogRecord(_access.name, logging.INFO, "", 0, message, None, None)
            line.entry = {
                "request_id": scope["state"]["request_id"],
                "method": method,
                "route": route,
                "status": status,
                "latency_ms": round(seconds * 1e3, 3),
                **record.log_fields(),
            }
            _access.handle(line)


def _with_defaults(headers: Sequence[tuple[bytes, bytes]], request_id: bytes) -> list[Any]:
    names = {name for name, _ in headers}
    completed = [*headers, *_ALWAYS, (b"x-request-id", request_id)]
    if b"content-security-policy" not in names:
        completed.append(_POLICY)
    if b"cache-control" not in names and b"etag" not in names:
        completed.append(_NOT_KEPT)
    return completed


class Failures:
    """Answer every failure with a problem document."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request.

        Raises:
            Exception: a part of the response has been sent already. The error makes the server
                close the connection.
        """
        try:
            await self._app(scope, receive, send)
        except Exception as error:  # noqa: BLE001 - _fail() answers and logs every error
            await _fail(error, scope, receive, send)


async def _fail(error: Exception, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a failure, or raise it again if a part of the response has been sent already.

    This is a separate function, because the error refers to the frame that catches it. A variable
    of that frame must not refer to the error: the cycle would keep the body in memory.
    """
    problem = from_exception(error, scope["state"]["request_id"])
    record: Record = scope["state"]["record"]
    if record.status:
        record.outcome, record.status = problem.slug, 500
        raise error
    await answer(problem, scope, receive, send)
