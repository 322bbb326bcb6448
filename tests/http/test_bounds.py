"""Requests that wait: in order, bounded, until their deadline; and what ending does to them."""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest

from app import reasoning
from app.api.middleware.turnstile import PACE, REFUSALS, Turnstile
from app.serving.queue import WorkQueue
from tests.http.conftest import launch, serve
from tests.http.test_problems import problem

SCENE = {"objects": ["bed", "chair", "lamp"]}
QUESTIONS = ("relations", "missing", "outliers", "generate")


@pytest.fixture
def hold(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], threading.Event]]:
    """From the call on, drawing waits for the event that it returns, in the worker thread."""
    release = threading.Event()
    draw = reasoning.generate

    def slow(*args: Any, **kwargs: Any) -> Any:
        release.wait(30)
        return draw(*args, **kwargs)

    def begin() -> threading.Event:
        monkeypatch.setattr(reasoning, "generate", slow)
        return release

    yield begin
    release.set()


@pytest.mark.anyio
@pytest.mark.parametrize("question", QUESTIONS)
async def test_the_header_sets_the_deadline(client: httpx.AsyncClient, question: str) -> None:
    for given in ("1000", "60000"):
        headers = {"X-Request-Timeout-Ms": given}
        assert (await client.post(f"/{question}", json=SCENE, headers=headers)).is_success


@pytest.mark.anyio
@pytest.mark.parametrize(
    "given", ["0", "-1", "1.5", "1e3", "60001", "600001", "10000000", "", " ", "soon"]
)
async def test_a_deadline_that_is_none_is_refused(client: httpx.AsyncClient, given: str) -> None:
    headers = {"X-Request-Timeout-Ms": given}
    response = await client.post("/relations", json=SCENE, headers=headers)
    problem(response, 400, "bad-request")
    # Health answers whatever it is asked with.
    assert (await client.get("/health/ready", headers=headers)).is_success


@pytest.mark.anyio
async def test_drawing_past_the_deadline_is_a_504_and_delays_nobody(
    shared_store: Path, hold: Callable[[], threading.Event]
) -> None:
    async with serve(shared_store) as client:
        release = hold()
        began = time.monotonic()
        drawing = asyncio.ensure_future(
            client.post("/generate", json=SCENE, headers={"X-Request-Timeout-Ms": "300"})
        )
        for question in ("relations", "missing", "outliers"):
            assert (await client.post(f"/{question}", json=SCENE)).is_success
        assert not drawing.done()
        problem(await drawing, 504, "deadline-passed")
        assert time.monotonic() - began >= 0.3
        release.set()
        assert (await client.post("/generate", json=SCENE)).is_success


@pytest.mark.anyio
async def test_the_service_s_own_deadline_holds_without_a_header(
    shared_store: Path, hold: Callable[[], threading.Event]
) -> None:
    async with serve(shared_store, request_timeout_ms=200) as client:
        hold()
        problem(await client.post("/generate", json=SCENE), 504, "deadline-passed")


@pytest.mark.anyio
async def test_rows_that_no_queue_has_room_for_are_a_429(
    shared_store: Path, hold: Callable[[], threading.Event]
) -> None:
    async with serve(shared_store, queue_rows=256) as client:
        release = hold()
        drawing = [
            asyncio.ensure_future(
                client.post(
                    "/generate",
                    json={**SCENE, "count": 64, "steps": 5},
                    headers={"X-Request-Timeout-Ms": "60000"},
                )
            )
            for _ in range(4)
        ]
        await asyncio.sleep(0.2)
        response = await client.post("/generate", json=SCENE)
        problem(response, 429, "queue-full")
        assert int(response.headers["retry-after"]) >= 1
        # The queue is the model's: scoring waits in it too, a batch all at once.
        problem(await client.post("/missing", json=SCENE), 429, "queue-full")
        batch = {"scenes": [SCENE] * 2}
        problem(await client.post("/missing/batch", json=batch), 429, "queue-full")
        assert (await client.get("/health/ready")).is_success
        release.set()
        assert {response.status_code for response in await asyncio.gather(*drawing)} == {200}
        assert (await client.post("/missing/batch", json={"scenes": [SCENE] * 256})).is_success


@pytest.mark.anyio
async def test_batches_give_their_rows_back(shared_store: Path) -> None:
    async with serve(shared_store, queue_rows=256) as client:
        scenes: list[Any] = [SCENE, {**SCENE, "model": "nobody"}, {"model": 7}, [], SCENE]
        for _ in range(80):
            answer = await client.post("/outliers/batch", json={"scenes": scenes})
            statuses = [entry["status"] for entry in answer.json()["results"]]
            assert statuses == [200, 404, 422, 422, 200]
        models = client.app.state.runtime.models  # type: ignore[attr-defined]
        assert {served.queue.rows for served in models.served.values()} == {0}


@pytest.mark.anyio
async def test_nothing_is_told_to_wait_once_it_has_ended(
    shared_store: Path, hold: Callable[[], threading.Event]
) -> None:
    """After a batch, and after work that was given up, the gauge is back at 0."""
    async with serve(shared_store) as client:

        async def pending() -> set[float]:
            text = (await client.get("/metrics")).text
            return {float(line.split()[-1]) for line in text.splitlines()
                    if line.startswith("scene_pending_rows{")}  # fmt: skip

        await client.post("/missing/batch", json={"scenes": [SCENE] * 5})
        assert await pending() == {0.0}
        hold()
        drawing = asyncio.ensure_future(
            client.post("/generate", json=SCENE, headers={"X-Request-Timeout-Ms": "400"})
        )
        await asyncio.sleep(0.1)
        assert await pending() == {0.0, 1.0}
        problem(await drawing, 504, "deadline-passed")
        assert await pending() == {0.0}


@pytest.mark.anyio
async def test_a_batch_stops_where_its_deadline_passes(
    shared_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each entry that was not begun says so itself."""
    run = WorkQueue.run

    async def slow(self: WorkQueue, *args: Any, **kwargs: Any) -> Any:
        await asyncio.sleep(0.05)
        return await run(self, *args, **kwargs)

    monkeypatch.setattr(WorkQueue, "run", slow)
    async with serve(shared_store) as client:
        answer = await client.post(
            "/missing/batch",
            json={"scenes": [SCENE] * 20},
            headers={"X-Request-Timeout-Ms": "250"},
        )
    statuses = [entry["status"] for entry in answer.json()["results"]]
    answered = statuses.count(200)
    assert 0 < answered < 20
    assert statuses == [200] * answered + [504] * (20 - answered)


async def _call(app: Turnstile, path: str = "/relations", headers: Any = ()) -> int:
    """The status that a request gets, straight through the middleware."""
    statuses = []

    async def receive() -> Any:
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            statuses.append(message["status"])

    scope = {"type": "http", "path": path, "headers": list(headers), "state": {}, "app": _App()}
    await app(scope, receive, send)
    return statuses[0]


class _App:
    """As much of an application as an answer needs."""

    class state:  # noqa: N801
        class settings:  # noqa: N801
            retry_after = 1


def _turnstile(begun: list[str], limit: int, backlog: Callable[[], int] = lambda: 0) -> Turnstile:
    async def answer(scope: Any, receive: Any, send: Any) -> None:
        begun.append(scope["path"])
        await send({"type": "http.response.start", "status": 200, "headers": []})

    return Turnstile(answer, limit=limit, timeout=10.0, longest_ms=60_000, backlog=backlog)


@pytest.mark.anyio
async def test_requests_that_come_at_once_are_begun_a_few_in_a_tick_and_in_order() -> None:
    begun: list[str] = []
    ticks: list[int] = []
    turnstile = _turnstile(begun, limit=1000)

    async def clock() -> None:
        while len(begun) < 300:
            ticks.append(len(begun))
            await asyncio.sleep(0)

    paths = [f"/{number}" for number in range(300)]
    *statuses, _ = await asyncio.gather(*(_call(turnstile, path) for path in paths), clock())
    assert statuses == [200] * 300
    assert begun == paths
    steps = [after - before for before, after in pairwise(ticks)]
    assert max(steps) <= PACE
    # Nobody waits where there is room.
    assert await _call(turnstile) == 200


@pytest.mark.anyio
async def test_too_many_at_once_are_refused_and_health_passes_by() -> None:
    begun: list[str] = []
    turnstile = _turnstile(begun, limit=10)
    paths = ["/relations"] * (PACE + 10 + 5) + ["/health/live"]
    statuses = await asyncio.gather(*(_call(turnstile, path) for path in paths))
    assert statuses == [200] * (PACE + 10) + [429] * 5 + [200]
    assert begun.index("/health/live") == PACE


@pytest.mark.anyio
async def test_no_more_is_begun_than_the_models_keep_up_with() -> None:
    begun: list[str] = []
    done = 0
    turnstile = _turnstile(begun, limit=1000, backlog=lambda: len(begun) - done)
    waiting: list[int] = []

    async def work() -> None:
        nonlocal done
        while done < 300:
            waiting.append(len(begun) - done)
            done = min(done + 3, len(begun))
            await asyncio.sleep(0)

    *statuses, _ = await asyncio.gather(*(_call(turnstile) for _ in range(300)), work())
    assert statuses == [200] * 300
    assert max(waiting) == PACE


@pytest.mark.anyio
async def test_who_would_spend_the_time_in_the_line_is_refused_at_once() -> None:
    begun: list[str] = []
    held = PACE
    turnstile = _turnstile(begun, limit=100, backlog=lambda: held)
    first = asyncio.ensure_future(_call(turnstile, "/first"))
    await asyncio.sleep(0.02)
    hurried = [(b"x-request-timeout-ms", b"30")]
    assert await _call(turnstile, "/hurried", hurried) == 429
    patient = asyncio.ensure_future(_call(turnstile, "/patient"))
    await asyncio.sleep(0)
    held = 0
    assert await first == await patient == 200
    assert begun == ["/first", "/patient"]


@pytest.mark.anyio
async def test_the_pace_of_the_line_is_learnt_and_decides_how_long_it_gets() -> None:
    """At 2 ms each, who has 200 ms may stand behind some 25 others, and not behind 100."""
    begun: list[str] = []
    done = 0
    ended = False
    turnstile = _turnstile(begun, limit=1000, backlog=lambda: len(begun) - done)

    async def work() -> None:
        nonlocal done
        while not ended:
            await asyncio.sleep(0.002)
            done = min(done + 1, len(begun))

    worker = asyncio.ensure_future(work())
    learning = [_call(turnstile) for _ in range(PACE + 30)]
    assert set(await asyncio.gather(*learning)) == {200}
    while done < len(begun):  # noqa: ASYNC110 - what is waited for is counted, and no event
        await asyncio.sleep(0.001)
    hurried = [(b"x-request-timeout-ms", b"200")]
    statuses = await asyncio.gather(
        *(_call(turnstile, "/relations", hurried) for _ in range(PACE + 100))
    )
    ended = True
    await worker
    counts = Counter(statuses)
    assert set(counts) == {200, 429}
    assert PACE < counts[200] < PACE + 50


@pytest.mark.anyio
async def test_refusals_hold_up_no_tick_either() -> None:
    turnstile = _turnstile([], limit=1)
    statuses: list[int] = []
    ticks: list[int] = []

    async def call() -> None:
        statuses.append(await _call(turnstile))

    async def clock() -> None:
        while len(statuses) < PACE + 200:
            ticks.append(statuses.count(429))
            await asyncio.sleep(0)

    await asyncio.gather(*(call() for _ in range(PACE + 200)), clock())
    assert Counter(statuses) == {200: PACE + 1, 429: 199}
    steps = [after - before for before, after in pairwise(ticks)]
    assert max(steps) == REFUSALS


@pytest.mark.anyio
async def test_what_waited_past_its_deadline_is_not_begun() -> None:
    begun: list[str] = []
    turnstile = _turnstile(begun, limit=100)

    async def block() -> None:
        time.sleep(0.05)  # noqa: ASYNC251 - the event loop is what is to be held up

    late = [(b"x-request-timeout-ms", b"10")]
    first = [_call(turnstile) for _ in range(PACE)]
    *statuses, _ = await asyncio.gather(*first, _call(turnstile, "/late", late), block())
    assert statuses == [200] * PACE + [504]
    assert "/late" not in begun


@pytest.mark.system
def test_ending_finishes_what_was_begun_and_takes_nothing_new(
    shared_store: Path, tmp_path: Path
) -> None:
    service = launch(shared_store, tmp_path / "log", SCENE_DRAIN_SECONDS="1.5")
    answers: list[httpx.Response] = []

    def draw() -> None:
        with httpx.Client(base_url=service.client.base_url, timeout=60) as client:
            # By tensors, which take longer than compiled chains.
            body = {**SCENE, "model": "plain", "count": 64, "steps": 400}
            headers = {"X-Request-Timeout-Ms": "60000"}
            answers.append(client.post("/generate", json=body, headers=headers))

    drawing = threading.Thread(target=draw)
    try:
        drawing.start()
        time.sleep(0.2)
        assert not answers
        service.process.send_signal(signal.SIGTERM)
        time.sleep(0.2)
        refused = service.client.post("/relations", json=SCENE)
        problem(refused, 503, "draining")
        assert refused.headers["connection"] == "close"
        assert "retry-after" in refused.headers
        problem(service.client.get("/health/ready"), 503, "draining")
        assert service.client.get("/health/live").is_success
        drawing.join(timeout=60)
        assert answers[0].status_code == 200
        service.process.wait(timeout=30)
        assert service.process.returncode == -signal.SIGTERM
        with pytest.raises(httpx.ConnectError):
            service.client.get("/health/live")
    finally:
        service.client.close()
        service.process.kill()
        service.process.wait()
