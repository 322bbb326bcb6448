"""A client of ``GET /stream``. docs/stream.md describes the protocol."""

from __future__ import annotations

import asyncio
import json
import random
from collections.abc import Sequence
from time import monotonic
from types import TracebackType
from typing import Any, Final, Self
from urllib.parse import urlsplit, urlunsplit

from pydantic import BaseModel
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from scene_client.calls import FormT, validated
from scene_client.errors import (
    ClientError,
    ProblemError,
    UnreachableError,
    problem_of,
    problem_text,
)
from scene_client.schemas import Detection
from scene_client.stream_messages import (
    EVENTS,
    AnswerMessage,
    Event,
    MergedScene,
    Open,
    Opened,
    Ping,
    ProblemMessage,
    StreamLimits,
    Update,
    Whole,
)

Objects = Sequence[str | dict[str, Any] | Detection]

_PATH: Final = "/stream"
_MAX_EVENT: Final = 64 * 2**20
# Close codes after which the client reconnects: the connection broke, or the service stopped or
# failed. After any other code, the service would close a new connection, too.
_TRANSIENT: Final = frozenset({1001, 1006, 1011, 1012, 1013})
_CAUSES: Final = {
    1000: "the program has closed the stream",
    1001: "the service shuts down",
    1006: "the connection broke",
    1007: "a message was not UTF-8",
    1009: "a message was too long",
    1011: "the service failed, or the client did not answer its pings",
    1012: "the service has shut down",
}
_FIRST_PAUSE: Final = 0.1
_LONGEST_PAUSE: Final = 5.0


class StreamProblemError(ClientError):
    """The service refused a message of the stream. The stream stays open.

    Attributes:
        problem: the problem document. The member `type` identifies the problem type.
        seq: sequence number of the refused message, or None if the message has no number.
    """

    def __init__(self, message: ProblemMessage) -> None:
        problem = self.problem = message.problem
        super().__init__(
            problem_text(
                problem.type, problem.status, problem.title, problem.detail, problem.errors or ()
            )
        )
        self.seq = message.seq


class StreamClosedError(ClientError):
    """The stream has ended.

    Attributes:
        code: WebSocket close code (RFC 6455, section 7.4), or 1006 if the connection broke.
        reason: reason that the service gave, such as `draining` or `stream-idle`, or "".
    """

    def __init__(self, code: int, reason: str, note: str = "") -> None:
        cause = reason or _CAUSES.get(code, "")
        super().__init__(f"the stream has ended with close code {code}: {cause}{note}")
        self.code = code
        self.reason = reason


class StreamClient:
    """A stream: the program sends changes of the scene and iterates over the newest answers.

        async with StreamClient("http://127.0.0.1:8000", room_type="bedroom") as scene:
            await scene.update(objects=["bed", {"id": "lamp_1", "label": "lamp"}])
            async for answer in scene:
                print(answer.missing.missing[0].label)

    The client keeps a copy of the scene. If the connection breaks, the iteration reconnects and
    sends the whole scene. After a `StreamProblemError`, the program may start a new iteration.

    Args:
        url: base URL of the service, with the scheme http, https, ws or wss.
        api_key: API key, if the service requires an API key.
        timeout: maximum time in seconds to connect, and to close the stream.
        reconnect: maximum time in seconds from the loss of the connection to the next answer.
            After this time, the client stops reconnecting.
        **fields: fields of the opening message, such as `model`, `ask`, `room_type` or `frame_id`.

    Attributes:
        seq: sequence number of the newest message that the client has sent.
        limits: limits of the service on messages and scenes.
        answer: newest answer that has arrived, or None before the first answer.
    """

    limits: StreamLimits

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float = 10.0,
        reconnect: float = 60.0,
        **fields: Any,
    ) -> None:
        parts = urlsplit(url)
        scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
        path = parts.path.rstrip("/").removesuffix(_PATH) + _PATH
        self._address = urlunsplit((scheme, parts.netloc, path, "", ""))
        self._headers = {} if api_key is None else {"X-API-Key": api_key}
        self._timeout = timeout
        self._patience = reconnect
        self._opening = validated(Open, {"type": "open", **fields})
        self._scene = MergedScene().after(self._opening)
        self._unanswered: dict[int, Update | Whole] = {}
        self._connection: ClientConnection | None = None
        self._ended: StreamClosedError | None = None
        self._lost_at: float | None = None
        self._pause = _FIRST_PAUSE
        self.seq = 0
        self.answer: AnswerMessage | None = None

    async def __aenter__(self) -> Self:
        """Connect and open the stream.

        Raises:
            UnreachableError: the service cannot be reached.
            ProblemError: the service refused the handshake.
            StreamProblemError: the service refused the opening message.
            StreamClosedError: the service closed the stream.
        """
        await self._connect()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the stream."""
        await self.close()

    # -- sending --------------------------------------------------------------------------------

    async def update(
        self, objects: Objects = (), *, remove: Sequence[str] = (), **fields: Any
    ) -> int:
        """Send added, changed and removed objects. Return the sequence number of the message.

        Args:
            objects: objects to add or to change. An object without an id has its label as id.
            remove: ids of objects to remove.
            **fields: other fields of the scene, such as `relations`, `room_type` or `stamp`.

        Raises:
            InvalidRequestError: the message is invalid. The client has not sent it.
            StreamClosedError: the stream has ended.
        """
        if remove:
            fields["remove"] = list(remove)
        return await self._next(_message(Update, "update", self.seq + 1, objects, fields))

    async def replace(self, objects: Objects, **fields: Any) -> int:
        """Send a whole scene in place of the previous one. Return the message's sequence number.

        Raises:
            InvalidRequestError, StreamClosedError: see `update`.
        """
        return await self._next(_message(Whole, "scene", self.seq + 1, objects, fields))

    async def ping(self) -> None:
        """Send a ping message, so that the service does not close an idle stream.

        Raises:
            StreamClosedError: the stream has ended.
        """
        await self._send(Ping(type="ping"))

    async def close(self) -> None:
        """End the stream and the iteration."""
        self._ended = self._ended or StreamClosedError(1000, "")
        if self._connection is not None:
            await self._connection.close()

    async def _next(self, message: Update | Whole) -> int:
        if self._ended is not None:
            raise self._ended
        self.seq = message.seq
        self._unanswered[message.seq] = message
        if not await self._send(message):
            self._merge(message.seq)
        return message.seq

    async def _send(self, message: BaseModel) -> bool:
        """Send a message. Return whether the connection has accepted the message."""
        if self._ended is not None:
            raise self._ended
        if self._connection is None:
            raise RuntimeError("the stream is not open: open it with `async with`")
        try:
            await self._connection.send(_text(message))
        except ConnectionClosed:
            return False
        return True

    def _merge(self, seq: int) -> None:
        """Merge all messages up to sequence number `seq` into the client's copy of the scene."""
        for number in [number for number in self._unanswered if number <= seq]:
            self._scene = self._scene.after(self._unanswered.pop(number))

    # -- receiving ------------------------------------------------------------------------------

    def __aiter__(self) -> Self:
        """Return the stream itself, which is an iterator over the arriving answers."""
        return self

    async def __anext__(self) -> AnswerMessage:
        """Wait for the next answer.

        Raises:
            StreamProblemError: the service refused a message.
            StreamClosedError: the service closed the stream, or the client could not reconnect.
            ProblemError: the service refused a new connection.
            StopAsyncIteration: the program has ended the stream by `close`.
        """
        if self._connection is None:
            raise RuntimeError("the stream is not open: open it with `async with`")
        while True:
            try:
                event = _event(await self._connection.recv())
            except ConnectionClosed as error:
                await self._reconnect(_closed(error))
                continue
            if isinstance(event, ProblemMessage):
                self._unanswered.pop(event.seq or 0, None)
                raise StreamProblemError(event)
            if isinstance(event, AnswerMessage):
                self._merge(event.seq)
                self.answer, self._lost_at, self._pause = event, None, _FIRST_PAUSE
                return event

    async def _reconnect(self, closed: StreamClosedError) -> None:
        """Connect again and send the whole scene. The pauses between attempts grow."""
        self._lost_at = self._lost_at or monotonic()
        failure: ClientError | None = None
        while self._ended is None:
            late = monotonic() + self._pause > self._lost_at + self._patience
            if late or closed.code not in _TRANSIENT:
                if failure is not None:
                    note = f"; no new connection within {self._patience:g} s: {failure}"
                    closed = StreamClosedError(closed.code, closed.reason, note)
                self._ended = closed
                raise closed from failure
            # The pause is random, so that many robots do not reconnect at the same time.
            await asyncio.sleep(self._pause * random.uniform(0.5, 1.0))  # noqa: S311 # nosec B311
            self._pause = min(2 * self._pause, _LONGEST_PAUSE)
            try:
                await self._connect()
            except (UnreachableError, StreamClosedError) as error:
                failure = error
            except ProblemError as refused:
                if refused.status not in {429, 503}:
                    raise
                failure = refused
            else:
                return
        if self._ended.code != 1000:
            raise self._ended
        raise StopAsyncIteration

    async def _connect(self) -> None:
        connection = await self._connected()
        try:
            async with asyncio.timeout(self._timeout):
                await connection.send(_text(self._opening))
                opened = _event(await connection.recv())
            if isinstance(opened, ProblemMessage):
                raise StreamProblemError(opened)
            if not isinstance(opened, Opened):
                raise TypeError(
                    f"the service must answer the opening message with opened, not {opened.type}"
                )
            sent = 0
            while sent != self.seq:  # the program may send messages during the loop
                sent = self.seq
                self._merge(sent)
                objects = list(self._scene.objects.values())
                scene = Whole(type="scene", seq=sent, objects=objects, **self._scene.fields)
                await connection.send(_text(scene))
        except BaseException as error:
            await connection.close()
            if isinstance(error, ConnectionClosed):
                raise _closed(error) from None
            if isinstance(error, TimeoutError):
                raise self._unreachable(f"no answer within {self._timeout:g} s") from None
            raise
        self.limits = opened.limits
        self._connection = connection
        if self._ended is not None:  # the program called `close` in the meantime
            await connection.close()

    async def _connected(self) -> ClientConnection:
        try:
            return await connect(
                self._address,
                additional_headers=self._headers,
                open_timeout=self._timeout,
                close_timeout=self._timeout,
                max_size=_MAX_EVENT,
                compression=None,
                proxy=None,
            )
        except InvalidStatus as refused:
            answer = refused.response
            headers = {name.lower(): value for name, value in answer.headers.raw_items()}
            raise problem_of(answer.status_code, headers, bytes(answer.body or b"")) from None
        except TimeoutError:
            raise self._unreachable(f"no answer within {self._timeout:g} s") from None
        except (OSError, InvalidHandshake) as error:
            raise self._unreachable(str(error)) from error

    def _unreachable(self, reason: str) -> UnreachableError:
        parts = urlsplit(self._address)
        # The message must not contain the user name and the password of the URL.
        host = parts.netloc.rpartition("@")[2]
        return UnreachableError(f"{parts.scheme}://{host}{parts.path}: {reason}")


def _message(
    kind: type[FormT], name: str, seq: int, objects: Objects, fields: dict[str, Any]
) -> FormT:
    return validated(kind, {"type": name, "seq": seq, "objects": list(objects), **fields})


def _text(message: BaseModel) -> str:
    return message.model_dump_json(exclude_unset=True)


def _event(text: str | bytes) -> Event:
    value = json.loads(text)
    return EVENTS[value["type"]].model_validate(value)


def _closed(error: ConnectionClosed) -> StreamClosedError:
    if error.rcvd is None:
        return StreamClosedError(1006, "")
    return StreamClosedError(error.rcvd.code, error.rcvd.reason)
