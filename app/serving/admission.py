"""Admission control: when a request starts, and in which thread its computation runs.

The class `Backlog` limits the number of requests that wait to start. In one tick of the event loop,
the backlog starts at most `PACE` requests minus the started requests without an answer. The backlog
starts fewer requests if the requests would block the event loop for more than `TICK` seconds. The
backlog refuses at most `REFUSALS` requests per tick. Without these limits, hundreds of simultaneous
requests would delay health checks. The backlog refuses a request for three reasons: the backlog is
full, the expected wait is too long, or the deadline has passed.

The class `WorkQueue` limits the number of rows (scenes) that wait for one model or are being
computed. Each question is computed separately, so an answer never depends on other requests. A
cheap question runs on the event loop, because a change of thread costs as much as most questions. A
question is costly if its expected time exceeds `CHEAP`, or if its kind was never measured. A costly
question runs on the worker thread of its model. Compiled kernels release the interpreter lock, so
the event loop can continue. Sampling of scenes may take seconds, so all models share another thread
for sampling. The queue drops a question if its deadline passes or its client disconnects before
the question starts.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from time import monotonic, thread_time
from typing import Final, Generic, TypeVar
from weakref import WeakSet

from app.errors import DeadlinePassedError, DisconnectedError, QueueFullError

T = TypeVar("T")

TICK: Final = 8e-3
"""Maximum total time in seconds for which the requests of one tick may block the event loop."""

PACE: Final = 32
"""Maximum number of requests that one tick starts.

Requests that earlier ticks have started and that have no answer yet count towards this number.
"""

REFUSALS: Final = 8
"""Maximum number of requests refused in one tick."""

CHEAP: Final = 2e-3
"""Maximum time in seconds for which one question may block the event loop."""

# Time in seconds between two ticks if the previous tick could not start a request.
_PAUSE: Final = 5e-3
# Maximum expected wait, as a fraction of the request's time limit. Even if the real wait is three
# times as long, it ends before the deadline.
_PATIENCE: Final = 0.25
# Weight of the newest measurement in the backlog's moving averages of times.
_NEWEST_PACE: Final = 0.1
# Time in seconds between two checks of the client's connection during a costly computation.
_LOOK: Final = 0.25
# Maximum number of averages that `_Costs` stores.
_MAX_COSTS: Final = 4096
# Weight of the newest measurement in the expected computation time of a question.
_NEWEST: Final = 0.2

# Queue of requests, oldest first: for each request its arrival time and the future that wakes it.
_Line = deque[tuple[float, asyncio.Future[None]]]


class Backlog:
    """Requests that wait to start, in the order of their arrival.

    Args:
        limit: maximum number of waiting requests.

    Attributes:
        pending: number of started questions without a result. Requests that sample scenes are not
            counted.
        draining: whether the service is shutting down.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.pending = 0
        self.draining = False
        self._ticking = False
        self._places = self._begun = 0  # requests that this tick may still start, and has started
        self._began_at = self._seconds = 0.0  # start of the tick; average time of a request
        self._interval = 0.0  # average time between the starts of two waiting requests
        self._moved_at: float | None = None  # last start of a waiting request
        self._waiting: _Line = deque()
        self._refused: _Line = deque()

    async def enter(self, allowed: float, deadline: float) -> None:
        """Wait until the request may start.

        Args:
            allowed: time limit of the request in seconds.
            deadline: deadline of the request, as a value of `time.monotonic`.

        Raises:
            QueueFullError: too many requests are waiting, or the expected wait is too long.
            DeadlinePassedError: the deadline passed while the request was waiting.
        """
        if not self._ticking:
            self._begin_tick()
        if not self._waiting and self._places:
            self._places -= 1
            self._begun += 1
            return
        if self._is_full(allowed):
            count = len(self._waiting)
            await _wait(self._refused)
            raise QueueFullError(f"The backlog is full: {count} requests are waiting.")
        await _wait(self._waiting)
        if monotonic() >= deadline:
            raise DeadlinePassedError("The deadline passed before the request started.")

    def _is_full(self, allowed: float) -> bool:
        """Return whether the backlog must refuse a request with the time limit ``allowed``."""
        if not self._waiting:
            return False
        # A new request waits about as long as the oldest waiting request has waited.
        wait = max(monotonic() - self._waiting[0][0], len(self._waiting) * self._interval)
        return len(self._waiting) >= self.limit or wait > _PATIENCE * allowed

    def _begin_tick(self) -> None:
        """Start waiting requests, refuse requests, and schedule the next tick."""
        now = monotonic()
        if self._begun and self._ticking:
            # The time between two ticks is the time of the requests that the earlier tick started.
            per_request = (now - self._began_at) / self._begun
            share = _NEWEST_PACE if self._seconds else 1.0
            self._seconds += share * (per_request - self._seconds)
        self._began_at = now
        most = PACE
        if PACE * self._seconds > TICK:
            most = max(1, int(TICK / self._seconds))
        self._places = max(0, min(most, PACE - self.pending))
        begun = self._begun = _wake(self._waiting, self._places) if self._waiting else 0
        self._places -= begun
        if begun or self._moved_at is not None or self._waiting:
            self._measure_pace(begun)
        if self._refused:
            _wake(self._refused, REFUSALS)
        loop = asyncio.get_running_loop()
        # Schedule the next tick at once. Requests that arrive before it count towards this tick.
        if begun or not self._ticking:
            self._ticking = True
            loop.call_soon(self._begin_tick)
        elif self._waiting or self._refused:
            loop.call_later(_PAUSE, self._begin_tick)
        else:
            self._ticking = False

    def _measure_pace(self, begun: int) -> None:
        """Update the average time between two starts, after ``begun`` waiting requests started."""
        now = monotonic()
        if begun and self._moved_at is not None:
            self._interval += _NEWEST_PACE * ((now - self._moved_at) / begun - self._interval)
        if begun or not self._waiting:
            self._moved_at = now if self._waiting else None


async def _wait(line: _Line) -> None:
    turn = asyncio.get_running_loop().create_future()
    line.append((monotonic(), turn))
    await turn


def _wake(line: _Line, most: int) -> int:
    """Wake at most `most` requests, oldest request first. Return the number of woken requests.

    Cancelled requests are skipped and not counted.
    """
    count = 0
    while line and count < most:
        _, turn = line.popleft()
        if not turn.done():
            turn.set_result(None)
            count += 1
    return count


# The dataclass is not frozen, because the creation of a frozen object takes three times as long.
@dataclass(slots=True)
class Ticket:
    """The deadline of a request, and a check whether its client is still connected.

    Attributes:
        deadline: deadline of the request, as a value of `time.monotonic`. A computation that has
            not started by then is dropped.
        is_gone: function that returns whether the client has disconnected. The queue calls the
            function before and during costly computations.
    """

    deadline: float
    is_gone: Callable[[], Awaitable[bool]] | None = None

    def check(self) -> None:
        """Check that the deadline has not passed.

        Raises:
            DeadlinePassedError: the deadline has passed.
        """
        if monotonic() >= self.deadline:
            raise DeadlinePassedError("The deadline passed before the computation started.")

    async def check_connected(self) -> None:
        """Check that the client is still connected.

        Raises:
            DisconnectedError: the client has disconnected.
        """
        if self.is_gone is not None and await self.is_gone():
            raise DisconnectedError("The client has disconnected.")


@dataclass(slots=True)
class Done(Generic[T]):
    """The result of a computation, with its times in seconds.

    Attributes:
        result: return value of the computation.
        waited: time from the call of the queue to the start of the computation.
        computed: time from the start to the end of the computation.
        processor: processor time of the computation. It does not contain times in which the thread
            waited for a processor or for the interpreter lock.
    """

    result: T
    waited: float
    computed: float
    processor: float


class _Costs:
    """Average computation times of questions, in seconds per unit of size.

    There is one average for each kind of question and each power of two of the size, because small
    scenes take more time per unit of size than large scenes.
    """

    def __init__(self) -> None:
        self._per_unit: dict[tuple[str, int], float] = {}

    def expected(self, kind: str, size: int) -> float:
        """Return the expected time in seconds. It is infinite before the first measurement."""
        return self._per_unit.get((kind, size.bit_length()), math.inf) * size

    def learn(self, kind: str, size: int, seconds: float) -> None:
        if len(self._per_unit) >= _MAX_COSTS:
            self._per_unit.clear()  # clients can cause many kinds, so this bounds the memory
        key, measured = (kind, size.bit_length()), seconds / size
        average = self._per_unit.get(key, measured)
        # A measurement counts as at most twice the average. Otherwise, one slow measurement could
        # move all later questions to the worker thread.
        self._per_unit[key] = average + _NEWEST * (min(measured, 2 * average) - average)


def _one_thread(name: str) -> Executor:
    return ThreadPoolExecutor(1, thread_name_prefix=name)


@dataclass(frozen=True, slots=True)
class Threads:
    """The worker threads of a process.

    Attributes:
        drawing: executor whose only thread samples scenes. All models share this thread.
    """

    drawing: Executor = field(default_factory=partial(_one_thread, "drawing"))
    _costly: WeakSet[Executor] = field(default_factory=WeakSet)

    def for_model(self) -> Executor:
        """Return an executor with one thread for the costly questions of one model.

        The thread ends when the executor is garbage-collected.
        """
        executor = _one_thread("costly work")
        self._costly.add(executor)
        return executor

    def stop(self) -> None:
        """Stop the threads and drop the computations that have not started."""
        for executor in (self.drawing, *self._costly):
            executor.shutdown(wait=False, cancel_futures=True)


@dataclass(eq=False)
class WorkQueue:
    """The queue of the computations of one model.

    A row is one scene of a question, or one scene to sample.

    Attributes:
        limit: maximum number of rows that wait or are being computed.
        threads: worker threads for costly computations.
        backlog: the backlog, which counts started questions without a result.
        rows: number of rows that wait or are being computed.
    """

    limit: int
    threads: Threads
    backlog: Backlog
    rows: int = 0
    _costs: _Costs = field(default_factory=_Costs)
    _costly: Executor = field(init=False)

    def __post_init__(self) -> None:
        self._costly = self.threads.for_model()

    def take(self, rows: int) -> None:
        """Reserve rows until `give_back` releases these rows.

        Raises:
            QueueFullError: fewer than ``rows`` rows are free.
        """
        if self.rows + rows > self.limit:
            raise QueueFullError(f"The queue is full: {self.rows} of {self.limit} rows are in use.")
        self.rows += rows

    def give_back(self, rows: int) -> None:
        """Release reserved rows."""
        self.rows -= rows

    async def run(self, call: Callable[[], T], ticket: Ticket, *, kind: str, size: int) -> Done[T]:
        """Compute the answer to a question.

        Args:
            call: function that computes the answer. It may run in another thread.
            ticket: deadline and connection check of the request.
            kind: kind of the question. The expected computation time depends on kind and size.
            size: size of the question, at least 1.

        Raises:
            DeadlinePassedError: the deadline passed before the end of the computation.
            DisconnectedError: the client has disconnected.
            Exception: any error of `call`.
        """
        called_at = monotonic()

        def compute(_: Callable[[], bool] | None = None) -> Done[T]:
            # Measure the time inside the computation, because the request may end earlier.
            done = _timed(call, called_at)
            self._costs.learn(kind, size, done.processor)
            return done

        self.backlog.pending += 1
        try:
            if self._costs.expected(kind, size) > CHEAP:
                return await _in_thread(compute, ticket, self._costly)
            ticket.check()
            done = compute()
            ticket.check()
            return done
        finally:
            self.backlog.pending -= 1

    async def draw(self, call: Callable[[Callable[[], bool]], T], ticket: Ticket) -> Done[T]:
        """Sample scenes on the thread for sampling.

        Args:
            call: function that samples the scenes. Its argument is a function that returns whether
                the request has ended. A long computation should call this function regularly.
            ticket: deadline and connection check of the request.

        Raises:
            DeadlinePassedError, DisconnectedError, Exception: see `run`.
        """
        called_at = monotonic()

        def sample(has_ended: Callable[[], bool]) -> Done[T]:
            return _timed(lambda: call(has_ended), called_at)

        return await _in_thread(sample, ticket, self.threads.drawing)


def _timed(call: Callable[[], T], called_at: float) -> Done[T]:
    """Return the result of a computation with its times. ``called_at`` is the call of the queue."""
    began, processor = monotonic(), thread_time()
    result = call()
    return Done(result, began - called_at, monotonic() - began, thread_time() - processor)


async def _in_thread(
    call: Callable[[Callable[[], bool]], Done[T]], ticket: Ticket, executor: Executor
) -> Done[T]:
    """Run a computation on an executor until its end, the deadline or a disconnect of the client.

    The argument of ``call`` is a function that returns whether the request has ended.
    """
    ticket.check()
    await ticket.check_connected()
    has_ended = False

    def compute() -> Done[T]:
        # The computation of an ended request is still in the executor's queue, so skip it here.
        if has_ended:
            raise DeadlinePassedError("The request ended before the computation started.")
        return call(lambda: has_ended)

    future = asyncio.get_running_loop().run_in_executor(executor, compute)
    try:
        while True:
            left = ticket.deadline - monotonic()
            await asyncio.wait([future], timeout=min(left, _LOOK))
            if future.done():
                return future.result()
            if left <= _LOOK:
                raise DeadlinePassedError("The deadline passed before the computation finished.")
            await ticket.check_connected()
    finally:
        has_ended = True
        future.cancel()
        # The frame, the future and its error form a reference cycle. Without this deletion, the
        # cycle would keep the whole request in memory until the garbage collector runs.
        del future
