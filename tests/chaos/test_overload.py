"""Overload by ten times the sustainable rate: refusals, deadlines, and the state afterwards."""

from __future__ import annotations

import asyncio
import os
from concurrent.futures import ThreadPoolExecutor

from benchmarks.load.connections import prepared
from benchmarks.load.windows import at_concurrency, at_rate
from tests.services import LiveService, live_service

SECONDS = float(os.environ.get("CHAOS_OVERLOAD_SECONDS", "30"))
DEADLINE = 1.0
LIVE = b"GET /health/live HTTP/1.1\r\nhost: x\r\n\r\n"
HEADERS = {"x-request-timeout-ms": str(round(DEADLINE * 1000))}
# Sixteen classes are known; scenes are large, so that it is the service that is overloaded and not
# the client.
LABELS = ("bed", "nightstand", "lamp", "chair", "table", "desk", "sofa", "sink", "book", "pillow")
REQUESTS = [
    prepared(route, {"objects": [*LABELS[k:], *LABELS[:k]] * 6}, HEADERS)
    for k in range(len(LABELS))
    for route in ("/missing", "/outliers", "/relations")
]


# Without a line for each request: other programs use the disk.
service = live_service(SCENE_ACCESS_LOG="false", SCENE_MAX_CONNECTIONS="4096")


def sustainable(port: int) -> float:
    """Answers a second at eight connections; the best of three windows."""
    return max(asyncio.run(at_concurrency(port, REQUESTS, 8, 2)).rate for _ in range(3))


def test_overload_is_refused_and_leaves_nothing_behind(service: LiveService) -> None:
    before = service.control()
    rate = sustainable(service.port)
    # A first overload allocates what every later one uses again.
    asyncio.run(at_rate(service.port, REQUESTS, 10 * rate, 2, connections=512))
    resident = service.memory

    with ThreadPoolExecutor() as pool:
        health = pool.submit(asyncio.run, at_rate(service.port, [LIVE], 50, SECONDS, connections=1))
        window = asyncio.run(at_rate(service.port, REQUESTS, 10 * rate, SECONDS, connections=512))
    recovered = asyncio.run(at_concurrency(service.port, REQUESTS, 8, 1)).rate

    assert set(window.statuses) <= {200, 429, 504}
    assert window.statuses[429] > 0
    assert set(health.result().statuses) == {200}
    assert service.control() == before
    # What follows is time: it is meant for a machine with a core for each of the two sides.
    assert health.result().quantile(0.99) < 0.05
    assert recovered > 0.8 * rate
    assert service.memory - resident < 16 * 2**20
