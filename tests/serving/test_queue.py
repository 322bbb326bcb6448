"""The queue of one model: order, bounds, deadlines, and what runs where."""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from time import monotonic, sleep
from typing import Any

import pytest

from app.serving.errors import DeadlinePassedError, DisconnectedError, QueueFullError
from app.serving.queue import CHEAP, Ticket, WorkQueue

pytestmark = pytest.mark.anyio

ENDLESS = Ticket(math.inf)


@pytest.fixture
def executor() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool


@pytest.fixture
def queue(executor: ThreadPoolExecutor) -> WorkQueue:
    return WorkQueue(limit=8, executor=executor)


async def test_jobs_run_in_order_each_with_its_result(queue: WorkQueue) -> None:
    order: list[int] = []

    def job(number: int) -> int:
        order.append(number)
        return number * number

    jobs = [queue.run(lambda _, k=k: job(k), ENDLESS, kind="q", size=1) for k in range(20)]
    assert [done.result for done in await asyncio.gather(*jobs)] == [k * k for k in range(20)]
    assert order == list(range(20))


async def test_what_arrives_in_one_tick_is_computed_in_the_next(queue: WorkQueue) -> None:
    """Nothing runs before all that came with it has been queued, and no timer is waited for."""
    order: list[str] = []

    async def ask(name: str) -> None:
        order.append(f"{name} queued")
        await queue.run(lambda _: order.append(f"{name} computed"), ENDLESS, kind="q", size=1)

    await asyncio.gather(ask("first"), ask("second"))
    assert order == ["first queued", "second queued", "first computed", "second computed"]


async def test_one_failure_is_one_request_s(queue: WorkQueue) -> None:
    def broken(_: object) -> None:
        raise ZeroDivisionError

    results: list[Any] = await asyncio.gather(
        queue.run(broken, ENDLESS, kind="q", size=1),
        queue.run(lambda _: "fine", ENDLESS, kind="q", size=1),
        queue.run(broken, ENDLESS, kind="q", size=1, costly=True),
        queue.run(lambda _: "fine", ENDLESS, kind="q", size=1, costly=True),
        return_exceptions=True,
    )
    assert isinstance(results[0], ZeroDivisionError)
    assert isinstance(results[2], ZeroDivisionError)
    assert results[1].result == results[3].result == "fine"


def test_rows_are_bounded_and_given_back(queue: WorkQueue) -> None:
    with queue.holding(8), pytest.raises(QueueFullError), queue.holding(1):
        pass
    assert queue.rows == 0
    with pytest.raises(ZeroDivisionError), queue.holding(3):
        raise ZeroDivisionError
    assert queue.rows == 0


@pytest.mark.parametrize("costly", [False, True])
async def test_work_whose_deadline_has_passed_is_never_begun(
    queue: WorkQueue, costly: bool
) -> None:
    begun: list[int] = []
    with pytest.raises(DeadlinePassedError):
        await queue.run(
            lambda _: begun.append(1), Ticket(monotonic()), kind="q", size=1, costly=costly
        )
    # What comes after it is computed all the same.
    assert (await queue.run(lambda _: 2, ENDLESS, kind="q", size=1, costly=costly)).result == 2
    assert not begun


async def test_nobody_waits_past_the_deadline_for_costly_work(queue: WorkQueue) -> None:
    """The one under way is given up; the one behind it is dropped without being begun."""
    release, begun = threading.Event(), threading.Event()
    behind: list[int] = []

    def slow(_: object) -> None:
        begun.set()
        release.wait(30)

    first = asyncio.ensure_future(
        queue.run(slow, Ticket(monotonic() + 1), kind="q", size=1, costly=True)
    )
    assert await asyncio.to_thread(begun.wait, 30)
    second = queue.run(
        lambda _: behind.append(1), Ticket(monotonic() + 0.2), kind="q", size=1, costly=True
    )
    results = await asyncio.gather(first, second, return_exceptions=True)
    assert all(isinstance(result, DeadlinePassedError) for result in results)
    release.set()
    assert (await queue.run(lambda _: 3, ENDLESS, kind="q", size=1, costly=True)).result == 3
    assert not behind


async def test_costly_work_hears_that_it_was_given_up(queue: WorkQueue) -> None:
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
        await queue.run(endless, Ticket(monotonic() + 0.1), kind="q", size=1, costly=True)
    assert await asyncio.to_thread(heard.wait, 30)
    heard.clear()
    leaving = asyncio.ensure_future(
        queue.run(endless, Ticket(math.inf, gone), kind="q", size=1, costly=True)
    )
    await asyncio.sleep(0.05)
    here = False
    with pytest.raises(DisconnectedError):
        await leaving
    assert await asyncio.to_thread(heard.wait, 30)


async def test_the_event_loop_goes_on_beside_costly_work(queue: WorkQueue) -> None:
    release = threading.Event()
    costly = asyncio.ensure_future(
        queue.run(lambda _: release.wait(30), ENDLESS, kind="draw", size=1, costly=True)
    )
    # Cheap jobs are answered while the costly one is under way: only they can end it.
    assert (await queue.run(lambda _: "answered", ENDLESS, kind="q", size=1)).result == "answered"
    release.set()
    assert (await costly).result


async def test_a_kind_that_turns_out_costly_moves_to_the_thread(
    queue: WorkQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In proportion to its size, and back again for small ones."""
    where: list[str] = []
    now = 0.0
    monkeypatch.setattr("app.serving.queue.thread_time", lambda: now)

    def job(seconds: float) -> None:
        nonlocal now
        where.append(threading.current_thread().name)
        now += seconds

    here = threading.current_thread().name
    for size in (1, 100, 1, 100):
        seconds = size * CHEAP / 10
        await queue.run(lambda _, s=seconds: job(s), ENDLESS, kind="q", size=size)
    assert [name == here for name in where] == [True, False, True, False]
    await queue.run(lambda _: job(0), ENDLESS, kind="another", size=100)
    assert where[-1] == here


async def test_a_long_queue_lets_others_have_their_turn(queue: WorkQueue) -> None:
    turns: list[int] = []
    computed = 0

    def job(_: object) -> None:
        nonlocal computed
        computed += 1
        sleep(5e-4)

    async def another() -> None:
        while computed < 40:
            turns.append(computed)
            await asyncio.sleep(0)

    jobs = [queue.run(job, ENDLESS, kind=str(k), size=1) for k in range(40)]
    await asyncio.gather(another(), *jobs)
    assert len({count for count in turns if 0 < count < 40}) > 3


async def test_costly_work_of_those_who_have_gone_is_dropped(queue: WorkQueue) -> None:
    begun: list[int] = []

    async def gone() -> bool:
        return True

    with pytest.raises(DisconnectedError):
        await queue.run(
            lambda _: begun.append(1), Ticket(math.inf, gone), kind="q", size=1, costly=True
        )
    assert not begun


@pytest.mark.parametrize("costly", [False, True])
async def test_waiting_and_computing_are_told_apart(
    queue: WorkQueue, monkeypatch: pytest.MonkeyPatch, costly: bool
) -> None:
    now = 0.0
    monkeypatch.setattr("app.serving.queue.monotonic", lambda: now)

    def job(_: object) -> None:
        nonlocal now
        now += 2.0

    # Two in one tick: the second waits while the first is computed.
    jobs = [queue.run(job, ENDLESS, kind=str(k), size=1, costly=costly) for k in range(2)]
    first, second = await asyncio.gather(*jobs)
    assert (first.waited, first.computed, second.computed) == (0.0, 2.0, 2.0)
    assert second.waited == 2.0 or costly


async def test_a_request_that_is_cancelled_leaves_the_queue_in_order(queue: WorkQueue) -> None:
    begun: list[int] = []
    waiting = asyncio.ensure_future(queue.run(lambda _: begun.append(1), ENDLESS, kind="q", size=1))
    await asyncio.sleep(0)
    waiting.cancel()
    assert (await queue.run(lambda _: 2, ENDLESS, kind="q", size=1)).result == 2
    assert not begun
