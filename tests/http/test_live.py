"""``python -m app`` as a process of its own, over real sockets."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest

from tests.services import launch

pytestmark = pytest.mark.system

SCENE = {"objects": ["bed", "chair", "lamp"]}


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
