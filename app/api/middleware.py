"""Plain ASGI middleware: ids, log lines and metrics, headers, origins, defects, keys, body sizes.

None of it derives from `BaseHTTPMiddleware`, three of which cost three quarters of the throughput.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from collections.abc import Callable
from typing import Final

from fastapi import FastAPI
from pydantic import SecretStr
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue, keys
from app.api.problems import ProblemError, from_exception, report_defect, respond
from app.api.turnstile import Turnstile
from app.serving.metrics import Metrics
from app.serving.record import SUCCESS, RequestRecord
from app.settings import Settings

CANCELLED: Final = "cancelled"
"""The outcome of a request that the server gave up while it stopped."""
OTHER: Final = "other"
"""The outcome of a failure without a problem document, as of an asset's impossible range."""

REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._~:-]{1,128}")

# A client may make up a method; these are what RFC 9110 and RFC 5789 define.
_METHODS: Final = frozenset(
    ("GET", "HEAD", "POST", "PUT", "DELETE", "CONNECT", "OPTIONS", "TRACE", "PATCH")
)

_access = logging.getLogger("app.access")


def install(
    app: FastAPI,
    settings: Settings,
    metrics: Metrics,
    is_draining: Callable[[], bool] = lambda: False,
) -> None:
    """Add all of it to an application, from the inside out.

    Args:
        is_draining: whether nothing new is to be begun.
    """
    app.add_middleware(BodyLimit, limit=settings.max_body_bytes, patience=settings.client_timeout)
    app.add_middleware(
        Turnstile,
        limit=settings.queue_requests,
        timeout=settings.request_timeout_ms / 1e3,
        is_draining=is_draining,
    )
    # Outside these: a stranger's request takes no place, and not even its size is judged.
    if settings.api_key is not None:
        app.add_middleware(KeyGuard, api_key=settings.api_key, admin_key=settings.admin_key)
    # Inside of all that adds to answers: those of defects carry id and headers as any other.
    app.add_middleware(Defects)
    if settings.cors_origins:
        app.add_middleware(CrossOrigin, origins=settings.cors_origins)
    app.add_middleware(SafeHeaders)
    app.add_middleware(RequestContext, metrics=metrics, access_log=settings.access_log)


class RequestContext:
    """Gives every request an id, echoes it as ``X-Request-Id``, counts it and writes a line.

    A client's own id is kept if it is made of 1–128 unreserved URI characters or colons; any other
    is replaced, so that logs and answers hold nothing a client made up.
    """

    def __init__(self, app: ASGIApp, *, metrics: Metrics, access_log: bool = True) -> None:
        self.app = app
        self.metrics = metrics
        self.access_log = access_log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
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
            if message["type"] == "http.response.start":
                status = message["status"]
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
            method = scope["method"] if scope["method"] in _METHODS else "-"
            route = _route(scope)
            self.metrics.answered(route, method, record.outcome, seconds)
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


class SafeHeaders:
    """Tells browsers to take answers for what they are and to keep none of what was computed.

    What an answer says for itself stands: pages have a policy of their own, and files, which have
    an entity tag, may be kept.
    """

    _ALWAYS: Final = (
        (b"x-content-type-options", b"nosniff"),
        (b"referrer-policy", b"no-referrer"),
    )
    _POLICY: Final = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'")
    _NOT_KEPT: Final = (b"cache-control", b"no-store")

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [*message.get("headers", ()), *self._ALWAYS]
                names = {name for name, _ in headers}
                if b"content-security-policy" not in names:
                    headers.append(self._POLICY)
                if not names & {b"cache-control", b"etag"}:
                    headers.append(self._NOT_KEPT)
                message["headers"] = headers
            await send(message)

        await self.app(scope, receive, send_with_headers)


class CrossOrigin(CORSMiddleware):
    """Lets pages of the listed origins ask and read, without cookies, and no others.

    Args:
        app: what answers.
        origins: as browsers send them.
    """

    def __init__(self, app: ASGIApp, origins: tuple[str, ...]) -> None:
        super().__init__(
            app,
            allow_origins=origins,
            # Administration is for people at a terminal: a page needs neither PUT nor its key.
            allow_methods=("GET", "POST"),
            allow_headers=(
                "Authorization",
                "Content-Type",
                keys.API_KEY,
                "X-Request-Id",
                "X-Request-Timeout-Ms",
            ),
            expose_headers=("Retry-After", "X-Request-Id"),
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        try:
            await super().__call__(scope, receive, send)
        except _PreflightRefusedError as refused:
            problem = ProblemError(
                catalogue.ORIGIN_REFUSED,
                "The origin, the method or a header is not allowed.",
                headers={"Vary": refused.vary},
            )
            await respond(Request(scope), problem)(scope, receive, send)

    def preflight_response(self, request_headers: Headers) -> Response:
        """The answer to a browser that asks first; a refusal is a problem, not plain text."""
        answer = super().preflight_response(request_headers)
        if answer.status_code != 200:
            raise _PreflightRefusedError(answer.headers["vary"])
        return answer


class _PreflightRefusedError(Exception):
    def __init__(self, vary: str) -> None:
        super().__init__(vary)
        self.vary = vary


class Defects:
    """Answers what nothing else has caught, as long as no answer has begun."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        begun = False

        async def send_and_note(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self.app(scope, receive, send_and_note)
        except Exception as error:
            if begun:
                # Half an answer cannot be taken back: the server breaks the connection off.
                raise
            request = Request(scope)
            report_defect(error, request.state.request_id)
            await respond(request, from_exception(error))(scope, receive, send)


class KeyGuard:
    """Lets through what is open, and who carries the API key or the admin key.

    The admin routes ask for the admin key once more: here it only opens the door.
    """

    def __init__(self, app: ASGIApp, *, api_key: SecretStr, admin_key: SecretStr | None) -> None:
        self.app = app
        self.api_key = api_key
        self.admin_key = admin_key

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "lifespan" or keys.is_open(scope) or self._may_enter(scope):
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            # Before it is accepted: the server answers the handshake with 403.
            await send({"type": "websocket.close", "code": 1008})
        else:
            problem = ProblemError(
                catalogue.UNAUTHORIZED,
                "This service needs its API key, or for administration its admin key.",
                headers={"WWW-Authenticate": "Bearer"},
            )
            await respond(Request(scope), problem)(scope, receive, send)

    def _may_enter(self, scope: Scope) -> bool:
        headers = Headers(scope=scope)
        asks = keys.carries(headers, keys.API_KEY, self.api_key)
        administers = keys.carries(headers, keys.ADMIN_KEY, self.admin_key)
        return asks or administers


class BodyLimit:
    """Refuses bodies over ``limit`` bytes, and those that take longer than ``patience`` seconds.

    By Content-Length at once, chunked ones as they come.
    """

    def __init__(self, app: ASGIApp, *, limit: int, patience: float) -> None:
        self.app = app
        self.limit = limit
        self.patience = patience

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
        deadline = asyncio.get_running_loop().time() + self.patience
        complete = False

        async def receive_within_limits() -> Message:
            nonlocal received, complete
            if complete:
                # Whoever waits now waits for the client to leave, which may take any time.
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                raise self._too_slow() from None
            received += len(message.get("body", b""))
            if received > self.limit:
                raise self._too_large()
            complete = not message.get("more_body", False)
            return message

        await self.app(scope, receive_within_limits, send)

    def _too_large(self) -> ProblemError:
        return ProblemError(
            catalogue.BODY_TOO_LARGE, f"The body must not be larger than {self.limit} bytes."
        )

    def _too_slow(self) -> ProblemError:
        return ProblemError(
            catalogue.REQUEST_TIMEOUT,
            f"The body did not come within {self.patience:g} seconds.",
            headers={"Connection": "close"},
        )
