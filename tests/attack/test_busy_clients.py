"""One client with many costly requests: the service answers other clients."""

import asyncio
import json
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from http.client import HTTPConnection

import pytest

from benchmarks.load.connections import prepared
from benchmarks.load.windows import at_concurrency, at_rate
from tests.services import LiveService, live_service, wait_until

pytestmark = [pytest.mark.system, pytest.mark.slow]

LABELS = [
    *("bed", "nightstand", "lamp", "pillow", "window", "curtain"),
    *("dresser", "mirror", "picture", "rug", "chair", "book"),
]
SCENE = {"objects": LABELS}
LONG = {"X-Request-Timeout-Ms": "60000"}
SECONDS = 3.0
HEALTH = b"GET /health/live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"

service = live_service()

SINGLE = prepared("/missing", SCENE, LONG)
BATCHES = [prepared("/missing/batch", {"scenes": [{"objects": LABELS[:3]}] * 256}, LONG)]
DRAWS = [prepared("/generate", {**SCENE, "count": 16, "steps": 500}, LONG)]
GARBAGE = [
    prepared("/missing", {"objects": [{}] * 60_000}),
    prepared("/missing", {"objects": ["bed"]}).replace(b"]}", b",,"),
    prepared("/missing", {"objects": [f"nonsuch {k}" for k in range(256)]}),
    prepared("/relations", {"objects": ["bed"], "relations": [["a", "left", "b"]] * 4096}),
    prepared("/nowhere", {"a": 1}),
]
DOCUMENTS = [
    b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"GET /models/default/vocabulary HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
]


@pytest.mark.parametrize("hostile", [BATCHES, DRAWS, GARBAGE, DOCUMENTS])
async def test_other_clients_are_served(shipped: LiveService, hostile: list[bytes]) -> None:
    """Eight robots ask while one client repeats costly requests over 24 connections."""
    port = shipped.port
    robots = [at_concurrency(port, [SINGLE], 4, SECONDS, f"127.0.1.{k}") for k in range(8)]
    checks = at_concurrency(port, [HEALTH], 1, SECONDS, "127.0.0.3")
    attack = at_concurrency(port, hostile, 24, SECONDS, "127.0.0.2")
    attacker, *others = await asyncio.gather(attack, checks, *robots)
    assert all(window.statuses.keys() == {200} for window in others)
    assert attacker.statuses
    assert not {500, 502} & attacker.statuses.keys()


def test_overload_is_refused(service: LiveService) -> None:
    """One client sends without pauses over 512 connections, twice its share of the queue."""
    requests = [prepared("/missing", {"objects": LABELS[:3] * n}, LONG) for n in range(1, 20)]
    before = service.control()
    # A first overload allocates what every later one uses again.
    asyncio.run(at_concurrency(service.port, requests, 512, 1))
    resident = service.memory
    with ThreadPoolExecutor() as pool:
        checks = pool.submit(asyncio.run, at_rate(service.port, [HEALTH], 50, SECONDS, 1))
        window = asyncio.run(at_concurrency(service.port, requests, 512, SECONDS))
    assert {200, 429} <= window.statuses.keys() <= {200, 429, 504}
    assert checks.result().statuses.keys() == {200}
    assert service.control() == before
    assert service.memory - resident < 16 * 2**20


def test_unread_answers_use_bounded_memory(service: LiveService) -> None:
    """Twenty clients ask for the largest batch, and read a byte a second of the answer."""
    before, answers = service.memory, service.control()
    scenes = [{"objects": ["bed"] * 23, "top_k": 256}] * 256
    batch = prepared("/relations/batch", {"scenes": scenes}, LONG)
    with ExitStack() as stack:
        for _ in range(20):
            connection = stack.enter_context(socket.socket())
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.connect(("127.0.0.1", service.port))
            connection.sendall(batch)
        for _ in range(5):
            time.sleep(1)
            assert service.memory - before < 100 * 2**20
            assert service.control() == answers
    wait_until(lambda: service.memory - before < 50 * 2**20)


behind_proxy = live_service(SCENE_TRUSTED_PROXIES="127.0.0.1")


def test_clients_of_a_trusted_proxy(behind_proxy: LiveService) -> None:
    """One client of the proxy holds its quarter of the draws; another one still has its own."""
    largest = {"objects": [], "temperature": 1.5, "count": 64, "steps": 500}
    quick = {"objects": ["bed"], "count": 1, "steps": 1}
    drawn = [(largest, "10.0.0.1"), (quick, "10.0.0.2"), (quick, "10.0.0.1")]
    connections = [HTTPConnection("127.0.0.1", behind_proxy.port, timeout=60) for _ in range(4)]
    with ExitStack() as opened:
        *draws, health = (opened.enter_context(closing(one)) for one in connections)
        for connection, (body, client) in zip(draws, drawn, strict=True):
            headers = {"X-Forwarded-For": client, "Content-Type": "application/json", **LONG}
            connection.request("POST", "/generate", json.dumps(body), headers)
            for _ in range(3):  # the service has read the request before its last answer
                health.request("GET", "/health/live")
                assert health.getresponse().read()
        assert [one.getresponse().status for one in draws] == [200, 200, 429]
