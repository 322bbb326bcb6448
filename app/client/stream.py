"""A client of ``GET /stream`` that keeps the whole answers; docs/stream.md is the contract."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self, TypeVar
from urllib.parse import urlsplit, urlunsplit

from pydantic import BaseModel, TypeAdapter
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from app.changes import Entry, applied
from app.client.errors import ClientError, UnreachableError
from app.client.exchange import Received, problem_of
from app.messages import (
    EVENTS,
    AnswerMessage,
    Close,
    Event,
    Get,
    Open,
    Opened,
    Ping,
    ProblemMessage,
    StreamLimits,
    Update,
    Whole,
)
from app.schemas import (
    Detection,
    Disagreement,
    ExpectedRelation,
    MisplacedRelation,
    MissingObject,
    ModelReference,
    ObservedRelation,
    Outlier,
    Problem,
)

T = TypeVar("T")
Objects = Sequence[str | dict[str, Any] | Detection]

_PATH = "/stream"
_MOST = 64 * 2**20


class StreamProblemError(ClientError):
    """The service refused a message, or could not answer it; the stream goes on.

    Attributes:
        problem: what it says of it; branch on its `type`.
        seq: of the message, where it had one.
        retry_after: seconds to wait before asking again, where that helps.
    """

    def __init__(self, message: ProblemMessage) -> None:
        super().__init__(f"{message.problem.title}: {message.problem.detail}")
        self.problem: Problem = message.problem
        self.seq = message.seq
        self.retry_after = message.retry_after


class StreamClosedError(ClientError):
    """The stream ended without having been closed from here; its session may be resumed.

    Attributes:
        code: of the close (RFC 6455, section 7.4); 1006 where the connection just broke.
        reason: the last part of a problem's type, where the service gave one.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"closed with {code} {reason}".rstrip())
        self.code = code
        self.reason = reason


class StreamClient:
    """One stream: send what changed, and iterate over the answers.

        async with StreamClient("http://127.0.0.1:8000", room_type="bedroom") as scene:
            await scene.update(objects=["bed", {"id": "lamp_1", "label": "lamp"}])
            async for answer in scene:
                print(answer.alarms.raised, scene.missing[0].label)

    Iterating yields what has changed, after it has been worked into the whole answers that the
    client keeps; `StreamProblemError` can be caught, and the iteration begun again.

    Args:
        url: of the service, with http, https, ws or wss.
        api_key: of a service that asks for one.
        session: id of a session to resume; what is left of it, `resumed` tells.
        timeout: seconds for connecting, and for closing.
        **fields: of the opening message: `model`, `ask`, `room_type`, `frame_id` and so on.

    Attributes:
        session: id of the session.
        resumed: whether the service still had it; if not, send the whole scene.
        seq: of the newest message that was sent, or that a resumed session had taken.
        limits: what the service allows.
        model: which model gave the newest answer; None before.
        revision: of the newest answer.
        lists: the whole answers' lists by name, as JSON has them.
    """

    session: str
    resumed: bool
    limits: StreamLimits

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        session: str | None = None,
        timeout: float = 10.0,
        **fields: Any,
    ) -> None:
        parts = urlsplit(url)
        scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
        path = parts.path.rstrip("/").removesuffix(_PATH) + _PATH
        self._address = urlunsplit((scheme, parts.netloc, path, "", ""))
        self._headers = {} if api_key is None else {"X-API-Key": api_key}
        self._timeout = timeout
        if session is not None:
            fields["session"] = session
        self._opening = Open(type="open", **fields)
        self._connection: ClientConnection | None = None
        self._ending = AsyncExitStack()
        self.seq = 0
        self.revision = 0
        self.model: ModelReference | None = None
        self.lists: dict[str, list[Entry]] = {}

    async def __aenter__(self) -> Self:
        """Connect and open.

        Raises:
            UnreachableError: the service cannot be reached.
            ProblemError: it refused the handshake.
            StreamProblemError: it refused the opening.
        """
        async with AsyncExitStack() as stack:
            self._connection = await self._connected(stack)
            await self._send(self._opening)
            opened = await self._receive()
            if not isinstance(opened, Opened):
                raise TypeError(f"the stream was opened with {opened.type}")
            self._ending = stack.pop_all()
        self.session, self.resumed = opened.session, opened.resumed
        self.seq, self.revision, self.limits = opened.seq, opened.revision, opened.limits
        return self

    async def _connected(self, stack: AsyncExitStack) -> ClientConnection:
        try:
            return await stack.enter_async_context(
                connect(
                    self._address,
                    additional_headers=self._headers,
                    open_timeout=self._timeout,
                    close_timeout=self._timeout,
                    max_size=_MOST,
                    compression=None,
                    proxy=None,
                )
            )
        except InvalidStatus as refused:
            answer = refused.response
            headers = {name.lower(): value for name, value in answer.headers.raw_items()}
            raise problem_of(
                Received(answer.status_code, headers, bytes(answer.body or b""))
            ) from None
        except (OSError, InvalidHandshake) as error:
            raise UnreachableError(f"no stream at {self._address}: {error}") from error

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect; the session stays for a while unless `close` was called."""
        await self._ending.aclose()

    # -- sending --------------------------------------------------------------------------------

    async def update(
        self, objects: Objects = (), *, remove: Sequence[str] = (), **fields: Any
    ) -> int:
        """Tell of objects added, moved or changed, and removed; the number of the message.

        Args:
            objects: each with an id, or its label for one.
            remove: ids.
            **fields: of the scene: `relations`, `room_type`, `stamp` and so on.

        Raises:
            pydantic.ValidationError: this is no message; nothing was sent.
            StreamClosedError: the stream has ended.
        """
        if remove:
            fields["remove"] = list(remove)
        things: list[Any] = list(objects)
        message = Update(type="update", seq=self.seq + 1, objects=things, **fields)
        return await self._next(message)

    async def replace(self, objects: Objects, **fields: Any) -> int:
        """Tell the whole scene anew; the number of the message.

        Raises:
            pydantic.ValidationError, StreamClosedError: see `update`.
        """
        things: list[Any] = list(objects)
        return await self._next(Whole(type="scene", seq=self.seq + 1, objects=things, **fields))

    async def get(self) -> None:
        """Ask for whole answers."""
        await self._send(Get(type="get"))

    async def ping(self) -> None:
        """Give a sign of life, so that a quiet stream stays."""
        await self._send(Ping(type="ping"))

    async def close(self) -> None:
        """Let the service forget the session; the iteration ends when it has."""
        await self._send(Close(type="close"))

    async def _next(self, message: Update | Whole) -> int:
        await self._send(message)
        self.seq = message.seq
        return message.seq

    async def _send(self, message: BaseModel) -> None:
        try:
            await self._there.send(message.model_dump_json(exclude_unset=True))
        except ConnectionClosed as error:
            raise _closed(error) from None

    # -- receiving ------------------------------------------------------------------------------

    def __aiter__(self) -> Self:
        """The answers as they come."""
        return self

    async def __anext__(self) -> AnswerMessage:
        """The next answer.

        Raises:
            StreamProblemError: the service has refused a message; see there.
            StreamClosedError: the stream has ended, and not because it was closed.
            StopAsyncIteration: it was closed.
        """
        while True:
            try:
                event = await self._receive()
            except StreamClosedError as closed:
                if closed.code == 1000:
                    raise StopAsyncIteration from None
                raise
            if isinstance(event, AnswerMessage):
                self._apply(event)
                return event

    async def _receive(self) -> Event:
        try:
            value = json.loads(await self._there.recv())
        except ConnectionClosed as error:
            raise _closed(error) from None
        event = EVENTS[value["type"]].model_validate(value)
        if isinstance(event, ProblemMessage):
            raise StreamProblemError(event)
        return event

    def _apply(self, answer: AnswerMessage) -> None:
        if not answer.full and answer.revision != self.revision + 1:
            raise LookupError(f"answer {answer.revision} came after {self.revision}")
        before = {} if answer.full else self.lists
        self.lists = applied(before, answer.changes, answer.dropped)
        self.revision, self.model = answer.revision, answer.model

    # -- the whole answers ----------------------------------------------------------------------

    @property
    def missing(self) -> list[MissingObject]:
        """As `POST /missing` gives them, likeliest first; empty where it was not asked."""
        return self._parsed("missing", list[MissingObject])

    @property
    def outliers(self) -> list[Outlier]:
        """As `POST /outliers` gives them: every object, least fitting first."""
        return self._parsed("outliers", list[Outlier])

    @property
    def misplaced(self) -> list[MisplacedRelation]:
        """As `POST /outliers` gives them, least likely first."""
        return self._parsed("misplaced", list[MisplacedRelation])

    @property
    def relations(self) -> list[ExpectedRelation]:
        """As `POST /relations` gives them, best first."""
        return self._parsed("relations", list[ExpectedRelation])

    @property
    def disagreements(self) -> list[Disagreement]:
        """As `POST /relations` gives them, largest ratio of the probabilities first."""
        return self._parsed("disagreements", list[Disagreement])

    @property
    def observed_relations(self) -> list[ObservedRelation]:
        """Those that positions show; empty where there were none."""
        return self._parsed("observed_relations", list[ObservedRelation])

    def _parsed(self, name: str, kind: type[T]) -> T:
        return TypeAdapter(kind).validate_python(self.lists.get(name, []))

    @property
    def _there(self) -> ClientConnection:
        if self._connection is None:
            raise RuntimeError("the stream is not open: use it with `async with`")
        return self._connection


def _closed(error: ConnectionClosed) -> StreamClosedError:
    if error.rcvd is None:
        return StreamClosedError(1006, "")
    return StreamClosedError(error.rcvd.code, error.rcvd.reason)
