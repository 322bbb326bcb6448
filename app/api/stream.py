"""The WebSocket ``GET /stream``: clients send scene updates and get answers (docs/stream.md)."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from time import monotonic, thread_time
from typing import Any, Final

from fastapi import APIRouter
from pydantic import BaseModel, ValidationError
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.api import catalogue
from app.api.body import parse
from app.api.gateway import may_connect
from app.api.problems import ProblemError, answer, from_exception, unfit
from app.serving.answers import written
from app.serving.errors import ServingError
from app.serving.request import SUCCESS, Record, Request
from app.serving.runtime import Runtime
from app.serving.stream import Streams, StreamScene, TokenBucket
from app.settings import Settings
from scene_client.schemas import FieldError
from scene_client.stream_messages import (
    COMMANDS,
    MAX_SEQ,
    Command,
    Open,
    Opened,
    Ping,
    Pong,
    ProblemMessage,
    SceneMessage,
    StreamLimits,
)
from scene_client.validation import listed

PATH: Final = "/stream"
READING_SHARE: Final = 0.2
"""Maximum share of one core that the service uses to read the messages of one stream.

Above this share, the service reads the stream more slowly. The share limits the processor time
instead of the number of messages, because messages differ: a small update takes 0.05 ms, an invalid
update of 256 objects 36 ms.
"""
READING_BURST: Final = 1.0
"""Processor time in seconds that the service may spend on one burst of messages of a stream."""
LEAST_COST: Final = 0.25e-3
"""Minimum processor time in seconds that the limit counts for a message.

It covers the WebSocket frame and the answer.
"""

Closing = tuple[int, str]
"""Code and reason of a WebSocket close frame (RFC 6455, section 7.4)."""

router = APIRouter()


@router.get(PATH, include_in_schema=False)
async def plain_http() -> None:
    """Refuse a request that is not a WebSocket handshake."""
    raise ProblemError(
        catalogue.UPGRADE_REQUIRED,
        "This route only accepts WebSocket handshakes (RFC 6455).",
        headers={"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"},
    )


@router.websocket(PATH)
async def stream(socket: WebSocket) -> None:
    """Accept a WebSocket handshake and run the stream, or refuse the handshake."""
    streams: Streams = socket.app.state.streams
    refusal = _refusal(socket, streams)
    if refusal is not None:
        await answer(refusal, socket.scope, socket.receive, socket.send)
        return
    conversation = _Conversation(socket)
    with streams.place(conversation.end):
        await socket.accept()
        await conversation.run()


def _refusal(connection: HTTPConnection, streams: Streams) -> ProblemError | None:
    """Return the problem for a handshake that the service refuses, else None."""
    settings: Settings = connection.app.state.settings
    runtime: Runtime = connection.app.state.runtime
    if not may_connect(connection.headers, settings.cors_origins):
        return ProblemError(catalogue.ORIGIN_REFUSED, "Pages of this origin may not open a stream.")
    if runtime.draining:
        return ProblemError(catalogue.DRAINING, "The service is stopping and closes its streams.")
    if streams.is_full:
        return ProblemError(
            catalogue.TOO_MANY_STREAMS, f"The limit of {streams.limit} open streams is reached."
        )
    return None


class _Conversation:
    """One open stream, with a task that reads messages and a task that sends answers.

    The service never queues answers. While the service computes or sends an answer, new messages
    only update the scene. The next answer covers all these messages.
    """

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._settings: Settings = socket.app.state.settings
        self._runtime: Runtime = socket.app.state.runtime
        self._request_id: str = socket.state.request_id
        self._record: Record = socket.state.record
        self._counts = self._record.stream = {"messages": 0, "answers": 0, "superseded": 0}
        self._scene = StreamScene()
        self._is_open = False
        self._is_ending = False
        self._due = asyncio.Event()

    def end(self) -> None:
        """Close the stream after the answer in progress."""
        self._is_ending = True
        self._due.set()

    async def run(self) -> None:
        """Read messages and send answers until one of the two tasks ends, then close the stream."""
        listening = asyncio.create_task(self._listen())
        answering = asyncio.create_task(self._answer())
        closing = None
        try:
            await asyncio.wait((listening, answering), return_when=asyncio.FIRST_COMPLETED)
            closing = (listening if listening.done() else answering).result()
        except WebSocketDisconnect:
            pass
        finally:
            for task in (listening, answering):
                task.cancel()
            await asyncio.gather(listening, answering, return_exceptions=True)
        if closing is not None:
            self._counts["close_code"], self._record.outcome = closing
            with suppress(WebSocketDisconnect, TimeoutError):
                async with asyncio.timeout(self._settings.client_timeout):
                    await self._socket.close(*closing)

    # -- listening ------------------------------------------------------------------------------

    async def _listen(self) -> Closing | None:
        bucket = TokenBucket(READING_SHARE, READING_BURST)
        settings = self._settings
        while True:
            # Before the message `open`, the timeout is short. Otherwise, unopened connections could
            # use up the maximum number of streams.
            patience = settings.stream_idle if self._is_open else settings.client_timeout
            try:
                async with asyncio.timeout(patience):
                    event = await self._socket.receive()
            except TimeoutError:
                return 1008, "stream-idle"
            if event["type"] == "websocket.disconnect":
                self._counts["close_code"] = event["code"]
                return None
            self._counts["messages"] += 1
            began = thread_time()
            await self._hear(event)
            cost = max(LEAST_COST, thread_time() - began)
            # A packet may hold many messages. The sleep lets other tasks run between the messages.
            await asyncio.sleep(bucket.take(cost))

    async def _hear(self, event: Mapping[str, Any]) -> None:
        """Process one message. If the message is not acceptable, send a problem."""
        value, kind, seq, outcome = None, "-", None, SUCCESS
        try:
            value, kind, seq = _parsed(event)
            await self._obey(_command(kind, value))
        except (ProblemError, ServingError) as error:
            problem = from_exception(error, body=value)
            outcome = problem.kind.slug
            described = problem.describe(self._request_id)
            await self._send_model(ProblemMessage(seq=seq, problem=described))
        finally:
            self._runtime.metrics.stream_message(kind, outcome)

    async def _obey(self, command: Command) -> None:
        if isinstance(command, Ping):
            await self._send_model(Pong())
            return
        is_first = isinstance(command, Open)
        if is_first == self._is_open:
            raise _unfit(
                "the first message must have the type `open`, and later messages another type"
            )
        self._check_deadline(command)
        self._scene.take(command, self._request())
        if is_first:
            self._is_open = True
            await self._send_model(self._opened())
        if command.objects or not is_first:
            self._due.set()

    def _check_deadline(self, message: SceneMessage) -> None:
        most = self._settings.max_request_timeout_ms
        if (message.timeout_ms or 0) > most:
            raise _unfit(f"`timeout_ms` must be at most {most} milliseconds", "timeout_ms")

    def _opened(self) -> Opened:
        settings = self._settings
        limits = StreamLimits(
            max_message_bytes=settings.max_body_bytes,
            max_objects=settings.max_objects,
            max_relations=settings.max_relations,
            timeout_ms=settings.request_timeout_ms,
            idle_seconds=settings.stream_idle,
        )
        return Opened(request_id=self._request_id, limits=limits)

    # -- answering ------------------------------------------------------------------------------

    async def _answer(self) -> Closing:
        while True:
            await self._due.wait()
            if self._is_ending:
                return 1001, catalogue.DRAINING.slug
            self._due.clear()
            message, errors = await self._scene.answer(self._request())
            problems = {name: from_exception(error) for name, error in errors.items()}
            if problems:
                message["problems"] = {
                    name: problem.describe(self._request_id) for name, problem in problems.items()
                }
            outcome = next((problem.kind.slug for problem in problems.values()), SUCCESS)
            self._counts["answers"] += 1
            self._counts["superseded"] += message["superseded"]
            self._runtime.metrics.stream_answered(outcome, message["superseded"])
            await self._send(written(message).decode())

    def _request(self) -> Request:
        """Return a request that uses the current snapshot of the models.

        After an alias gets a new target, the next answer already uses the new target.
        """
        timeout = self._scene.timeout_ms or self._settings.request_timeout_ms
        return self._runtime.request(monotonic() + timeout / 1e3, self._request_id, self._record)

    # -- sending --------------------------------------------------------------------------------

    async def _send_model(self, message: BaseModel) -> None:
        await self._send(message.model_dump_json(exclude_none=True))

    async def _send(self, text: str) -> None:
        """Send a message. If the client does not read it in time, treat the client as gone."""
        try:
            async with asyncio.timeout(self._settings.client_timeout):
                await self._socket.send_text(text)
        except TimeoutError:
            raise WebSocketDisconnect(1006) from None


def _parsed(event: Mapping[str, Any]) -> tuple[Any, str, int | None]:
    """Parse a message. Return its value, its type and its sequence number.

    A missing or unknown type is returned as "-", and a missing or invalid number as None.
    """
    text = event.get("text")
    if text is None:
        raise ProblemError(
            catalogue.UNSUPPORTED_MEDIA_TYPE,
            "The message is a binary frame. Send JSON in text frames.",
        )
    value = parse(text.encode())
    fields = value if isinstance(value, dict) else {}
    kind, seq = fields.get("type"), fields.get("seq")
    if not isinstance(kind, str) or kind not in COMMANDS:
        kind = "-"
    return value, kind, seq if type(seq) is int and 0 < seq <= MAX_SEQ else None


def _command(kind: str, value: Any) -> Command:
    form = COMMANDS.get(kind)
    if form is None:
        raise _unfit(f"must be {listed(COMMANDS, 'or')}")
    try:
        return form.model_validate(value)
    except ValidationError as error:
        raise unfit(error, value, form) from None


def _unfit(message: str, field: str = "type") -> ProblemError:
    fault = FieldError(pointer=f"#/{field}", message=message)
    detail = "The message has 1 error, listed in `errors`."
    return ProblemError(catalogue.INVALID_REQUEST, detail, errors=[fault])
