"""``python -m app`` as a process of its own, over real sockets."""

from __future__ import annotations

import json
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.http.conftest import ADMIN_KEY, LiveService, launch
from tests.http.stores import corrupt, make_store, publish
from tests.http.test_problems import MARKER, problem

pytestmark = pytest.mark.system

SCENE = {"objects": ["bed", "chair", "lamp"]}


def exchange(port: int, request: bytes) -> tuple[bytes, bytes]:
    """Send raw bytes; the head and body of the first answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        received = b""
        while chunk := connection.recv(65536):
            received += chunk
    head, _, body = received.partition(b"\r\n\r\n")
    return head, body


def test_it_becomes_ready_within_seconds(shared_store: Path, tmp_path: Path) -> None:
    began = time.monotonic()
    service = launch(shared_store, tmp_path / "log")
    try:
        assert service.client.get("/health/ready").status_code == 200
        # Five seconds are promised on a quiet machine; tests share theirs.
        assert time.monotonic() - began < 20
    finally:
        service.client.close()
        service.process.terminate()
    service.process.wait(timeout=30)
    # It stopped in order, and then by the signal that it was sent, as a shell expects.
    assert service.process.returncode == -signal.SIGTERM
    assert "Application shutdown complete" in service.log.read_text()


def test_every_question_is_answered(live: LiveService) -> None:
    for question in ("relations", "missing", "outliers", "generate"):
        response = live.client.post(f"/{question}", json=SCENE)
        assert response.status_code == 200
        assert response.json()["request_id"] == response.headers["x-request-id"]
    batch = live.client.post("/relations/batch", json={"scenes": [SCENE, {}]})
    assert [entry["status"] for entry in batch.json()["results"]] == [200, 422]


@pytest.mark.parametrize(
    "path",
    [
        "/models",
        "/models/home",
        "/models/home/versions/1.0.0",
        "/models/default/vocabulary",
        "/models/default/contexts",
        "/health/live",
        "/health/ready",
        "/v2",
        "/v2/health/live",
        "/v2/health/ready",
        "/v2/models/default",
        "/v2/models/default/ready",
        "/docs",
        "/redoc",
        "/openapi.json",
        "/docs/swagger-ui-bundle.js",
        "/redoc/redoc.standalone.js",
        "/static/icon.svg",
        "/problems",
        "/metrics",
    ],
)
def test_every_address_answers(live: LiveService, path: str) -> None:
    assert live.client.get(path).status_code == 200


def test_the_same_request_gives_the_same_bytes_from_any_process(
    live: LiveService, shared_store: Path, tmp_path: Path
) -> None:
    other = launch(shared_store, tmp_path / "log")
    try:
        headers = {"X-Request-Id": "same"}
        for question in ("relations", "missing", "outliers", "generate"):
            request = {**SCENE, "seed": 3}
            first = live.client.post(f"/{question}", json=request, headers=headers)
            second = other.client.post(f"/{question}", json=request, headers=headers)
            assert first.content == second.content
    finally:
        other.client.close()
        other.process.terminate()
        other.process.wait(timeout=30)


def test_parallel_requests_get_their_own_answers(live: LiveService) -> None:
    def draw(seed: int) -> Any:
        response = live.client.post(
            "/generate", json={**SCENE, "seed": seed}, headers={"X-Request-Id": f"r{seed}"}
        )
        assert response.headers["x-request-id"] == f"r{seed}"
        assert response.json()["seed"] == seed
        return response.json()["scenes"]

    seeds = [seed % 8 for seed in range(64)]
    with ThreadPoolExecutor(8) as pool:
        drawn = list(pool.map(draw, seeds))
    for seed in range(8):
        same = [scenes for s, scenes in zip(seeds, drawn, strict=True) if s == seed]
        assert all(scenes == same[0] for scenes in same)


def test_problems_over_the_wire(live: LiveService) -> None:
    client = live.client
    problem(client.get("/nowhere"), 404, "not-found")
    problem(client.put("/relations"), 405, "method-not-allowed")
    problem(client.post("/relations", data={"a": "b"}), 415, "unsupported-media-type")
    problem(client.post("/relations", json={"objects": [MARKER]}), 422, "unknown-labels")
    problem(client.post("/models/refresh"), 401, "unauthorized")
    headers = {"Content-Type": "application/json"}
    for body in (b"{", b'{"objects": ["\\ud800"]}', b"[" * 10**5, b'{"x": NaN}'):
        problem(client.post("/relations", content=body, headers=headers), 400, "not-json")


def test_bodies_over_the_limit_are_refused(live: LiveService) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(40):
            yield b" " * 65536

    headers = {"Content-Type": "application/json"}
    size = 2 * 2**20 + 1
    response = live.client.post("/relations", content=b" " * size, headers=headers)
    problem(response, 413, "body-too-large")
    response = live.client.post("/relations", content=chunks(), headers=headers)
    problem(response, 413, "body-too-large")
    # A declared size is believed at once: nothing of the body is waited for.
    head, body = exchange(
        live.port,
        b"POST /missing HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        b"Content-Length: 999999999999999999999\r\n\r\n",
    )
    assert head.startswith((b"HTTP/1.1 413", b"HTTP/1.1 400"))
    assert b"Traceback" not in body


def test_a_body_that_breaks_off_leaves_the_service_well(live: LiveService) -> None:
    with socket.create_connection(("127.0.0.1", live.port), timeout=10) as connection:
        connection.sendall(
            b"POST /missing HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            b"Content-Length: 100\r\n\r\n{"
        )
    assert live.client.get("/health/ready").status_code == 200
    assert "Traceback" not in live.log.read_text()


def test_http_that_is_none_leaves_the_service_well(live: LiveService) -> None:
    for nonsense in (b"\x00" * 100, b"GET / HTTP/9.9\r\n\r\n", b"G" * 100_000):
        with suppress(ConnectionError):
            exchange(live.port, nonsense)
    assert live.client.get("/health/ready").status_code == 200


def test_the_log_is_json_with_request_ids_and_no_payload(live: LiveService) -> None:
    marker = "Xyzzy-in-payload"
    live.client.post(
        "/relations?q=" + marker, json={"objects": [marker]}, headers={"X-Request-Id": "find-me"}
    )
    live.client.get(f"/{marker}")
    text = live.log.read_text()
    assert marker not in text
    entries = [json.loads(line) for line in text.splitlines()]
    (entry,) = [entry for entry in entries if entry.get("request_id") == "find-me"]
    assert entry["message"].startswith("POST /relations 422 ")
    assert entry.pop("latency_ms") > 0
    assert entry.pop("process") == live.process.pid
    assert {name: entry[name] for name in entry if name not in {"time", "message"}} == {
        "level": "info",
        "logger": "app.access",
        "request_id": "find-me",
        "method": "POST",
        "route": "/relations",
        "status": 422,
        "outcome": "unknown-labels",
        "model": "home",
        "version": "1.0.0",
    }


def test_a_refresh_and_a_rollback_over_the_wire(tmp_path: Path) -> None:
    store = make_store(tmp_path / "store")
    service = launch(store, tmp_path / "log")
    headers = {"X-Admin-Key": ADMIN_KEY}
    try:
        publish(store, "home", "2.0.0", seed=2, alias="default")
        response = service.client.post("/models/refresh", headers=headers)
        assert response.json()["added"] == ["home@2.0.0"]
        alias = {"model": "home@1.0.0", "expected": "home@2.0.0"}
        response = service.client.put("/models/aliases/default", json=alias, headers=headers)
        assert response.status_code == 200
        answer = service.client.post("/missing", json=SCENE).json()
        assert answer["model"]["version"] == "1.0.0"
        corrupt(store, "home", "2.0.0")
        response = service.client.post("/models/refresh", headers=headers)
        problem(response, 409, "refresh-refused")
    finally:
        service.client.close()
        service.process.terminate()
        service.process.wait(timeout=30)


def test_a_broken_default_lives_and_is_not_ready(tmp_path: Path) -> None:
    store = make_store(tmp_path / "store")
    corrupt(store, "home", "1.0.0")
    service = launch(store, tmp_path / "log")
    try:
        assert service.client.get("/health/live").status_code == 200
        problem(service.client.get("/health/ready"), 503, "not-ready")
        assert "checksum_mismatch" in service.log.read_text()
    finally:
        service.client.close()
        service.process.terminate()
        service.process.wait(timeout=30)


# The service with a defect in one question: `python -c` in place of `python -m app`.
DEFECTIVE = """
import sys
from types import SimpleNamespace
from app.__main__ import main
from app.serving import questions

def fail(*_, **__):
    raise ZeroDivisionError

questions.reasoning = SimpleNamespace(**{**vars(questions.reasoning), "missing": fail})
sys.exit(main())
"""


def test_a_connection_outlives_a_defect(shared_store: Path, tmp_path: Path) -> None:
    service = launch(shared_store, tmp_path / "log", program=("-c", DEFECTIVE))
    try:
        body = json.dumps(SCENE).encode()
        request = (
            b"POST /missing HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            b"Content-Length: " + str(len(body)).encode() + b"\r\n\r\n" + body
        )
        with socket.create_connection(("127.0.0.1", service.port), timeout=10) as connection:
            for _ in range(3):
                connection.sendall(request)
                received = b""
                while not received.endswith(b"}"):
                    chunk = connection.recv(65536)
                    assert chunk, "the connection was dropped, and its client was not told"
                    received += chunk
                assert received.startswith(b"HTTP/1.1 500")
                assert b"/problems/internal-error" in received
        # Each is in the log once, under its id.
        assert service.log.read_text().count("ZeroDivisionError") == 3
    finally:
        service.client.close()
        service.process.terminate()
        service.process.wait(timeout=30)
