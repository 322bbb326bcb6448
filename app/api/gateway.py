"""The ASGI middleware of the service. The class `Gateway` documents the steps of a request."""

from __future__ import annotations

import hmac
import logging
import re
from collections.abc import Sequence
from time import monotonic, perf_counter
from typing import Any, Final
from uuid import uuid4

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import errors
from app.api.problems import answer, from_exception
from app.serving.admission import SMALL, Ticket
from app.serving.models import NO_MODELS
from app.serving.request import SUCCESS, Record
from app.serving.runtime import Runtime
from app.settings import Settings

TIMEOUT_HEADER: Final = "X-Request-Timeout-Ms"
API_KEY: Final = "X-API-Key"
ADMIN_KEY: Final = "X-Admin-Key"

CANCELLED: Final = "cancelled"
"""Outcome of a request that the server cancelled during its shutdown."""
OTHER: Final = "other"
"""Outcome of a failure without a problem document.

An example is an invalid Range header in a request for a static file.
"""

HEALTH: Final = ("/health/live", "/health/ready")
"""Suffixes of the paths of health checks. These paths accept every Host header and take no turn.

These are suffixes, because some proxies add a prefix to the path.

Orchestrators and load balancers send the address of a replica as Host header. The answer of a
health check contains only a status, so it reveals no data.
"""

# Paths that need no API key. Orchestrators send health checks without credentials. The HTML pages
# contain no private data. docs/security.md gives the reasons.
_PAGES: Final = ("/", "/docs", "/redoc", "/openapi.json", "/problems")
OPEN_ROUTES: Final = frozenset((*_PAGES, *HEALTH, *(f"/v2{path}" for path in HEALTH)))
_OPEN_FOLDERS: Final = ("/docs/", "/redoc/", "/static/", "/problems/")

_REQUEST_ID: Final = re.compile(rb"[A-Za-z0-9._~:-]{1,128}")
_TIMEOUT: Final = re.compile(rb"[1-9][0-9]{0,5}")
_HOST: Final = re.compile(rb"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{1,5})?")
_WITH_BODY: Final = frozenset(("POST", "PUT", "PATCH"))
# HTTP methods of RFC 9110 and RFC 5789. The metrics count all other methods as "-". Otherwise,
# clients could create any number of series by inventing methods.
_METHODS: Final = frozenset(
    ("GET", "HEAD", "POST", "PUT", "DELETE", "CONNECT", "OPTIONS", "TRACE", "PATCH")
)

# These headers stop browsers from guessing the media type and from sending a Referer.
_ALWAYS: Final = ((b"x-content-type-options", b"nosniff"), (b"referrer-policy", b"no-referrer"))
_POLICY: Final = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'")
_NOT_KEPT: Final = (b"cache-control", b"no-store")

_access = logging.getLogger("app.access")


class Gateway:
    """Middleware that applies five steps to every request, in the order of this list.

    1. Request id: the header `X-Request-Id` of the response and the access log contain the id. The
       client may choose an id of 1 to 128 unreserved URI characters or colons.
    2. Host header: the header must name this service. This check prevents DNS rebinding, where
       an attacker points the host name of a web page at this machine.
    3. Origin: pages of other origins get an answer only if the settings list the origin.
    4. Key: if the settings contain an API key, the request needs this key or the admin key.
    5. Admission: the gateway sets the deadline of the request and reads its body. Then the request
       waits for its turn, which ends when its response starts.

    Args:
        app: the ASGI application that answers the requests.
        runtime: owner of the lanes, the metrics and the models.
    """

    def __init__(self, app: ASGIApp, settings: Settings, runtime: Runtime) -> None:
        self._app = app
        self._settings = settings
        self._runtime = runtime
        self._admission = runtime.admission
        self._metrics = runtime.metrics
        hosts = settings.accepted_hosts
        self._hosts = None if hosts is None else frozenset(name.encode("ascii") for name in hosts)
        self._timeout = settings.request_timeout_ms / 1e3
        origins = settings.cors_origins
        self._admitted: ASGIApp = CrossOrigin(self._admit, origins) if origins else self._admit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":  # lifespan, or a WebSocket: no route accepts one
            await self._app(scope, receive, send)
            return
        began = perf_counter()
        headers = scope["headers"]
        request_id = next((value for name, value in headers if name == b"x-request-id"), b"")
        if not _REQUEST_ID.fullmatch(request_id):
            request_id = str(uuid4()).encode()
        upgrades = any(name == b"upgrade" for name, _ in headers)
        record = Record()
        state = scope.setdefault("state", {})
        state["request_id"] = request_id.decode()
        state["record"] = record

        async def send_completed(message: Message) -> None:
            if message["type"] == "http.response.start":
                record.begin(message["status"])
                if (ticket := state.get("ticket")) is not None:
                    ticket.leave()
                message["headers"] = _with_defaults(message.get("headers", ()), request_id)
                # While draining, the client's next request must go to another replica. After a
                # request to upgrade, the parser would read its body as the next request.
                if self._runtime.draining or upgrades:
                    message["headers"].append((b"connection", b"close"))
            await send(message)

        try:
            if self._hosts is not None and not self._accepts_host(headers, scope["path"]):
                detail = "SCENE_ALLOWED_HOSTS does not list the name in the Host header."
                raise errors.HostRefusedError(detail)
            await self._admitted(scope, receive, send_completed)
        except (errors.HostRefusedError, errors.OriginRefusedError) as refused:
            await answer(refused, scope, receive, send_completed)
        except Exception:
            raise
        except BaseException:
            record.outcome = CANCELLED
            raise
        finally:
            self._record(scope, record, perf_counter() - began)

    def _accepts_host(self, headers: Sequence[tuple[bytes, bytes]], path: str) -> bool:
        """Return True if the Host header names this service, or the path is a health check."""
        hosts = [value for name, value in headers if name == b"host"]
        host = _HOST.fullmatch(hosts[0].lower()) if len(hosts) == 1 else None
        return (host is not None and host[1] in (self._hosts or ())) or path.endswith(HEALTH)

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check the key and the size of a request, wait for admission, and answer every failure."""
        try:
            if self._settings.api_key is not None and not self._has_access(scope):
                detail = "This service needs its API key, or the admin key for administration."
                raise errors.UnauthorizedError(detail)
            if scope["path"].endswith(HEALTH):
                await self._app(scope, receive, send)
            else:
                await self._take_turn(scope, receive, send)
        except Exception as error:  # noqa: BLE001 - _fail() answers and logs every error
            await self._fail(error, scope, receive, send)

    async def _take_turn(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Read the body of a request and wait for its turn. Then answer the request."""
        if self._runtime.models is NO_MODELS:
            raise errors.NotReadyError("The service is starting.")
        timeout, length = None, b""
        for name, value in scope["headers"]:
            if name == b"x-request-timeout-ms":
                timeout = timeout or value
            elif name == b"content-length":
                length = value
        seconds = self._timeout if timeout is None else self._seconds(timeout)
        client = (scope.get("client") or ("",))[0]
        is_gone = Request(scope, receive).is_disconnected
        ticket = Ticket(client, monotonic() + seconds, is_gone)
        body = b""
        if scope["method"] in _WITH_BODY:
            limit = self._settings.max_body_bytes
            if not scope["path"].endswith(("/batch", "/scenes")):
                limit = min(self._settings.max_scene_bytes, limit)
            body = await self._runtime.bodies.read(receive, client, limit, length)
        scope["state"] |= {"body": body, "ticket": ticket}
        quick, slow = self._admission.quick, self._admission.slow
        try:
            if len(body) > SMALL:
                await ticket.enter(slow, 1)
            elif quick.is_full(client, 1):
                # A refusal takes a turn, too. Otherwise refusals of one client would take the time
                # of all others.
                await ticket.enter(quick, 0)
                raise errors.QueueFullError("Too many requests of this client are waiting.")
            else:
                await ticket.enter(quick, 1)
            await self._app(scope, receive, send)
        finally:
            ticket.leave()
            self._runtime.bodies.release(client, len(body))
            # The ticket refers to the scope: without this deletion, they form a reference cycle.
            del scope["state"]["ticket"]

    async def _fail(self, error: Exception, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a failure, or close the connection if a response has started already."""
        problem = from_exception(error, scope["state"]["request_id"])
        record: Record = scope["state"]["record"]
        if record.status:
            # A part of the response has been sent already. The raised error makes the server close
            # the connection.
            record.outcome, record.status = problem.slug, 500
            raise error
        await answer(problem, scope, receive, send)

    def _has_access(self, scope: Scope) -> bool:
        path: str = scope["path"].removeprefix(scope.get("root_path", ""))
        if path in OPEN_ROUTES or path.startswith(_OPEN_FOLDERS):
            return True
        headers = Headers(scope=scope)
        has_api_key = has_key(headers, API_KEY, self._settings.api_key)
        has_admin_key = has_key(headers, ADMIN_KEY, self._settings.admin_key)
        return has_api_key or has_admin_key

    def _seconds(self, value: bytes) -> float:
        longest = self._settings.max_request_timeout_ms
        if not _TIMEOUT.fullmatch(value) or int(value) > longest:
            detail = f"{TIMEOUT_HEADER} must be a whole number from 1 to {longest} (milliseconds)."
            raise errors.BadRequestError(detail)
        return int(value) / 1e3

    def _record(self, scope: Scope, record: Record, seconds: float) -> None:
        """Write the metrics and the access log of a request."""
        status = record.status or 500
        if status >= 400 and record.outcome == SUCCESS:
            record.outcome = OTHER
        method = scope["method"] if scope["method"] in _METHODS else "-"
        # The log contains the template of the route, because a raw path may contain private data.
        route = getattr(scope.get("route"), "path", "-")
        self._metrics.answered(route, method, record.outcome, seconds, record.serialise_seconds)
        if self._settings.access_log and _access.isEnabledFor(logging.INFO):
            entry = {
                "request_id": scope["state"]["request_id"],
                "method": method,
                "route": route,
                "status": status,
                "latency_ms": round(seconds * 1e3, 3),
                **record.log_fields(),
            }
            message = f"{method} {route} {status} {seconds * 1e3:.2f} ms"
            # `_access.info` would search the stack for its caller, which no format shows.
            line = logging.LogRecord(_access.name, logging.INFO, "", 0, message, None, None)
            line.entry = entry
            _access.handle(line)


def _with_defaults(headers: Sequence[tuple[bytes, bytes]], request_id: bytes) -> list[Any]:
    names = {name for name, _ in headers}
    completed = [*headers, *_ALWAYS, (b"x-request-id", request_id)]
    if b"content-security-policy" not in names:
        completed.append(_POLICY)
    if b"cache-control" not in names and b"etag" not in names:
        completed.append(_NOT_KEPT)
    return completed


def has_key(headers: Headers, name: str, expected: SecretStr | None) -> bool:
    """Return whether a request contains the expected key. The result is False if this key is None.

    The key may be in the header ``name`` or, without this header, in a bearer token.
    """
    scheme, _, token = headers.get("authorization", "").partition(" ")
    key = headers.get(name) or (token.strip() if scheme.lower() == "bearer" else "")
    secret = expected.get_secret_value() if expected else ""
    # The comparison always runs and takes constant time. Otherwise the response time would show
    # whether a key is configured, or how many characters match.
    equal = hmac.compare_digest(key.encode(), secret.encode())
    return equal and bool(secret)


class CrossOrigin(CORSMiddleware):
    """Allow pages of the listed origins to send GET and POST requests, without cookies.

    Args:
        app: the ASGI application that answers allowed requests.
        origins: allowed values of the Origin header.
    """

    def __init__(self, app: ASGIApp, origins: tuple[str, ...]) -> None:
        super().__init__(
            app,
            allow_origins=origins,
            # The lists do not contain PUT and the admin key header, because pages of other origins
            # must not administer the service.
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
        """Answer a preflight request (CORS).

        Raises:
            OriginRefusedError: the service does not allow the request.
        """
        response = super().preflight_response(request_headers)
        if response.status_code != 200:
            raise errors.OriginRefusedError(
                "The service does not allow the origin, the method or a header of this request.",
                headers={"Vary": response.headers["vary"]},
            )
        return response
