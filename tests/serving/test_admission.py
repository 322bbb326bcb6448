"""Admission: when requests begin; order, bounds and deadlines of the work of one model."""

from __future__ import annotations

import asyncio
import gc
import math
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Coroutine, Iterable, Iterator
from itertools import pairwise
from time import monotonic, sleep, thread_time
from typing import Any

import pytest

from app.errors import DeadlinePassedError, DisconnectedError, QueueFullError
from app.serving.admission import (
    CHEAP,
    PACE,
    REFUSALS,
    TICK,
    Backlog,
    Done,
    Threads,
    Ticket,
    WorkQueue,
)

ENDLESS = Ticket(math.inf)


def work(seconds: float) -> None:
    """Use so much processor time."""
    end = thread_time() + seconds
    while thread_time() < end:
        pass


@pytest.fixture
def threads() -> Iterator[Threads]:
    threads = Threads()
    yield threads
    threads.stop()


@pytest.fixture
async def queue(threads: Threads) -> WorkQueue:
    queue = WorkQueue(8, threads, Backlog(8))

    # From now on the cost of these kinds is measured.
    await queue.run(lambda: work(10 * CHEAP), ENDLESS, kind="costly", size=1)
    for kind in ("cheap", *map(str, range(40))):
        await queue.run(lambda: None, ENDLESS, kind=kind, size=1)
    return queue


Call = Callable[[], Any]


def in_tick(
    queue: WorkQueue, call: Call, ticket: Ticket = ENDLESS
) -> Coroutine[Any, Any, Done[Any]]:
    return queue.run(call, ticket, kind="cheap", size=1)


def in_thread(
    queue: WorkQueue, call: Call, ticket: Ticket = ENDLESS
) -> Coroutine[Any, Any, Done[Any]]:
    return queue.run(call, ticket, kind="costly", size=1)


def drawn(queue: WorkQueue, call: Call, ticket: Ticket = ENDLESS) -> Coroutine[Any, Any, Done[Any]]:
    return queue.draw(lambda _: call(), ticket)


WAYS = (in_tick, in_thread, drawn)
IN_THREADS = (in_thread, drawn)


async def test_jobs_run_in_order_each_with_its_result(queue: WorkQueue) -> None:
    order: list[int] = []

    def job(number: int) -> int:
        order.append(number)
        return number * number

    jobs = [queue.run(lambda k=k: job(k), ENDLESS, kind="cheap", size=1) for k in range(20)]
    assert [done.result for done in await asyncio.gather(*jobs)] == [k * k for k in range(20)]
    assert order == list(range(20))


@pytest.mark.parametrize("ask", WAYS)
async def test_a_failure_affects_one_request(queue: WorkQueue, ask: Any) -> None:
    def broken() -> None:
        raise ZeroDivisionError

    results: list[Any] = await asyncio.gather(
        ask(queue, broken), ask(queue, lambda: "fine"), return_exceptions=True
    )
    assert isinstance(results[0], ZeroDivisionError)
    assert results[1].result == "fine"
    assert queue.backlog.pending == 0


@pytest.mark.parametrize("ask", WAYS)
async def test_a_failure_keeps_nothing_of_its_request(queue: WorkQueue, ask: Any) -> None:
    """No cycle does: bodies of megabytes would wait for the collector."""

    class Body:
        pass

    async def fail() -> weakref.ref[Body]:
        body = Body()

        def broken() -> None:
            raise ZeroDivisionError(id(body))

        with pytest.raises(ZeroDivisionError):
            await ask(queue, broken)
        return weakref.ref(body)

    gc.disable()
    try:
        found = await fail()
        # A worker thread lets go of its last call a moment later.
        for _ in range(100):
            await asyncio.sleep(0.01)
            if found() is None:
                break
        assert found() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("ask", WAYS)
async def test_work_whose_deadline_has_passed_is_never_begun(queue: WorkQueue, ask: Any) -> None:
    begun: list[int] = []
    with pytest.raises(DeadlinePassedError):
        await ask(queue, lambda: begun.append(1), Ticket(monotonic()))
    # What comes after it is computed all the same.
    assert (await ask(queue, lambda: 2)).result == 2
    assert not begun


async def test_late_work_on_the_event_loop_is_refused(queue: WorkQueue) -> None:
    with pytest.raises(DeadlinePassedError):
        await in_tick(queue, lambda: sleep(0.1), Ticket(monotonic() + 0.05))


@pytest.mark.parametrize("ask", IN_THREADS)
async def test_costly_work_ends_the_wait_at_the_deadline(queue: WorkQueue, ask: Any) -> None:
    """The one under way is given up; the one behind it is dropped without being begun."""
    release, begun = threading.Event(), threading.Event()
    behind: list[int] = []

    def slow() -> None:
        begun.set()
        release.wait(30)

    first = asyncio.ensure_future(ask(queue, slow, Ticket(monotonic() + 1)))
    assert await asyncio.to_thread(begun.wait, 30)
    second = ask(queue, lambda: behind.append(1), Ticket(monotonic() + 0.2))
    results = await asyncio.gather(first, second, return_exceptions=True)
    assert all(isinstance(result, DeadlinePassedError) for result in results)
    release.set()
    assert (await ask(queue, lambda: 3)).result == 3
    assert not behind


async def test_a_cancelled_generation_is_notified(queue: WorkQueue) -> None:
    """By the deadline, or by a client that leaves while it is under way."""
    heard = threading.Event()
    here = True

    def endless(given_up: Callable[[], bool]) -> None:
        while not given_up():
            sleep(0.001)
        heard.set()

    async def gone() -> bool:
        return not here

    with pytest.raises(DeadlinePassedError):
        await queue.draw(endless, Ticket(monotonic() + 0.1))
    assert await asyncio.to_thread(heard.wait, 30)
    heard.clear()
    leaving = asyncio.ensure_future(queue.draw(endless, Ticket(math.inf, gone)))
    await asyncio.sleep(0.05)
    here = False
    with pytest.raises(DisconnectedError):
        await leaving
    assert await asyncio.to_thread(heard.wait, 30)


@pytest.fixture
def took(queue: WorkQueue, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Ask a question that takes so long; whether the event loop was held up by it."""
    now = 0.0
    monkeypatch.setattr("app.serving.admission.thread_time", lambda: now)

    async def took(seconds: float, *, size: int, kind: str = "q") -> bool:
        def job() -> str:
            nonlocal now
            now += seconds
            return threading.current_thread().name

        there = await queue.run(job, ENDLESS, kind=kind, size=size)
        return there.result == threading.current_thread().name

    return took


async def test_an_unmeasured_question_never_holds_up_the_event_loop(took: Any) -> None:
    """Neither a new kind does nor a new order of size, whatever is known of smaller ones."""
    assert not await took(100 * CHEAP, size=1, kind="new")
    assert not await took(0, size=1)
    assert await took(0, size=1)
    for size in (2, 4, 100, 10_000):
        assert not await took(100 * CHEAP, size=size)


async def test_costly_kinds_run_in_a_thread(took: Any) -> None:
    await took(CHEAP / 10, size=1)
    assert await took(CHEAP / 10, size=1)
    await took(CHEAP * 10, size=100)
    assert not await took(CHEAP * 10, size=100)
    assert await took(CHEAP / 10, size=1)


async def test_small_questions_do_not_make_large_ones_look_costly(took: Any) -> None:
    """What every question costs is much a unit for the small ones."""
    for _ in range(20):
        await took(CHEAP / 4, size=4)
        await took(CHEAP / 3, size=169)
    assert await took(CHEAP / 4, size=4)
    assert await took(CHEAP / 3, size=169)


async def test_one_slow_measurement_keeps_a_kind_on_the_event_loop(took: Any) -> None:
    await took(CHEAP / 3, size=100)
    for seconds in (CHEAP / 3, CHEAP / 3, 100 * CHEAP, CHEAP / 3):
        assert await took(seconds, size=100)
    # What stays so is believed.
    for _ in range(20):
        await took(3 * CHEAP, size=100)
    assert not await took(3 * CHEAP, size=100)


async def test_clients_cannot_fill_the_memory_with_kinds(took: Any) -> None:
    """The kinds that were measured first are forgotten."""
    for number in range(5_000):
        await took(0, size=1, kind=f"new {number}")
    assert await took(0, size=1, kind="new 4999")
    assert not await took(0, size=1, kind="new 0")


@pytest.mark.parametrize("ask", IN_THREADS)
async def test_costly_work_of_disconnected_clients_is_dropped(queue: WorkQueue, ask: Any) -> None:
    begun: list[int] = []

    async def gone() -> bool:
        return True

    with pytest.raises(DisconnectedError):
        await ask(queue, lambda: begun.append(1), Ticket(math.inf, gone))
    assert not begun


@pytest.mark.parametrize("ask", WAYS)
async def test_waiting_and_computing_times_are_separate(
    queue: WorkQueue, monkeypatch: pytest.MonkeyPatch, ask: Any
) -> None:
    now = 0.0
    monkeypatch.setattr("app.serving.admission.monotonic", lambda: now)

    def job() -> None:
        nonlocal now
        now += 2.0

    first, second = await asyncio.gather(ask(queue, job), ask(queue, job))
    assert (first.waited, first.computed, second.computed) == (0.0, 2.0, 2.0)
    # In a thread the second waits; on the event loop it comes after the first.
    assert second.waited in ((0.0,) if ask is in_tick else (0.0, 2.0))


# ---------------------------------------------------------------------------------- the backlog


async def enter(
    backlog: Backlog,
    begun: list[str],
    name: str = "-",
    allowed: float = 10.0,
    *,
    is_pending: bool = False,
) -> str:
    """What becomes of a request that enters; its work may be pending from then on."""
    try:
        await backlog.enter(allowed, monotonic() + allowed)
    except (QueueFullError, DeadlinePassedError) as error:
        return type(error).__name__
    begun.append(name)
    backlog.pending += is_pending
    return "begun"


FULL, LATE = "QueueFullError", "DeadlinePassedError"


async def in_ticks(
    requests: Iterable[Coroutine[Any, Any, str]], count: Callable[[], int]
) -> tuple[list[str], list[int]]:
    """What becomes of requests of one moment, and the change of a count in each tick."""
    running = asyncio.gather(*requests)
    counts = [count()]
    while not running.done():
        await asyncio.sleep(0)
        counts.append(count())
    return await running, [after - before for before, after in pairwise(counts)]


async def test_requests_of_one_moment_begin_a_few_in_a_tick_and_in_order() -> None:
    backlog = Backlog(1000)
    begun: list[str] = []
    names = [f"/{number}" for number in range(300)]
    requests = (enter(backlog, begun, name) for name in names)
    outcomes, steps = await in_ticks(requests, lambda: len(begun))
    assert outcomes == ["begun"] * 300
    assert begun == names
    assert max(steps) <= PACE
    # Without others a request begins at once.
    assert await enter(backlog, begun) == "begun"


async def slowly(request: Coroutine[Any, Any, str]) -> str:
    """A request whose start takes 1 ms."""
    outcome = await request
    work(1e-3)
    return outcome


async def test_slow_requests_begin_fewer_in_a_tick() -> None:
    """At 1 ms each, eight requests fill a tick once their time has been measured."""
    backlog = Backlog(1000)
    begun: list[str] = []
    requests = (slowly(enter(backlog, begun)) for _ in range(300))
    _, steps = await in_ticks(requests, lambda: len(begun))
    assert len(begun) == 300
    # A busy machine makes requests slower, never faster.
    assert max(steps[len(steps) // 2 :]) <= TICK / 1e-3 + 1


async def test_slow_requests_begin_beside_work_of_another_model() -> None:
    """Eight requests fill a tick here, and as many questions are pending already."""
    backlog = Backlog(1000)
    backlog.pending = int(TICK / 1e-3)
    for _ in range(3):
        requests = (slowly(enter(backlog, [])) for _ in range(20))
        assert await asyncio.wait_for(asyncio.gather(*requests), 5) == ["begun"] * 20


async def test_no_more_requests_begin_than_the_models_keep_up_with() -> None:
    backlog = Backlog(1000)
    begun: list[str] = []
    done = 0
    pending: list[int] = []

    async def work() -> None:
        nonlocal done
        while done < 300:
            pending.append(backlog.pending)
            ready = min(3, backlog.pending)
            done += ready
            backlog.pending -= ready
            await asyncio.sleep(0)

    requests = (enter(backlog, begun, is_pending=True) for _ in range(300))
    *outcomes, _ = await asyncio.gather(*requests, work())
    assert outcomes == ["begun"] * 300
    assert max(pending) == PACE


async def test_a_request_that_would_spend_its_time_waiting_is_refused_at_once() -> None:
    backlog = Backlog(100)
    begun: list[str] = []
    backlog.pending = PACE
    first = asyncio.ensure_future(enter(backlog, begun, "first"))
    await asyncio.sleep(0.02)
    assert await enter(backlog, begun, "hurried", 0.03) == FULL
    patient = asyncio.ensure_future(enter(backlog, begun, "patient"))
    await asyncio.sleep(0)
    backlog.pending = 0
    assert await first == await patient == "begun"
    assert begun == ["first", "patient"]


async def test_the_measured_pace_decides_how_long_the_backlog_gets() -> None:
    """At 2 ms each, a request with 200 ms may wait behind some 25 others, and not behind 100."""
    backlog = Backlog(1000)
    ended = False

    async def work() -> None:
        while not ended:
            await asyncio.sleep(0.002)
            backlog.pending -= min(1, backlog.pending)

    worker = asyncio.ensure_future(work())
    learning = [enter(backlog, [], is_pending=True) for _ in range(PACE + 30)]
    assert set(await asyncio.gather(*learning)) == {"begun"}
    while backlog.pending:  # noqa: ASYNC110 - a count is waited for, and no event
        await asyncio.sleep(0.001)
    hurried = [enter(backlog, [], allowed=0.2, is_pending=True) for _ in range(PACE + 100)]
    counts = Counter(await asyncio.gather(*hurried))
    ended = True
    await worker
    assert set(counts) == {"begun", FULL}
    assert PACE < counts["begun"] < PACE + 50


async def test_refusals_per_tick_are_bounded() -> None:
    backlog = Backlog(1)
    refused: list[str] = []

    async def call() -> str:
        outcome = await enter(backlog, [])
        refused.extend([outcome] if outcome == FULL else [])
        return outcome

    outcomes, steps = await in_ticks((call() for _ in range(PACE + 200)), lambda: len(refused))
    assert Counter(outcomes) == {"begun": PACE + 1, FULL: 199}
    assert max(steps) == REFUSALS


async def test_a_request_that_waited_past_its_deadline_does_not_begin() -> None:
    backlog = Backlog(100)
    begun: list[str] = []

    async def block() -> None:
        sleep(0.05)  # noqa: ASYNC251 - the event loop is what is to be held up

    first = [enter(backlog, begun) for _ in range(PACE)]
    late = enter(backlog, begun, "late", 0.01)
    *outcomes, _ = await asyncio.gather(*first, late, block())
    assert outcomes == ["begun"] * PACE + [LATE]
    assert "late" not in begun
