"""A worker's end of the channel: it follows the supervisor, and leads a change when asked to."""

from __future__ import annotations

import asyncio
import itertools
import logging
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from app.schemas import Failure
from app.serving.errors import RefreshRefusedError
from app.serving.generation import Generation
from app.serving.peers import Change, Participant
from app.workers.wire import Channel, Kind, Message, open_channel

_logger = logging.getLogger("app.workers")


class Supervised:
    """The other workers, reached through the supervisor.

    Args:
        end: this worker's end of the channel.
        orphaned: called, in the event loop, when the supervisor is gone.
    """

    def __init__(self, end: socket.socket, orphaned: Callable[[], None]) -> None:
        self._end = end
        self._orphaned = orphaned
        self._leading = asyncio.Lock()
        self._numbers = itertools.count(1)
        self._verdicts: asyncio.Queue[Message | None] = asyncio.Queue()

    async def join(self, participant: Participant) -> None:
        """See `Peers.join`."""
        channel = await open_channel(self._end)
        serving = asyncio.get_running_loop().create_future()
        self._follower = _Follower(channel, participant, self._verdicts, serving)
        self._following = asyncio.create_task(self._follow(serving))
        self._follower.say("hello", 0)
        await serving

    async def _follow(self, serving: asyncio.Future[None]) -> None:
        try:
            await self._follower.follow()
        except Exception:
            # It may serve something else than the others from now on: it must not go on.
            _logger.exception("this worker cannot follow the others: it stops")
        else:
            _logger.error("the supervisor is gone: this worker stops")
        self._verdicts.put_nowait(None)
        if not serving.done():
            serving.set_exception(ConnectionError("the supervisor is gone"))
        self._orphaned()

    @asynccontextmanager
    async def change(self) -> AsyncIterator[Change]:
        """See `Peers.change`."""
        async with self._leading:
            change = _Change(self._follower, self._verdicts, next(self._numbers))
            try:
                await change.begin()
                yield change
            finally:
                change.leave()


class _Change:
    """A change that this worker leads."""

    def __init__(
        self, follower: _Follower, verdicts: asyncio.Queue[Message | None], number: int
    ) -> None:
        self._follower = follower
        self._verdicts = verdicts
        self._number = number
        self._agreed = False
        self._settled = False

    async def begin(self) -> None:
        """Return when it is this change's turn."""
        self._follower.say("begin", self._number)
        await self._verdict()

    async def agree(self, generation: Generation) -> None:
        """See `Change.agree`."""
        self._follower.say("propose", self._number, generation)
        await self._verdict()
        self._agreed = True

    async def commit(self) -> None:
        """See `Change.commit`. The swap itself comes to this worker as to any other."""
        self._follower.say("commit", self._number)
        self._settled = True
        await self._verdict()

    def leave(self) -> None:
        """Give up, unless it has been decided."""
        if not self._settled:
            self._follower.give_up(self._number, agreed=self._agreed)

    async def _verdict(self) -> None:
        while (message := await self._verdicts.get()) is not None:
            if message.change != self._number:
                continue  # of a change that was given up
            if message.kind == "disagreed":
                self._settled = True
                raise RefreshRefusedError([Failure(**entry) for entry in message.failures])
            return
        self._verdicts.put_nowait(None)
        raise ConnectionError("the supervisor is gone")


class _Follower:
    """Does what the supervisor says, one thing after another."""

    def __init__(
        self,
        channel: Channel,
        participant: Participant,
        verdicts: asyncio.Queue[Message | None],
        serving: asyncio.Future[None],
    ) -> None:
        self._channel = channel
        self._participant = participant
        self._verdicts = verdicts
        self._serving = serving

    def say(self, kind: Kind, change: int, generation: Generation | None = None) -> None:
        text = None if generation is None else generation.model_dump_json()
        self._channel.send(Message(kind, change, text))

    def give_up(self, change: int, *, agreed: bool) -> None:
        # Before that, what this worker has made ready may belong to another's change.
        if agreed:
            self._participant.abort()
        self.say("abort", change)

    async def follow(self) -> None:
        """Return when the supervisor is gone.

        Raises:
            Exception: whatever a swap raises; none can be taken back.
        """
        try:
            await self._obey()
        finally:
            self._channel.close()

    async def _obey(self) -> None:
        while (message := await self._channel.receive()) is not None:
            match message.kind:
                case "prepare":
                    await self._prepare(message)
                case "commit":
                    self._participant.commit()
                    self.say("committed", message.change)
                    if not self._serving.done():
                        self._serving.set_result(None)
                case "abort":
                    self._participant.abort()
                case "disagreed":
                    # Here and not where the verdict is awaited: the next message may already
                    # make ready for somebody else's change.
                    self._participant.abort()
                    self._verdicts.put_nowait(message)
                case _:
                    self._verdicts.put_nowait(message)

    async def _prepare(self, message: Message) -> None:
        wanted = message.generation
        try:
            prepared = await self._participant.prepare(
                None if wanted is None else Generation.model_validate_json(wanted)
            )
        except RefreshRefusedError as error:
            failures = error.failures
            for failure in failures:
                _logger.error("%s: %s: %s", failure.subject, failure.reason, failure.detail)
        except Exception:
            # Whatever it is, the others must hear that this worker cannot follow.
            _logger.exception("could not make ready for a change of models")
            detail = "a worker failed while it made ready for the change"
            failures = (Failure(subject="worker", reason="failed", detail=detail),)
        else:
            self.say("prepared", message.change, prepared)
            return
        told = tuple(failure.model_dump(mode="json") for failure in failures)
        self._channel.send(Message("refused", message.change, failures=told))
