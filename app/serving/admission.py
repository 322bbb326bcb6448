"""Admission: when a request starts, in which thread it runs, and how many bytes requests hold.

Requests of different cost wait in different lanes:

| lane | requests | weight of a request | requests at a time |
|---|---|---|---|
| quick | all at their start, and refusals | 1 | 8 |
| slow | batches, large bodies and scenes, words, documents, files | number of scenes | 2 |
| draws | `/generate` | number of scenes x sweeps | 1 |

A lane bounds the total weight of its requests. One client holds at most a quarter of a lane, and
the clients of a lane take turns, so no client can keep others out. Quick requests are computed on
the event loop, because a change of thread costs as much as most questions. At most 8 start before
the event loop looks at the network again, so new requests wait a few milliseconds. Scenes of
batches are computed one by one between quick requests, and large scenes and draws in threads of low
priority. Compiled loops release the interpreter lock, so the event loop can continue.

Each question is computed separately, so an answer never depends on other requests.
"""

import asyncio
import os
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Hashable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from time import monotonic
from typing import Final, TypeVar

from starlette.types import Receive

from app import errors
from app.settings import Settings
from scene_client.schemas.generate import MAX_SWEEPS

T = TypeVar("T")

SHARE: Final = 4
"""One client holds at most this part of a lane, and of the bytes of all bodies: a quarter."""

SMALL: Final = 16 * 1024
"""Maximum size in bytes of a body that the event loop parses, in less than a millisecond.

In one piece, such a body is always accepted.
"""

# Time in seconds between two checks of the client's connection during a computation in a thread.
_LOOK: Final = 0.25
# Difference in niceness between the worker threads and the event loop.
_NICE: Final = 5


class Lane:
    """A bounded queue in which clients take turns. At most ``slots`` requests run at a time.

    `Ticket.enter` and `Ticket.leave` begin and end the turn of a request.
    """

    def __init__(self, slots: int, limit: int) -> None:
        self.limit, self.weight = limit, 0  # total weight of the waiting and running requests
        self.free_slots = slots
        self.weights: dict[str, int] = {}  # by client
        # One queue of waiting requests for each key (`line`). The first queue has the next turn.
        self.queues: dict[Hashable, deque[asyncio.Future[None]]] = {}

    async def let_pass(self) -> None:
        """Let requests of this lane run before the next scene of a batch."""
        # A turn takes three iterations of the event loop: to end the turn before it, to start, and
        # to answer.
        for _ in range(3 if self.queues else 1):
            await asyncio.sleep(0)

    def start_next(self) -> None:
        """Free one slot, and start waiting requests while slots are free."""
        self.free_slots += 1
        while self.free_slots > 0 and self.queues:
            key = next(iter(self.queues))
            queue = self.queues.pop(key)
            turn = queue.popleft()
            if queue:
                self.queues[key] = queue  # a dictionary appends new keys, so the others go first
            if not turn.done():  # the request has not ended by timeout or cancellation
                self.free_slots -= 1
                turn.set_result(None)


# The dataclass is not frozen, because the creation of a frozen object takes three times as long.
@dataclass(slots=True)
class Ticket:
    """The place of a request in a lane, and its deadline."""

    client: str  # address
    deadline: float  # as a value of `time.monotonic`
    is_gone: Callable[[], Awaitable[bool]] | None = None  # whether the client has disconnected
    lane: Lane | None = None  # in which the request waits or has its turn
    weight: int = 0
    waited: float = 0.0  # total seconds so far
    had_turn: bool = False

    async def enter(self, lane: Lane, weight: int, line: Hashable = None) -> None:
        """Leave the lane of the request and wait for a turn in another, until the deadline.

        A weight of 0 is never refused. The keys ``line`` of the queues, by default the clients,
        take turns.

        Raises:
            QueueFullError: the lane or the client's share of it is full.
            DeadlinePassedError: the deadline passed while the request was waiting.
        """
        self.leave()
        of_client = lane.weights.get(self.client, 0) + weight
        if weight and (lane.weight + weight > lane.limit or of_client > lane.limit // SHARE):
            raise errors.QueueFullError("The queue, or the share of this client in it, is full.")
        lane.weight += weight
        lane.weights[self.client] = of_client
        self.lane, self.weight = lane, weight
        if lane.free_slots and not lane.queues:
            lane.free_slots -= 1
            self.had_turn = True
            return
        began, turn = monotonic(), asyncio.get_running_loop().create_future()
        lane.queues.setdefault(self.client if line is None else line, deque()).append(turn)
        try:
            async with asyncio.timeout(max(self.deadline - began, 0)):
                await turn
        except BaseException as error:
            # `leave` frees a slot. Take one first, unless `start_next` gave a slot to this request
            # in the same moment.
            has_slot = turn.done() and not turn.cancelled()
            if not has_slot:
                lane.free_slots -= 1
            self.leave()
            if isinstance(error, TimeoutError):
                detail = "The deadline passed before the request started."
                raise errors.DeadlinePassedError(detail) from None
            raise
        self.waited += monotonic() - began
        self.had_turn = True

    def leave(self) -> None:
        """End the turn, if the request has one. The next iteration of the event loop frees it."""
        if (lane := self.lane) is None:
            return
        self.lane = None
        lane.weight -= self.weight
        left = lane.weights.pop(self.client, 0) - self.weight
        if left:
            lane.weights[self.client] = left
        asyncio.get_running_loop().call_soon(lane.start_next)

    def check(self) -> None:
        """Raise DeadlinePassedError if the deadline has passed."""
        if monotonic() >= self.deadline:
            raise errors.DeadlinePassedError("The deadline passed before the computation started.")

    async def check_connected(self) -> None:
        """Raise DisconnectedError if the client has disconnected."""
        if self.is_gone is not None and await self.is_gone():
            raise errors.DisconnectedError("The client has disconnected.")


class Admission:
    """The lanes and the worker threads of a process."""

    def __init__(self, requests: int, rows: int) -> None:
        self.quick = Lane(8, requests)
        self.slow = Lane(2, rows)
        # So the share of one client has room for the largest `/generate`.
        self.draws = Lane(1, SHARE * MAX_SWEEPS)
        self.worker = ThreadPoolExecutor(1, "slow", _lower_priority)
        self.drawing = ThreadPoolExecutor(1, "drawing", _lower_priority)

    async def in_worker(self, ticket: Ticket, call: Callable[[Callable[[], bool]], T]) -> T:
        """Run a computation in the worker thread, in a turn of the lane `slow`; see `in_thread`."""
        if ticket.lane is not self.slow:
            await ticket.enter(self.slow, 1)
        return await in_thread(call, ticket, self.worker)

    def stop(self) -> None:
        """Stop the threads and drop the computations that have not started."""
        for executor in (self.worker, self.drawing):
            executor.shutdown(wait=False, cancel_futures=True)


def _lower_priority() -> None:
    # Linux gives each thread a priority of its own. A new thread has the priority of the process.
    with suppress(OSError, AttributeError):
        of_thread = os.PRIO_PROCESS, threading.get_native_id()
        os.setpriority(*of_thread, os.getpriority(*of_thread) + _NICE)


async def in_thread(
    call: Callable[[Callable[[], bool]], T], ticket: Ticket, executor: Executor
) -> T:
    """Run a computation in a thread until its end, the deadline or a disconnect of the client.

    A long computation should regularly call its argument: it returns whether the request has ended.

    Raises:
        DeadlinePassedError: the deadline passed before the end of the computation.
        DisconnectedError: the client has disconnected.
        Exception: any error of `call`.
    """
    ticket.check()
    await ticket.check_connected()
    has_ended, called_at = False, monotonic()

    def compute() -> T:
        """Run the computation on the thread, and count the seconds in its queue as waiting."""
        # The computation of an ended request is still in the executor's queue, so skip it here.
        if has_ended:
            raise errors.DeadlinePassedError("The request ended before the computation started.")
        ticket.waited += monotonic() - called_at
        return call(lambda: has_ended)

    future = asyncio.get_running_loop().run_in_executor(executor, compute)
    try:
        while True:
            left = ticket.deadline - monotonic()
            await asyncio.wait([future], timeout=min(left, _LOOK))
            if future.done():
                return future.result()
            if left <= _LOOK:
                raise errors.DeadlinePassedError("The deadline passed before the result.")
            await ticket.check_connected()
    finally:
        has_ended = True
        future.cancel()
        # The frame, the future and its error form a reference cycle. Without this deletion, the
        # cycle would keep the whole request in memory until the garbage collector runs.
        del future


class Bodies:
    """The bodies in progress. A client holds at most a quarter of the budget, or a single body."""

    def __init__(self, settings: Settings) -> None:
        self._budget = settings.held_body_bytes
        self.patience = settings.client_timeout  # seconds to receive a body or to send an answer
        self._of_clients: dict[str, int] = {}
        self.total = 0  # bytes

    @contextmanager
    def hold(self, client: str, size: int) -> Iterator[None]:
        """Count a large answer of a client in the ``with`` block, or raise BodiesFullError."""
        self.add(client, size)
        try:
            self._check(client, size)
            yield
        finally:
            self.add(client, -size)

    def add(self, client: str, size: int) -> None:
        """Count bytes of a client. A negative size stops counting them."""
        self.total += size
        of_client = self._of_clients.pop(client, 0) + size
        if of_client:
            self._of_clients[client] = of_client

    async def read(self, receive: Receive, client: str, limit: int, length: bytes) -> bytes:
        """Read a whole body of at most ``limit`` bytes. The caller must stop counting it.

        ``length`` is the header Content-Length, or empty.

        Raises:
            ServiceError: the body is too large, too slow or incomplete, or the budget is full.
        """
        # int() must not parse very long numbers, so the length is checked first.
        if length.isdigit() and (len(length) > 18 or int(length) > limit):
            raise _too_large(limit)
        body = bytearray()
        try:
            async with asyncio.timeout(self.patience):
                more = True
                while more:
                    message = await receive()
                    if message["type"] != "http.request":
                        detail = "The connection closed before the body was complete."
                        raise errors.BadRequestError(detail)
                    part, more = message.get("body", b""), message.get("more_body", False)
                    is_whole = not (more or body)
                    self.add(client, len(part))
                    body += part
                    if len(body) > limit:
                        raise _too_large(limit)
                    if not (is_whole and len(body) <= SMALL):
                        self._check(client, len(body))
        except BaseException as error:
            self.add(client, -len(body))
            if isinstance(error, TimeoutError):
                detail = f"The body did not arrive within {self.patience:g} seconds."
                raise errors.RequestTimeoutError(detail) from None
            raise
        return bytes(body)

    def _check(self, client: str, size: int) -> None:
        """Raise BodiesFullError if the bodies of all clients, or of this client, are too large."""
        share = max(self._budget // SHARE, size)  # a single body of this size is accepted
        if self.total > self._budget or self._of_clients.get(client, 0) > share:
            detail = (
                f"All bodies in progress exceed {self._budget} bytes together, or those of this "
                f"client {share} bytes."
            )
            raise errors.BodiesFullError(detail)


def _too_large(limit: int) -> errors.BodyTooLargeError:
    return errors.BodyTooLargeError(f"The body must not be larger than {limit} bytes.")
