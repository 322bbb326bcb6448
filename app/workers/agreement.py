"""What all workers serve, and how that changes: everywhere, or nowhere.

Two phases. First everybody makes ready to serve the new generation while the old one goes on
answering; one that cannot, ends or takes too long makes the change fail, and nobody has changed.
Then it is decided, everybody swaps, and a worker that does not say so in time is killed: what
replaces it loads what was decided. So when a change has been reported as done, no process is left
that serves anything else.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable, Collection, Mapping

from app.workers.wire import Channel, Kind, Message

Failures = tuple[Mapping[str, str], ...]

_logger = logging.getLogger("app.workers")


class RefusedError(Exception):
    """A worker cannot serve what it is to serve.

    Attributes:
        failures: why.
    """

    def __init__(self, failures: Failures) -> None:
        super().__init__("; ".join(f"{f['subject']}: {f['reason']}" for f in failures))
        self.failures = failures


class Member:
    """The supervisor's view of one worker.

    Args:
        channel: to it.
        pid: its process id.
        kill: ends it at once.
    """

    def __init__(self, channel: Channel, pid: int, kill: Callable[[], None]) -> None:
        self.pid = pid
        self.kill = kill
        self.gone = asyncio.Event()
        self._channel = channel
        self._greeted = asyncio.Event()
        self._answers: asyncio.Queue[Message | None] = asyncio.Queue()
        self._wishes: asyncio.Queue[Message | None] = asyncio.Queue()

    async def listen(self, begin: Callable[[Member, int], None]) -> None:
        """Take in what it says until it is gone.

        Args:
            begin: called with this member and the number of a change that it wants to lead.
        """
        try:
            while (message := await self._channel.receive()) is not None:
                match message.kind:
                    case "hello":
                        self._greeted.set()
                    case "begin":
                        begin(self, message.change)
                    case "propose" | "commit" | "abort":
                        self._wishes.put_nowait(message)
                    case _:
                        self._answers.put_nowait(message)
        finally:
            self._channel.close()
            self.gone.set()
            for queue in (self._answers, self._wishes):
                queue.put_nowait(None)

    async def greeting(self) -> None:
        """Return when it has loaded its code, or is gone."""
        waiting = [asyncio.create_task(event.wait()) for event in (self._greeted, self.gone)]
        try:
            await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in waiting:
                task.cancel()

    def tell(
        self,
        kind: Kind,
        change: int,
        generation: str | None = None,
        failures: Failures = (),
    ) -> None:
        """Say something that has no answer."""
        self._channel.send(Message(kind, change, generation, failures))

    async def ask(self, kind: Kind, change: int, generation: str | None = None) -> Message:
        """Say something and wait for its answer.

        Raises:
            ConnectionError: it is gone.
        """
        self.tell(kind, change, generation)
        return await _next(self._answers, change)

    async def wish(self, change: int) -> Message:
        """What it says next as the leader of a change.

        Raises:
            ConnectionError: it is gone.
        """
        return await _next(self._wishes, change)


async def _next(queue: asyncio.Queue[Message | None], change: int) -> Message:
    while (message := await queue.get()) is not None:
        if message.change == change:  # others come from a change that was given up
            return message
    queue.put_nowait(None)
    raise ConnectionError("the worker is gone")


class Agreement:
    """The generation that all members serve.

    Args:
        patience: seconds that preparing may take, and leading a change to its next step.
        swap_patience: seconds that a swap may take before a worker is taken for dead.
    """

    def __init__(self, *, patience: float, swap_patience: float) -> None:
        self._patience = patience
        self._swap_patience = swap_patience
        self._generation: str | None = None
        self._members: set[Member] = set()
        self._changing = asyncio.Lock()
        self._numbers = itertools.count(1)
        self._changes: set[asyncio.Task[None]] = set()

    @property
    def members(self) -> Collection[Member]:
        """The workers that serve."""
        return frozenset(self._members)

    async def admit(self, member: Member) -> None:
        """Let a new worker load what the others serve, and count it among them.

        The first one ever admitted decides what that is, by what it found in the store.

        Raises:
            RefusedError: it cannot load that.
            ConnectionError: it is gone.
            TimeoutError: it takes too long.
        """
        async with asyncio.timeout(self._patience):
            await member.greeting()
        while True:
            # Outside the lock, so that several can load at once, and changes need not wait.
            async with asyncio.timeout(self._patience):
                answer = await member.ask("prepare", next(self._numbers), self._generation)
            if answer.kind != "prepared":
                raise RefusedError(answer.failures)
            async with self._changing:
                if self._generation not in (None, answer.generation):
                    continue  # it was changed, or decided on, in the meantime
                async with asyncio.timeout(self._swap_patience):
                    await member.ask("commit", answer.change)
                self._generation = answer.generation
                self._members.add(member)
                return

    def dismiss(self, member: Member) -> None:
        """Forget a worker that is gone."""
        self._members.discard(member)

    def begin(self, leader: Member, number: int) -> None:
        """Let a member lead a change, numbered by itself, when it is its turn."""
        task = asyncio.create_task(self._lead(leader, number))
        self._changes.add(task)
        task.add_done_callback(self._changes.discard)

    async def _lead(self, leader: Member, number: int) -> None:
        async with self._changing:
            leader.tell("granted", number)
            try:
                await self._change(leader, number)
            except TimeoutError:
                leader.tell("disagreed", number, failures=(_failure("timed_out"),))
            except ConnectionError:
                _logger.warning("worker %d ended while it changed the models", leader.pid)

    async def _change(self, leader: Member, number: int) -> None:
        proposal = await self._wish(leader, number)
        if proposal.kind != "propose":
            return
        own = next(self._numbers)
        others = [member for member in self._members if member is not leader]
        decided = False
        try:
            failures = await self._prepare(others, own, proposal.generation)
            if failures:
                leader.tell("disagreed", number, failures=failures)
                return
            leader.tell("agreed", number)
            decided = (await self._wish(leader, number)).kind == "commit"
        finally:
            if not decided:
                for member in others:
                    member.tell("abort", own)
        if decided:
            self._generation = proposal.generation
            await asyncio.gather(*(self._swap(member, own) for member in (leader, *others)))
            leader.tell("done", number)

    async def _wish(self, leader: Member, number: int) -> Message:
        async with asyncio.timeout(self._patience):
            return await leader.wish(number)

    async def _prepare(
        self, members: Collection[Member], number: int, generation: str | None
    ) -> Failures:
        """Why any of them cannot serve this; nothing where all can."""

        async def prepare(member: Member) -> Failures:
            try:
                async with asyncio.timeout(self._patience):
                    answer = await member.ask("prepare", number, generation)
            except TimeoutError:
                return (_failure("timed_out"),)
            except ConnectionError:
                return (_failure("ended"),)
            return () if answer.kind == "prepared" else answer.failures

        found = await asyncio.gather(*map(prepare, members))
        # Several workers mostly fail for one reason, which is told once.
        return tuple({tuple(f.items()): f for failures in found for f in failures}.values())

    async def _swap(self, member: Member, number: int) -> None:
        try:
            async with asyncio.timeout(self._swap_patience):
                await member.ask("commit", number)
        except TimeoutError:
            _logger.error("worker %d did not swap its models in time: killed", member.pid)
            member.kill()
            await member.gone.wait()
        except ConnectionError:
            pass  # what replaces it loads what was decided


def _failure(reason: str) -> Mapping[str, str]:
    details = {
        "timed_out": "a worker took too long to make ready for the change",
        "ended": "a worker ended while it made ready for the change",
    }
    return {"subject": "worker", "reason": reason, "detail": details[reason]}
