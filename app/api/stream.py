"""The WebSocket: messages in, what changed out. docs/stream.md is its contract."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final, cast

from fastapi import APIRouter
from pydantic import BaseModel, ValidationError
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.api import catalogue
from app.api.body import parse
from app.api.catalogue import ProblemType
from app.api.middleware.origins import may_connect
from app.api.problems import ProblemError, answer, from_exception, unfit
from app.messages import (
    COMMANDS,
    AnswerMessage,
    Close,
    Closed,
    Command,
    Get,
    Open,
    Opened,
    Ping,
    Pong,
    ProblemMessage,
    SceneMessage,
    StreamLimits,
)
from app.schemas import FieldError
from app.serving.errors import ServingError
from app.serving.queue import Ticket
from app.serving.record import SUCCESS, RequestRecord
from app.serving.runtime import Runtime
from app.serving.session import Session
from app.serving.stream import Ending, Streams, StreamSession
from app.settings import Settings

PATH: Final = "/stream"

router = APIRouter()


@router.get(PATH, include_in_schema=False)
async def plain_http() -> None:
    """Who asks in HTTP, or whose handshake is none, learns what this address is for."""
    raise ProblemError(
        catalogue.UPGRADE_REQUIRED,
        "Ask for a WebSocket (RFC 6455).",
        headers={"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"},
    )


@router.websocket(PATH)
async def stream(socket: WebSocket) -> None:
    """Scene updates in, changed answers out."""
    settings: Settings = socket.app.state.settings
    streams: Streams = socket.app.state.streams
    refusal = _refusal(socket, settings, streams)
    if refusal is not None:
        await answer(refusal, socket.scope, socket.receive, socket.send)
        return
    talk = _Conversation(socket, settings, socket.app.state.runtime, streams)
    with streams.place(talk.end):
        await socket.accept()
        await talk.run()


def _refusal(
    connection: HTTPConnection, settings: Settings, streams: Streams
) -> ProblemError | None:
    """Why a stream does not begin, if it does not."""
    if not may_connect(connection.headers, settings.cors_origins):
        return ProblemError(catalogue.ORIGIN_REFUSED, "No page of this origin may open a stream.")
    runtime: Runtime = connection.app.state.runtime
    if runtime.draining:
        return ProblemError(catalogue.DRAINING, "The service ends its streams.")
    if streams.is_full:
        return ProblemError(catalogue.TOO_MANY_STREAMS, f"{streams.limit} streams are open.")
    return None


@dataclass(frozen=True, slots=True)
class _Farewell:
    """How a stream ends.

    Attributes:
        code: of the close (RFC 6455, section 7.4); None where the client has gone.
        kind: the problem that is told first, if there is one.
    """

    code: int | None
    kind: ProblemType | None = None
    detail: str = ""


_GONE: Final = _Farewell(None)
_FAREWELLS: Final = {
    Ending.DRAINING: _Farewell(1001, catalogue.DRAINING, "The service is ending."),
    Ending.REPLACED: _Farewell(
        1008, catalogue.SESSION_RESUMED, "Another stream has resumed this session."
    ),
}


class _Conversation:
    """One open stream: a task that listens, and a task that answers about the newest scene.

    Nothing is ever queued for the client: while an answer is computed or sent, what comes is merged
    into the scene, and the next answer is about the scene as it is then.
    """

    def __init__(
        self, socket: WebSocket, settings: Settings, runtime: Runtime, streams: Streams
    ) -> None:
        self._socket = socket
        self._settings = settings
        self._runtime = runtime
        self._streams = streams
        self._request_id: str = socket.state.request_id
        self._record: RequestRecord = socket.state.record
        self._counts = {"messages": 0, "answers": 0, "superseded": 0}
        self._session: StreamSession | None = None
        self._keep = True
        self._ending: Ending | None = None
        self._due = asyncio.Event()

    def end(self, ending: Ending) -> None:
        """Let it end after the answer under way."""
        self._ending = self._ending or ending
        self._due.set()

    async def run(self) -> None:
        """Until either side has had enough."""
        listening = asyncio.create_task(self._listen())
        answering = asyncio.create_task(self._answer())
        farewell = _GONE
        try:
            await asyncio.wait((listening, answering), return_when=asyncio.FIRST_COMPLETED)
            farewell = (listening if listening.done() else answering).result()
        except WebSocketDisconnect:
            pass
        finally:
            if self._session is not None:
                self._streams.part(self._session, self.end, keep=self._keep)
            for task in (listening, answering):
                task.cancel()
            await asyncio.gather(listening, answering, return_exceptions=True)
            self._record.stream |= self._counts
        await self._say(farewell)

    async def _say(self, farewell: _Farewell) -> None:
        if farewell.code is None:
            return
        self._record.stream["close_code"] = farewell.code
        try:
            if farewell.kind is not None:
                self._record.outcome = farewell.kind.slug
                await self._send_problem(ProblemError(farewell.kind, farewell.detail))
            await self._socket.close(farewell.code, farewell.kind.slug if farewell.kind else None)
        except WebSocketDisconnect:
            pass

    # -- listening ------------------------------------------------------------------------------

    async def _listen(self) -> _Farewell:
        settings = self._settings
        while True:
            # A stream that nobody opens takes a place, as a request whose body does not come.
            patience = settings.client_timeout if self._session is None else settings.stream_idle
            try:
                async with asyncio.timeout(patience):
                    event = await self._socket.receive()
            except TimeoutError:
                detail = f"No message came within {patience:g} seconds."
                return _Farewell(1008, catalogue.STREAM_IDLE, detail)
            if event["type"] == "websocket.disconnect":
                return _GONE
            self._counts["messages"] += 1
            if await self._hear(event):
                return _Farewell(1000)
            # What came in one packet is at hand: others have their turns in between.
            await asyncio.sleep(0)

    async def _hear(self, event: Any) -> bool:
        """Do what one message says; whether it was the last."""
        kind, seq, outcome = "-", None, SUCCESS
        try:
            value = _value(event)
            kind, seq = _kind(value), _seq(value)
            await self._obey(_command(kind, value))
        except (ProblemError, ServingError) as error:
            problem = from_exception(error)
            outcome = problem.kind.slug
            await self._send_problem(problem, seq)
        finally:
            self._runtime.metrics.stream_message(kind if kind in COMMANDS else "-", outcome)
        return kind == "close" and outcome == SUCCESS

    async def _obey(self, command: Command) -> None:
        match command:
            case Open():
                await self._open(command)
            case Ping():
                await self._send(Pong())
            case Close():
                self._keep = False
                await self._send(Closed())
            case _ if self._session is None:
                raise _unfit("#/type", "the first message must be open")
            case Get():
                self._session.start_over()
                self._due.set()
            case SceneMessage():
                self._session.take(command, self._view(self._session))
                self._due.set()

    async def _open(self, command: Open) -> None:
        if self._session is not None:
            raise _unfit("#/type", "this stream is open already")
        found = None if command.session is None else self._streams.find(command.session)
        session = found or StreamSession()
        session.take(command, self._view(session))
        # What of the last answers has arrived is not known.
        session.start_over()
        self._streams.bind(session, self.end)
        self._session = session
        settings = self._settings
        await self._send(
            Opened(
                session=session.id,
                resumed=found is not None,
                seq=session.seq,
                revision=session.revision,
                request_id=self._request_id,
                limits=StreamLimits(
                    max_message_bytes=settings.max_body_bytes,
                    max_objects=settings.max_objects,
                    max_relations=settings.max_relations,
                    timeout_ms=settings.request_timeout_ms,
                    idle_seconds=settings.stream_idle,
                    resume_seconds=settings.stream_resume,
                ),
            )
        )
        if session.state.objects:
            self._due.set()

    # -- answering ------------------------------------------------------------------------------

    async def _answer(self) -> _Farewell:
        while True:
            await self._due.wait()
            if self._ending is not None:
                return _FAREWELLS[self._ending]
            self._due.clear()
            session = cast("StreamSession", self._session)
            seq = session.seq
            try:
                message, failures = await session.answer(self._view(session))
            except ServingError as error:
                problem = from_exception(error)
                self._runtime.metrics.stream_answered(problem.kind.slug, 0)
                await self._send_problem(problem, seq)
            else:
                problems = {
                    name: from_exception(error).describe(self._request_id)
                    for name, error in failures.items()
                }
                await self._send_answer(message.model_copy(update={"problems": problems}))

    async def _send_answer(self, message: AnswerMessage) -> None:
        self._counts["answers"] += 1
        self._counts["superseded"] += message.superseded
        self._runtime.metrics.stream_answered(SUCCESS, message.superseded)
        await self._send(message)

    def _view(self, session: StreamSession) -> Session:
        """The service as it is now: a model that was swapped meanwhile answers next."""
        timeout = session.state.timeout_ms or self._settings.request_timeout_ms
        ticket = Ticket(monotonic() + timeout / 1e3)
        return self._runtime.session(self._request_id, ticket, self._record)

    # -- sending --------------------------------------------------------------------------------

    async def _send_problem(self, problem: ProblemError, seq: int | None = None) -> None:
        passing = problem.status_code in (429, 503)
        await self._send(
            ProblemMessage(
                seq=seq,
                retry_after=self._settings.retry_after if passing else None,
                problem=problem.describe(self._request_id),
            )
        )

    async def _send(self, message: BaseModel) -> None:
        # Waits while the client does not read; the connection is cut off where that takes too long.
        await self._socket.send_text(message.model_dump_json(exclude_none=True))


def _value(event: Any) -> Any:
    text = event.get("text")
    if text is None:
        raise ProblemError(catalogue.UNSUPPORTED_MEDIA_TYPE, "Messages are JSON in text frames.")
    return parse(text.encode())


def _kind(value: Any) -> str:
    kind = value.get("type") if isinstance(value, dict) else None
    return kind if isinstance(kind, str) else "-"


def _seq(value: Any) -> int | None:
    """The number of a message, if it has one that could be right."""
    seq = value.get("seq") if isinstance(value, dict) else None
    return seq if type(seq) is int and 0 < seq < 2**53 else None


def _command(kind: str, value: Any) -> Command:
    form = COMMANDS.get(kind)
    if form is None:
        raise _unfit("#/type", "must be " + ", ".join(COMMANDS))
    try:
        return form.model_validate(value)
    except ValidationError as error:
        raise unfit(error, value) from None


def _unfit(pointer: str, message: str) -> ProblemError:
    detail = "The message has 1 fault; see errors."
    fault = FieldError(pointer=pointer, message=message)
    return ProblemError(catalogue.INVALID_REQUEST, detail, errors=[fault])
