"""Clients that are slow, leave, or do not read: bounded each, and nobody else waits for them."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from app.api.connections import MAX_HEAD
from tests.chaos.service import control, descriptors, running
from tests.chaos.wire import BODY, Wire, exchange
from tests.http.conftest import LiveService
from tests.http.stores import make_store

pytestmark = pytest.mark.system

HEAD = (
    b"POST /outliers HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
    b"Content-Length: %d\r\n\r\n"
)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """A service of little patience."""
    folder = tmp_path_factory.mktemp("connections")
    with running(make_store(folder / "store"), folder / "log", client_timeout="1") as service:
        yield service


def connect(service: LiveService) -> socket.socket:
    return socket.create_connection(("127.0.0.1", service.port), timeout=30)


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        (b"", ()),
        (b"\r\n", ()),
        (b"POST /outl", (408,)),
        (HEAD[:60], (408,)),
        (HEAD % len(BODY), (408,)),
        (HEAD % len(BODY) + BODY[:-1], (408,)),
        (HEAD % len(BODY) + BODY + b"GET /", (200,)),
    ],
    ids=["silence", "empty line", "method", "head", "no body", "part of a body", "half a second"],
)
def test_who_stops_in_the_middle_is_not_waited_for(
    service: LiveService, part: bytes, expected: tuple[int, ...]
) -> None:
    answers, closed = exchange(service.port, Wire("", [part], None))
    assert tuple(answer.status for answer in answers) == expected
    assert closed
    for answer in answers:
        if answer.status == 408:
            is_problem(answer, 408, "request-timeout")


def test_a_head_without_end_is_refused(service: LiveService) -> None:
    head = HEAD[:40] + b"x: " + b"y" * (2 * MAX_HEAD)
    (answer,), closed = exchange(service.port, Wire("", [head], None))
    is_problem(answer, 431, "head-too-large")
    assert closed


def is_problem(answer: Any, status: int, slug: str) -> None:
    assert answer.status == status
    assert json.loads(answer.body)["type"] == f"/problems/{slug}"


@pytest.mark.parametrize("beginning", [b"", HEAD[:40], HEAD % 1000], ids=["lines", "head", "body"])
def test_a_byte_now_and_then_keeps_no_connection(service: LiveService, beginning: bytes) -> None:
    """Slow loris: sixty at once; others are answered meanwhile, and all of them are closed."""
    before = control(service)
    files = descriptors(service)
    slow = [connect(service) for _ in range(60)]
    for connection in slow:
        connection.sendall(beginning)
    byte = b" " if beginning else b"\r\n"
    for _ in range(100):
        if not slow:
            break
        for connection in list(slow):
            try:
                connection.sendall(byte)
                connection.settimeout(0.001)
                # An answer is on its way to the end of the connection; the end itself is b"".
                while connection.recv(4096):
                    pass
            except TimeoutError:
                continue
            except OSError:
                pass
            connection.close()
            slow.remove(connection)
        assert control(service) == before
        time.sleep(0.1)
    assert slow == []
    assert descriptors(service) <= files + 2


def test_who_leaves_in_the_middle_is_forgotten(service: LiveService) -> None:
    before = control(service)
    files = descriptors(service)
    request = HEAD % len(BODY) + BODY
    for end in range(0, len(request) + 1, 7):
        with connect(service) as connection:
            connection.sendall(request[:end])
    body = json.dumps({"scenes": [json.loads(BODY)] * 256}).encode()
    batch = HEAD.replace(b"outliers", b"missing/batch") % len(body) + body
    for _ in range(5):
        with connect(service) as connection:
            connection.sendall(batch)
            connection.recv(1)  # in the middle of the answer
    assert control(service) == before
    assert "Traceback" not in service.log.read_text()
    for _ in range(100):
        if descriptors(service) <= files + 2:
            break
        time.sleep(0.1)
    assert descriptors(service) <= files + 2


def test_who_does_not_read_is_cut_off(service: LiveService) -> None:
    before = control(service)
    files = descriptors(service)
    body = json.dumps({"scenes": [json.loads(BODY)] * 256}).encode()
    batch = HEAD.replace(b"outliers", b"missing/batch") % len(body) + body
    unread = []
    for _ in range(3):
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(0.5)
        connection.connect(("127.0.0.1", service.port))
        with suppress(OSError):
            connection.sendall(batch * 20)
        unread.append(connection)
    assert control(service) == before
    for _ in range(300):
        if descriptors(service) <= files + 2:
            break
        time.sleep(0.1)
    assert descriptors(service) <= files + 2
    for connection in unread:
        connection.close()
