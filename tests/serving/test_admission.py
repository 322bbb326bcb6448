"""Lanes: bounded, fair between clients, and a few requests per iteration of the event loop."""

import asyncio
import math
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import DeadlinePassedError, DisconnectedError
from app.serving.admission import Admission, Lane, Ticket, in_thread
from tests.services import PATIENCE

pytestmark = pytest.mark.anyio


def ticket(client: str = "robot", seconds: float = math.inf, **fields: Any) -> Ticket:
    return Ticket(client, monotonic() + seconds, **fields)


async def work(lane: Lane, client: str, log: list[str]) -> None:
    """One request: its turn takes no await, as a quick question."""
    place = ticket(client)
    await place.enter(lane, 1)
    log.append(client)
    place.leave()


async def test_a_few_requests_run_in_one_iteration_of_the_event_loop_in_order() -> None:
    lane, log = Lane(8, 1000), list[str]()
    running = asyncio.gather(*(work(lane, "robot", log) for _ in range(200)))
    steps, before = [], 0
    while not running.done():
        await asyncio.sleep(0)
        steps.append(len(log) - before)
        before = len(log)
    assert len(log) == 200
    assert max(steps) == 8
    assert lane.weight == 0


async def test_clients_take_turns() -> None:
    lane, log = Lane(1, 1000), list[str]()
    clients = ["flood"] * 50 + ["a", "b"]
    await asyncio.gather(*(work(lane, client, log) for client in clients))
    # The first request found the lane free. Behind it, every client has its turn in a round.
    assert set(log[1:4]) == {"flood", "a", "b"}


async def test_a_request_that_waits_past_its_deadline_leaves_its_place() -> None:
    lane, holder = Lane(1, 40), ticket("holder")
    await holder.enter(lane, 1)
    with pytest.raises(DeadlinePassedError):
        await ticket(seconds=0.01).enter(lane, 1)
    departed = asyncio.ensure_future(ticket().enter(lane, 1))
    await asyncio.sleep(0)
    departed.cancel()
    await asyncio.wait([departed])
    assert lane.weight == 1
    holder.leave()
    await asyncio.wait_for(ticket().enter(lane, 1), PATIENCE)


@given(
    st.lists(
        st.tuples(st.sampled_from("abc"), st.sampled_from(["enter", "leave", "cancel", "wait"])),
        max_size=60,
    )
)
def test_slots_and_weights_balance_after_any_sequence(moves: list[tuple[str, str]]) -> None:
    async def run() -> None:
        lane, running = Lane(2, 24), dict[str, list[tuple[Ticket, asyncio.Task[None]]]]()
        for client, move in moves:
            mine = running.setdefault(client, [])
            if move == "enter":
                place = ticket(client)
                mine.append((place, asyncio.ensure_future(place.enter(lane, 2))))
            elif move == "wait":
                await asyncio.sleep(0)
            elif mine:
                place, turn = mine.pop(0)
                if move == "cancel":
                    turn.cancel()
                await asyncio.wait([turn], timeout=0 if move == "leave" else None)
                if turn.done() and not turn.cancelled() and turn.exception() is None:
                    place.leave()
                else:
                    turn.cancel()
        for mine in running.values():
            for place, turn in mine:
                turn.cancel()
                await asyncio.wait([turn])
                place.leave()
        for _ in range(4):
            await asyncio.sleep(0)
        assert lane.weight == 0
        both = ticket("d"), ticket("e")
        entering = asyncio.gather(*(place.enter(lane, 2) for place in both))
        await asyncio.wait_for(entering, PATIENCE)

    asyncio.run(run())


@pytest.fixture
def admission() -> Iterator[Admission]:
    admission = Admission(1024, 4096)
    yield admission
    admission.stop()


@pytest.fixture
def begun() -> threading.Event:
    return threading.Event()


async def test_work_in_a_thread_ends_the_wait_at_the_deadline(admission, begun):
    """The one under way is given up; the one behind it is dropped without being begun."""
    release, behind = threading.Event(), list[int]()

    def slow(_: Callable[[], bool]) -> None:
        begun.set()
        release.wait(PATIENCE)

    places = ticket(), ticket()
    calls = slow, lambda _: behind.append(1)
    pairs = zip(calls, places, strict=True)
    running = (in_thread(call, place, admission.drawing) for call, place in pairs)
    waits = [asyncio.ensure_future(one) for one in running]
    assert await asyncio.to_thread(begun.wait, PATIENCE)
    for place in places:
        place.deadline = monotonic() + 0.1
    results = await asyncio.gather(*waits, return_exceptions=True)
    assert all(isinstance(result, DeadlinePassedError) for result in results)
    release.set()
    assert await in_thread(lambda _: 3, ticket(), admission.drawing) == 3
    with pytest.raises(DeadlinePassedError):
        await in_thread(lambda _: behind.append(2), ticket(seconds=0), admission.drawing)
    assert not behind


@pytest.mark.parametrize("ending", ["deadline", "disconnect"])
async def test_a_long_computation_learns_that_its_request_has_ended(admission, begun, ending):
    heard, here = threading.Event(), True

    def endless(has_ended: Callable[[], bool]) -> None:
        begun.set()
        while not has_ended():
            heard.wait(0.001)
        heard.set()

    async def is_gone() -> bool:
        return not here

    place = ticket(is_gone=is_gone)
    waiting = asyncio.ensure_future(in_thread(endless, place, admission.drawing))
    assert await asyncio.to_thread(begun.wait, PATIENCE)
    if ending == "deadline":
        place.deadline = monotonic() + 0.1
    else:
        here = False
    error = DeadlinePassedError if ending == "deadline" else DisconnectedError
    with pytest.raises(error):
        await waiting
    assert await asyncio.to_thread(heard.wait, PATIENCE)
    with pytest.raises(error):
        await in_thread(endless, place, admission.drawing)
