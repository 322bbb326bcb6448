"""The steps that give a request its deadline, its body and its turn."""

import re
from time import monotonic
from typing import Final

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import errors
from app.api.access import HEALTH, TIMEOUT_HEADER, route_path
from app.questions import QUESTIONS
from app.serving.admission import SMALL, Admission, Bodies, Ticket
from app.serving.models import NO_MODELS
from app.serving.runtime import Runtime
from app.settings import Settings

_TIMEOUT: Final = re.compile(rb"[1-9][0-9]{0,5}")
_WITH_BODY: Final = frozenset(("POST", "PUT", "PATCH"))
# Routes whose bodies may be larger than one scene.
_LARGE: Final = frozenset(("/scenes", *(f"/{question.name}/batch" for question in QUESTIONS)))


class Deadline:
    """Give each request a ticket with its deadline, in ``scope["state"]``, except health checks."""

    def __init__(self, app: ASGIApp, health: ASGIApp, settings: Settings, runtime: Runtime) -> None:
        self._app, self._health, self._runtime = app, health, runtime
        self._seconds = settings.request_timeout_ms / 1e3
        self._longest = settings.max_request_timeout_ms

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            NotReadyError: the service is starting.
            BadRequestError: the time limit in the header of the request is invalid.
        """
        if route_path(scope) in HEALTH:
            await self._health(scope, receive, send)
            return
        if self._runtime.models is NO_MODELS:
            raise errors.NotReadyError("The service is starting.")
        stated = [value for name, value in scope["headers"] if name == b"x-request-timeout-ms"]
        seconds = self._seconds_of(stated[0]) if stated else self._seconds
        client = (scope.get("client") or ("",))[0]
        is_gone = Request(scope, receive).is_disconnected
        scope["state"]["ticket"] = Ticket(client, monotonic() + seconds, is_gone)
        try:
            await self._app(scope, receive, send)
        finally:
            # The ticket refers to the scope: without this deletion, they form a reference cycle.
            del scope["state"]["ticket"]

    def _seconds_of(self, value: bytes) -> float:
        if not _TIMEOUT.fullmatch(value) or int(value) > self._longest:
            detail = (
                f"{TIMEOUT_HEADER} must be a whole number from 1 to {self._longest} (milliseconds)."
            )
            raise errors.BadRequestError(detail)
        return int(value) / 1e3


class Size:
    """Read the body of each request, up to the limit of its route, into ``scope["state"]``."""

    def __init__(self, app: ASGIApp, settings: Settings, bodies: Bodies) -> None:
        self._app, self._bodies = app, bodies
        self._limit = settings.max_body_bytes
        self._limit_of_scene = min(settings.max_scene_bytes, self._limit)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on. The errors are those of `Bodies.read`."""
        client, body = scope["state"]["ticket"].client, b""
        if scope["method"] in _WITH_BODY:
            limit = self._limit if route_path(scope) in _LARGE else self._limit_of_scene
            length = next((v for name, v in scope["headers"] if name == b"content-length"), b"")
            body = await self._bodies.read(receive, client, limit, length)
        scope["state"]["body"] = body
        try:
            await self._app(scope, receive, send)
        finally:
            self._bodies.release(client, len(body))


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
        ticket: Ticket = scope["state"]["ticket"]

        async def send_after_turn(message: Message) -> None:
            ticket.leave()
            await send(message)

        try:
            if len(scope["state"]["body"]) > SMALL:
                await ticket.enter(self._slow, 1)
            elif self._quick.is_full(ticket.client, 1):
                # A refusal takes a turn, too. Otherwise refusals of one client would take the time
                # of all others.
                await ticket.enter(self._quick, 0)
                raise errors.QueueFullError("Too many requests of this client are waiting.")
            else:
                await ticket.enter(self._quick, 1)
            await self._app(scope, receive, send_after_turn)
        finally:
            ticket.leave()
