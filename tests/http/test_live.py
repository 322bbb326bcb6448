"""``python -m app`` as a process of its own, over real sockets."""

from __future__ import annotations

import json
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.http.test_problems import problem
from tests.services import LiveService, launch

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
    with launch(shared_store, tmp_path / "log") as service:
        assert service.client.get("/health/ready").status_code == 200
        # Five seconds are promised on a quiet machine; tests share theirs.
        assert time.monotonic() - began < 20
    # It stopped in order, and then by the signal that it was sent, as a shell expects.
    assert service.process.returncode == -signal.SIGTERM
    assert "Application shutdown complete" in service.log.read_text()


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


# The service with a defect in one question: `python -c` in place of `python -m app`.
DEFECTIVE = """
import sys
from types import SimpleNamespace
from app.__main__ import main
from app.serving import questions

def fail(*_, **__):
    raise ZeroDivisionError

questions.questions = SimpleNamespace(**{**vars(questions.questions), "missing": fail})
sys.exit(main())
"""


def test_a_connection_outlives_a_defect(shared_store: Path, tmp_path: Path) -> None:
    with launch(shared_store, tmp_path / "log", program=("-c", DEFECTIVE)) as service:
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
