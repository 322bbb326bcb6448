"""The steps of a request before its route: ASGI middleware with one concern each.

A request passes the steps in the order of this module. `Turn` is the last step before the route.
Every answer takes a turn, also a refusal of an earlier step and the answer to a health check.
Otherwise, a client with many of them would take the time of all others.
"""

import hmac
import logging
import re
from asyncio import CancelledError
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic, perf_counter
from typing import Final
from uuid import uuid4

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import errors
from app.api.problems import answer, from_exception
from app.questions import QUESTIONS
from app.serving.admission import SMALL, Admission, Bodies, Lane, Ticket
from app.serving.models import NO_MODELS, Key
from app.serving.runtime import Runtime
from app.settings import Settings

API_KEY: Final = "X-API-Key"
TIMEOUT_HEADER: Final = "X-Request-Timeout-Ms"

HEALTH: Final = frozenset(("/health/live", "/health/ready"))
"""Routes of health checks. They accept every Host header, and no queue is too full for them."""

# Paths that need no API key. Orchestrators send health checks without credentials. The HTML pages
# contain no private data. docs/security.md gives the reasons.
OPEN_ROUTES: Final = HEALTH | {"/", "/docs", "/redoc", "/openapi.json", "/problems"}
_OPEN_FOLDERS: Final = ("/docs/", "/redoc/", "/static/", "/problems/")

_HOST: Final = re.compile(rb"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")
_ADDRESS: Final = re.compile(rb"\[.+\]|[0-9]{1,3}(\.[0-9]{1,3}){3}")

_REQUEST_ID: Final = re.compile(rb"[A-Za-z0-9._~:-]{1,128}")

# These headers stop browsers from guessing the media type and from sending a Referer.
_ALWAYS: Final = ((b"x-content-type-options", b"nosniff"), (b"referrer-policy", b"no-referrer"))
_POLICY: Final = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'")
_NOT_KEPT: Final = (b"cache-control", b"no-store")

_TIMEOUT: Final = re.compile(rb"[1-9][0-9]{0,5}")
_WITH_BODY: Final = frozenset(("POST", "PUT", "PATCH"))
# Routes whose bodies may be larger than one scene.
_LARGE: Final = frozenset(("/scenes", *(f"/{question.name}/batch" for question in QUESTIONS)))

_access = logging.getLogger("app.access")


def gateway(app: ASGIApp, settings: Settings, runtime: Runtime) -> ASGIApp:
    """Return the application behind its steps. The last line is the first step of a request."""
    steps: ASGIApp = Turn(app, runtime.admission)
    steps = Size(steps, settings, runtime.bodies)
    steps = Deadline(steps, settings, runtime)
    if settings.api_key is not None:
        steps = KeyCheck(steps, settings.api_key)
    steps = Failures(steps, runtime.admission.quick)
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
        steps = HostCheck(steps, names, runtime.admission.quick)
    return Recorded(steps, app, settings, runtime)


SUCCESS: Final = "success"


@dataclass(slots=True)
class Record:
    """Values of a request for log and metrics. The gateway reads them after the response."""

    outcome: str = SUCCESS  # or the slug of the problem type in the response
    status: int = 0  # HTTP status; 0 before the response starts
    models: set[Key] = field(default_factory=set)  # models that the request used
    queue_seconds: float | None = None  # total time that scenes waited; None without a model
    compute_seconds: float | None = None  # total time that models computed; None without a model

    def log_fields(self) -> dict[str, str | float]:
        """Return the fields for the access log line, and the model if the request used only one."""
        entry: dict[str, str | float] = {"outcome": self.outcome}
        if len(self.models) == 1:
            ((entry["model"], entry["version"]),) = self.models
        if self.queue_seconds is not None:
            entry["queue_ms"] = round(self.queue_seconds * 1e3, 3)
        if self.compute_seconds is not None:
            entry["compute_ms"] = round(self.compute_seconds * 1e3, 3)
        return entry


class Recorded:
    """Complete the headers of each response, and record the request in metrics and access log.

    Later steps find in ``scope["state"]`` the `Record`, the `Ticket`, the request id, and the path
    below the root path of the service. The client may choose the request id: 1 to 128 unreserved
    URI characters or colons. The application ``other`` gets everything but requests, such as the
    service's start.
    """

    def __init__(self, app: ASGIApp, other: ASGIApp, settings: Settings, runtime: Runtime) -> None:
        self._app, self._other, self._runtime = app, other, runtime
        self._has_log = settings.access_log
        self._seconds = settings.request_timeout_ms / 1e3

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
        client = (scope.get("client") or ("",))[0]
        is_gone = Request(scope, receive).is_disconnected
        ticket = Ticket(client, monotonic() + self._seconds, is_gone)
        scope.setdefault("state", {}).update(
            request_id=request_id.decode(),
            record=record,
            ticket=ticket,
            path=scope["path"].removeprefix(scope.get("root_path", "")),
        )

        async def send_completed(message: Message) -> None:
            """Send a message to the client. The start of a response gets further headers."""
            if message["type"] == "http.response.start":
                ticket.leave()
                record.status = message["status"]
                completed = [*message.get("headers", ()), *_ALWAYS, (b"x-request-id", request_id)]
                names = {name for name, _ in completed}
                if b"content-security-policy" not in names:
                    completed.append(_POLICY)
                if not names & {b"cache-control", b"etag"}:
                    completed.append(_NOT_KEPT)
                # While draining, the client's next request must go to another replica. After a
                # request to upgrade, the parser would read its body as the next request.
                if self._runtime.draining or upgrades:
                    completed.append((b"connection", b"close"))
                message["headers"] = completed
            await send(message)

        try:
            await self._app(scope, receive, send_completed)
        except CancelledError:  # the server shuts down
            record.outcome = "cancelled"
            raise
        finally:
            ticket.leave()
            # The ticket refers to the scope: without this deletion, they form a reference cycle.
            del scope["state"]["ticket"]
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


class HostCheck:
    """Refuse requests whose Host header does not name this service.

    This check prevents DNS rebinding, where an attacker points the host name of a web page at this
    machine. That attack needs a name, so every IP address is accepted.
    """

    def __init__(self, app: ASGIApp, names: frozenset[str], lane: Lane) -> None:
        self._app, self._lane = app, lane
        self._names = frozenset(name.encode("ascii") for name in names)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an accepted request on, or answer with status 421."""
        hosts = [value for name, value in scope["headers"] if name == b"host"]
        host = _HOST.fullmatch(hosts[0].lower()) if len(hosts) == 1 else None
        is_named = host is not None and (host[1] in self._names or _ADDRESS.fullmatch(host[1]))
        if is_named or scope["state"]["path"] in HEALTH:
            await self._app(scope, receive, send)
            return
        detail = (
            "The service does not know the name in the Host header. Use its IP address, or list "
            "the name in SCENE_ALLOWED_HOSTS (docs/network.md)."
        )
        await _refuse(errors.HostRefusedError(detail), self._lane, scope, receive, send)


async def _refuse(
    error: errors.ServiceError, lane: Lane, scope: Scope, receive: Receive, send: Send
) -> None:
    """Answer with a problem, in a turn of a lane that is never too full, but may end too late."""
    ticket: Ticket = scope["state"]["ticket"]
    if not ticket.had_turn:
        with suppress(errors.DeadlinePassedError):
            await ticket.enter(lane, 0)
    await answer(error, scope, receive, send)


class Failures:
    """Answer every failure with a problem document."""

    def __init__(self, app: ASGIApp, lane: Lane) -> None:
        self._app, self._lane = app, lane

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request. If its response has begun, raise the error to close the connection."""
        try:
            await self._app(scope, receive, send)
        except Exception as error:  # noqa: BLE001 - _fail() answers and logs every error
            await _fail(error, self._lane, scope, receive, send)


async def _fail(error: Exception, lane: Lane, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a failure, or raise it again if a part of the response has been sent already.

    A variable of the caller's frame must not refer to the error: that cycle would keep the body.
    """
    problem = from_exception(error, scope["state"]["request_id"])
    record: Record = scope["state"]["record"]
    if record.status:
        record.outcome, record.status = problem.slug, 500
        raise error
    await _refuse(problem, lane, scope, receive, send)


class KeyCheck:
    """Refuse requests without the API key, except for open routes."""

    def __init__(self, app: ASGIApp, key: SecretStr) -> None:
        self._app, self._key = app, key.get_secret_value().encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or raise UnauthorizedError if it lacks the key."""
        path, headers = scope["state"]["path"], Headers(scope=scope)
        scheme, _, token = headers.get("authorization", "").partition(" ")
        key = headers.get(API_KEY) or (token.strip() if scheme.lower() == "bearer" else "")
        # The comparison takes constant time. Otherwise the response time would show how many
        # characters match.
        has_key = hmac.compare_digest(key.encode(), self._key)
        if not (has_key or path in OPEN_ROUTES or path.startswith(_OPEN_FOLDERS)):
            raise errors.UnauthorizedError("This service needs its API key.")
        await self._app(scope, receive, send)


class Deadline:
    """Set the deadline that the client chose. Health checks ignore its header."""

    def __init__(self, app: ASGIApp, settings: Settings, runtime: Runtime) -> None:
        self._app, self._runtime = app, runtime
        self._longest = settings.max_request_timeout_ms

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            NotReadyError: the service is starting.
            BadRequestError: the time limit in the header of the request is invalid.
        """
        if scope["state"]["path"] not in HEALTH:
            if self._runtime.models is NO_MODELS:
                raise errors.NotReadyError("The service is starting.")
            for name, value in scope["headers"]:
                if name == b"x-request-timeout-ms":
                    scope["state"]["ticket"].deadline = monotonic() + self._seconds_of(value)
                    break
        await self._app(scope, receive, send)

    def _seconds_of(self, value: bytes) -> float:
        if not _TIMEOUT.fullmatch(value) or int(value) > self._longest:
            valid = f"a whole number from 1 to {self._longest} (milliseconds)"
            raise errors.BadRequestError(f"{TIMEOUT_HEADER} must be {valid}.")
        return int(value) / 1e3


class Size:
    """Read the body of each request, up to the limit of its route, into ``scope["state"]``."""

    def __init__(self, app: ASGIApp, settings: Settings, bodies: Bodies) -> None:
        self._app, self._bodies = app, bodies
        self._limit = settings.max_body_bytes
        self._limit_of_scene = min(settings.max_scene_bytes, self._limit)
        self._limit_of_home = min(2 * settings.max_scene_bytes, self._limit)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on. The errors are those of `Bodies.read`."""
        client, body = scope["state"]["ticket"].client, b""
        if scope["method"] in _WITH_BODY:
            path, limit = scope["state"]["path"], self._limit_of_scene
            if path in _LARGE:
                limit = self._limit
            elif path == "/where":
                limit = self._limit_of_home
            length = next((v for name, v in scope["headers"] if name == b"content-length"), b"")
            body = await self._bodies.read(receive, client, limit, length)
        scope["state"]["body"] = body
        try:
            await self._app(scope, receive, send)
        finally:
            self._bodies.add(client, -len(body))


class Turn:
    """Let each request wait for its turn, which ends when its response starts."""

    def __init__(self, app: ASGIApp, admission: Admission) -> None:
        self._app, self._quick, self._slow = app, admission.quick, admission.slow

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            QueueFullError: too many requests of the client, or of all clients, are waiting.
            DeadlinePassedError: the deadline passed while the request was waiting.
        """
        state = scope["state"]
        lane = self._slow if len(state["body"]) > SMALL else self._quick
        await state["ticket"].enter(lane, 0 if state["path"] in HEALTH else 1)
        await self._app(scope, receive, send)
