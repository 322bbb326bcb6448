"""The perf analyser: what it sends, and what it says of servers whose behaviour is known."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import httpx
import numpy as np
import pytest

from benchmarks.load import plain
from benchmarks.load.connections import prepared
from benchmarks.load.measure import is_steady
from benchmarks.load.questions import KINDS, bodies
from benchmarks.load.windows import Window, at_concurrency, at_rate, joined

LABELS = [f"thing {number}" for number in range(40)]
REQUESTS = [prepared("/missing", {"objects": [label]}) for label in LABELS]


@asynccontextmanager
async def server(
    status: int = 200, pause: float = 0.0, pieces: int = 1, answers: int = 1_000_000
) -> AsyncIterator[int]:
    """A server of known behaviour: its port.

    Args:
        pause: seconds before each answer.
        pieces: in how many parts an answer comes.
        answers: after so many a connection is closed instead.
    """

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.append(asyncio.current_task())
        try:
            for _ in range(answers):
                head = await reader.readuntil(b"\r\n\r\n")
                length = int(head.lower().split(b"content-length: ")[1].split(b"\r\n")[0])
                await reader.readexactly(length)
                await asyncio.sleep(pause)
                answer = b"HTTP/1.1 %d X\r\nContent-Length: 9\r\n\r\n012345678" % status
                for part in np.array_split(np.frombuffer(answer, np.uint8), pieces):
                    writer.write(part.tobytes())
                    await writer.drain()
                    await asyncio.sleep(0)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass  # the client has gone
        finally:
            writer.close()
            with suppress(ConnectionError):
                await writer.wait_closed()

    serving: list[asyncio.Task[None] | None] = []
    listening = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with listening:
        yield listening.sockets[0].getsockname()[1]
        await asyncio.gather(*(task for task in serving if task))


@pytest.mark.parametrize("pieces", [1, 7])
async def test_every_answer_is_counted_once(pieces: int) -> None:
    async with server(pieces=pieces) as port:
        window = await at_concurrency(port, REQUESTS, 3, 0.2)
    assert set(window.statuses) == {200}
    assert window.statuses[200] == len(window.latency) > 3
    assert window.errors == 0
    assert window.rate == window.statuses[200] / window.seconds


async def test_other_statuses_and_broken_connections_are_errors() -> None:
    async with server(status=429) as port:
        window = await at_concurrency(port, REQUESTS, 2, 0.1)
    assert (window.rate, window.errors) == (0, len(window.latency))
    async with server(answers=3) as port:
        window = await at_concurrency(port, REQUESTS, 2, 0.5)
    # Three answers each, and then the one that never came.
    assert window.statuses == {200: 6, 0: 2}


async def test_a_server_that_stalls_is_charged_for_all_that_waited() -> None:
    """Four a pause can be answered where ten are due: the later ones are charged their wait."""
    async with server(pause=0.1) as port:
        window = await at_rate(port, REQUESTS, 100, 0.5, connections=4)
    assert window.statuses == {200: 50}
    assert np.median(window.latency) > 0.2
    async with server() as port:
        window = await at_rate(port, REQUESTS, 50, 0.4, connections=4)
    assert window.statuses == {200: 20}
    assert window.seconds >= 19 / 50


def window(rate: float, latency: float) -> Window:
    return Window(1.0, np.full(10, latency), Counter({200: round(rate)}))


def test_steady_is_three_windows_within_a_tenth() -> None:
    assert is_steady([window(10, 1), *[window(100, 1)] * 3])
    assert is_steady([window(95, 1), window(100, 1.05), window(105, 1)])
    assert not is_steady([window(80, 1), window(100, 1), window(100, 1)])
    assert not is_steady([window(100, 1), window(100, 1), window(100, 1.3)])
    together = joined([window(100, 1), window(50, 3)])
    assert together.rate == 75
    assert together.quantile(0.5) == 2


@pytest.mark.parametrize("kind", KINDS)
async def test_the_yardstick_validates_and_sends_the_prepared_answer(kind: str) -> None:
    transport = httpx.ASGITransport(plain.app)
    async with httpx.AsyncClient(transport=transport, base_url="http://plain") as client:
        scene = bodies(kind, LABELS)[0]
        for question in ("missing", "relations", "outliers", "rooms"):
            answer = f'{{"{question}":[]}}'.encode()
            await client.put(f"/answers/{question}", content=answer)
            found = await client.post(f"/{question}", json=scene)
            assert (found.status_code, found.content) == (200, answer)
            refused = await client.post(f"/{question}", json={"objects": 1})
            assert refused.status_code == 422
