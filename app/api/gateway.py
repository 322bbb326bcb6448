"""The one ASGI middleware: ids, access log, metrics, hosts, origins, keys and admission."""

from __future__ import annotations

import hmac
import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from time import monotonic, perf_counter
from typing import Any, Final
from uuid import uuid4

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import ProblemError, answer, from_exception, report_defect
from app.serving.request import SUCCESS, Record
from app.serving.runtime import Runtime
from app.settings import Settings

TIMEOUT_HEADER: Final = "X-Request-Timeout-Ms"
API_KEY: Final = "X-API-Key"
ADMIN_KEY: Final = "X-Admin-Key"

CANCELLED: Final = "cancelled"
"""The outcome of a request that the server gave up while it stopped."""
OTHER: Final = "other"
"""The outcome of a failure without a problem document, as of an asset's impossible range."""

HEALTH: Final = ("/health/live", "/health/ready")
"""Ends of paths that answer under every Host header.

Orchestrators and load balancers ask by the address of a replica, and learn only yes or no.
"""

# Orchestrators ask for health without credentials; the pages are the same for every installation
# and hold nothing of this one. Every other path needs a key. docs/security.md gives the reasons.
OPEN_ROUTES: Final = frozenset(
    {
        "/health/live",
        "/health/ready",
        "/v2/health/live",
        "/v2/health/ready",
        "/",
        "/docs",
        "/redoc",
        "/openapi.json",
        "/problems",
    }
)
_OPEN_FOLDERS: Final = ("/docs/", "/redoc/", "/static/", "/problems/")
# By their ends, because a proxy may leave a prefix on.
_NOT_QUEUED: Final = (*HEALTH, "/metrics")

_REQUEST_ID: Final = re.compile(rb"[A-Za-z0-9._~:-]{1,128}")
_TIMEOUT: Final = re.compile(rb"[1-9][0-9]{0,5}")
_HOST: Final = re.compile(rb"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{1,5})?")
# Clients may invent methods; these are defined by RFC 9110 and RFC 5789.
_METHODS: Final = frozenset(
    ("GET", "HEAD", "POST", "PUT", "DELETE", "CONNECT", "OPTIONS", "TRACE", "PATCH")
)
_SWITCHED: Final = 101
# RFC 6455: the server met a condition that it did not expect.
_DEFECT: Final = 1011

# Browsers do not guess the media type. They cache no answer (`_NOT_KEPT`).
_ALWAYS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
)
_POLICY: Final = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'")
_NOT_KEPT: Final = (b"cache-control", b"no-store")

_access = logging.getLogger("app.access")


class Gateway:
    """Every request passes it, in this order.

    1. It gets an id, which `X-Request-Id` echoes; a log line and the metrics follow its end. A
       client's own id is kept if it has 1 to 128 unreserved URI characters or colons.
    2. The Host header must name this service: a page whose name is made to point at this machine
       after it was loaded (DNS rebinding) has the service's own origin for its browser.
    3. Pages of other origins are answered where the settings list them.
    4. A service with an API key asks for it, or for the admin key.
    5. It gets a deadline and waits in the backlog until it may begin.

    Args:
        app: the application.
        settings: of the service.
        runtime: whose backlog and metrics are used.
        direct: routes by path that need nothing of the framework; it takes 15 µs to find them.
    """

    def __init__(
        self,
        app: ASGIApp,
        settings: Settings,
        runtime: Runtime,
        direct: Mapping[str, Route] | None = None,
    ) -> None:
        self._app = app
        self._direct = direct or {}
        self._settings = settings
        self._backlog = runtime.backlog
        self._metrics = runtime.metrics
        hosts = settings.accepted_hosts
        self._hosts = None if hosts is None else frozenset(name.encode("ascii") for name in hosts)
        self._timeout = settings.request_timeout_ms / 1e3
        origins = settings.cors_origins
        self._admitted: ASGIApp = CrossOrigin(self._admit, origins) if origins else self._admit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        began = perf_counter()
        headers = scope["headers"]
        given = next((value for name, value in headers if name == b"x-request-id"), b"")
        request_id = given if _REQUEST_ID.fullmatch(given) else str(uuid4()).encode()
        record = Record()
        state = scope.setdefault("state", {})
        state["request_id"] = request_id.decode()
        state["record"] = record

        async def send_completed(message: Message) -> None:
            kind = message["type"]
            if kind.endswith("response.start"):
                record.begin(message["status"])
                message["headers"] = _completed(message.get("headers", ()), request_id)
            elif kind == "websocket.accept":
                record.begin(_SWITCHED)
                message["headers"] = [*message.get("headers", ()), (b"x-request-id", request_id)]
            await send(message)

        try:
            if self._hosts is None or self._is_known(headers, scope["path"]):
                await self._admitted(scope, receive, send_completed)
            else:
                detail = "SCENE_ALLOWED_HOSTS does not list the name in the Host header."
                problem = ProblemError(catalogue.HOST_REFUSED, detail)
                await answer(problem, scope, receive, send_completed)
        except ProblemError as refused:  # the preflight of another origin
            await answer(refused, scope, receive, send_completed)
        except Exception:
            raise
        except BaseException:
            record.outcome = CANCELLED
            raise
        finally:
            self._note(scope, record, perf_counter() - began)

    def _is_known(self, headers: Sequence[tuple[bytes, bytes]], path: str) -> bool:
        """Whether the Host header names this service, or the path is a health check."""
        given = [value for name, value in headers if name == b"host"]
        host = _HOST.fullmatch(given[0].lower()) if len(given) == 1 else None
        return (host is not None and host[1] in (self._hosts or ())) or path.endswith(HEALTH)

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check key and size, wait for the request's turn, and answer every failure."""
        try:
            if self._settings.api_key is not None and not self._may_enter(scope):
                raise ProblemError(
                    catalogue.UNAUTHORIZED,
                    "This service needs its API key, or for administration its admin key.",
                    headers={"WWW-Authenticate": "Bearer"},
                )
            if scope["type"] == "http":
                allowed = size = None
                for name, value in scope["headers"]:
                    if name == b"x-request-timeout-ms":
                        allowed = allowed or value
                    elif name == b"content-length":
                        size = value
                if not scope["path"].endswith(_NOT_QUEUED):
                    if self._backlog.draining:
                        raise self._draining()
                    seconds = self._timeout if allowed is None else self._chosen(allowed)
                    deadline = scope["state"]["deadline"] = monotonic() + seconds
                    await self._backlog.enter(seconds, deadline)
                if size is not None:
                    self._check_size(size)
            route = self._direct.get(scope["path"])
            if route is not None and scope["type"] == "http":
                scope["route"], scope["path_params"] = route, {}
                await route.handle(scope, receive, send)
            else:
                await self._app(scope, receive, send)
        except Exception as error:  # noqa: BLE001 - answered, logged, and raised if half sent
            await self._fail(error, scope, receive, send)

    async def _fail(self, error: Exception, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a failure as far as no answer has begun."""
        problem = from_exception(error)
        record: Record = scope["state"]["record"]
        if problem.status_code == 500:
            report_defect(error, scope["state"]["request_id"])
        if not record.status:
            await answer(problem, scope, receive, send)
            return
        record.outcome = problem.kind.slug
        if scope["type"] == "http":
            # Half an answer cannot be taken back: the server breaks the connection off.
            record.status = 500
            raise error
        with suppress(OSError):  # the client has gone
            await send({"type": "websocket.close", "code": _DEFECT})

    def _draining(self) -> ProblemError:
        # Without the header a client would send its next request here as well.
        return ProblemError(
            catalogue.DRAINING,
            "The service finishes the requests in progress, and then ends.",
            headers={"Connection": "close"},
        )

    def _may_enter(self, scope: Scope) -> bool:
        path: str = scope["path"].removeprefix(scope.get("root_path", ""))
        if path in OPEN_ROUTES or path.startswith(_OPEN_FOLDERS):
            return True
        headers = Headers(scope=scope)
        asks = carries(headers, API_KEY, self._settings.api_key)
        administers = carries(headers, ADMIN_KEY, self._settings.admin_key)
        return asks or administers

    def _chosen(self, value: bytes) -> float:
        longest = self._settings.max_request_timeout_ms
        if not _TIMEOUT.fullmatch(value) or int(value) > longest:
            detail = f"{TIMEOUT_HEADER} must be a whole number, from 1 to {longest} milliseconds."
            raise ProblemError(catalogue.BAD_REQUEST, detail)
        return int(value) / 1e3

    def _check_size(self, value: bytes) -> None:
        limit = self._settings.max_body_bytes
        # Servers have checked that it is a number; len() guards int() where one has not.
        if value.isdigit() and (len(value) > 18 or int(value) > limit):
            raise too_large(limit)

    def _note(self, scope: Scope, record: Record, seconds: float) -> None:
        """Count a request and log it."""
        status = record.status or 500
        if status >= 400 and record.outcome == SUCCESS:
            record.outcome = OTHER
        asked = scope.get("method", "GET")
        method = asked if asked in _METHODS else "-"
        # The template of the route: the path may hold anything.
        route = getattr(scope.get("route"), "path", "-")
        took = None if status == _SWITCHED else seconds
        self._metrics.answered(route, method, record.outcome, took, record.serialise_seconds)
        if self._settings.access_log and _access.isEnabledFor(logging.INFO):
            entry = {
                "request_id": scope["state"]["request_id"],
                "method": method,
                "route": route,
                "status": status,
                "latency_ms": round(seconds * 1e3, 3),
                **record.known(),
            }
            message = f"{method} {route} {status} {seconds * 1e3:.2f} ms"
            # As `_access.info` does, without its search for the line of the caller.
            _access.handle(
                _access.makeRecord(
                    "app.access", logging.INFO, "", 0, message, (), None, extra={"entry": entry}
                )
            )


def _completed(headers: Sequence[tuple[bytes, bytes]], request_id: bytes) -> list[Any]:
    names = {name for name, _ in headers}
    found = [*headers, *_ALWAYS, (b"x-request-id", request_id)]
    if b"content-security-policy" not in names:
        found.append(_POLICY)
    if b"cache-control" not in names and b"etag" not in names:
        found.append(_NOT_KEPT)
    return found


def too_large(limit: int) -> ProblemError:
    """The problem of a body of more than ``limit`` bytes."""
    detail = f"The body must not be larger than {limit} bytes."
    return ProblemError(catalogue.BODY_TOO_LARGE, detail)


def carries(headers: Headers, name: str, expected: SecretStr | None) -> bool:
    """Whether a key stands in its own header or, without that, as a bearer token.

    Args:
        headers: of the request.
        name: the key's own header.
        expected: the key; no request carries one that is not configured.
    """
    scheme, _, token = headers.get("authorization", "").partition(" ")
    given = headers.get(name) or (token.strip() if scheme.lower() == "bearer" else "")
    secret = expected.get_secret_value() if expected else ""
    # In constant time, and first: neither the key nor whether there is one shows in the clock.
    equal = hmac.compare_digest(given.encode(), secret.encode())
    return equal and bool(secret)


class CrossOrigin(CORSMiddleware):
    """Lets pages of the listed origins ask and read, without cookies, and no others.

    Args:
        app: the application.
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
                API_KEY,
                "X-Request-Id",
                TIMEOUT_HEADER,
            ),
            expose_headers=("Retry-After", "X-Request-Id"),
        )

    def preflight_response(self, request_headers: Headers) -> Response:
        """The answer to a browser that asks first.

        Raises:
            ProblemError: of kind `catalogue.ORIGIN_REFUSED`.
        """
        response = super().preflight_response(request_headers)
        if response.status_code != 200:
            raise ProblemError(
                catalogue.ORIGIN_REFUSED,
                "The origin, the method or a header is not allowed.",
                headers={"Vary": response.headers["vary"]},
            )
        return response


def may_connect(headers: Headers, origins: Sequence[str]) -> bool:
    """Whether a WebSocket is asked for by a page of these origins or of ours, or by no page.

    Browsers send no preflight for WebSockets and let the page read the messages; no page can change
    its Origin header.

    Args:
        origins: as browsers send them.
    """
    origin = headers.get("origin")
    if origin is None or origin in origins:
        return True
    scheme, _, host = origin.partition("://")
    usual = {"http": ":80", "https": ":443"}.get(scheme)
    if usual is None or not host:
        return False
    return host == headers.get("host", "").lower().removesuffix(usual)
