"""The start of ``python -m app``: first the port, then the models, then the page's address."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.services import LiveService, begin, free_port, wait_until

pytestmark = pytest.mark.system

IN_USE = "SCENE_PORT: another program uses 127.0.0.1:{}; set SCENE_PORT to a free port\n"


def messages(log: Path) -> list[str]:
    return [json.loads(line)["message"] for line in log.read_text().splitlines()]


def wait_for(text: str, log: Path, process: subprocess.Popen[str]) -> None:
    wait_until(lambda: text in log.read_text() or process.poll() is not None, log, seconds=60)
    assert process.poll() is None, log.read_text()


@contextmanager
def starting(store: Path, log: Path, **variables: str) -> Iterator[subprocess.Popen[str]]:
    process = begin(store, log, **variables)
    try:
        yield process
    finally:
        process.kill()
        process.wait(timeout=30)


@pytest.fixture
def taken() -> Iterator[socket.socket]:
    """A socket that is bound, and does not listen."""
    with socket.socket() as place:
        place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        place.bind(("127.0.0.1", 0))
        yield place


def test_a_used_port_ends_the_start_before_models_are_loaded(
    shared_store: Path, tmp_path: Path, taken: socket.socket
) -> None:
    taken.listen()
    port = taken.getsockname()[1]
    with starting(shared_store, tmp_path / "log", SCENE_PORT=str(port)) as process:
        assert process.wait(timeout=30) == 3
    assert (tmp_path / "log").read_text() == IN_USE.format(port)


def test_a_port_taken_during_the_start_ends_the_start(
    shared_store: Path, tmp_path: Path, taken: socket.socket
) -> None:
    port = taken.getsockname()[1]
    log = tmp_path / "log"
    with starting(shared_store, log, SCENE_PORT=str(port)) as process:
        wait_for("Waiting for application startup", log, process)
        taken.listen()
        assert process.wait(timeout=60) == 3
    assert log.read_text().endswith(IN_USE.format(port))
    assert "Traceback" not in log.read_text()


@pytest.mark.parametrize("host", ["203.0.113.1", "no-such-host.invalid"])
def test_an_address_that_the_machine_does_not_have(
    shared_store: Path, tmp_path: Path, host: str
) -> None:
    log = tmp_path / "log"
    with starting(shared_store, log, SCENE_HOST=host, SCENE_PORT="0") as process:
        assert process.wait(timeout=60) == 3
    (line,) = log.read_text().splitlines()
    assert line.startswith(f"SCENE_HOST: the service cannot listen on {host}:0: ")


def test_connections_are_refused_until_the_service_is_ready(
    shared_store: Path, tmp_path: Path
) -> None:
    port = free_port()
    log = tmp_path / "log"
    with starting(shared_store, log, SCENE_PORT=str(port)) as process:
        wait_for("Waiting for application startup", log, process)
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind(("127.0.0.1", port))
        refused = 0
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=5).close()
            except ConnectionRefusedError:
                refused += 1
                assert process.poll() is None
                time.sleep(0.01)
            else:
                break
        assert refused
        assert httpx.get(f"http://127.0.0.1:{port}/health/ready").status_code == 200


def test_the_log_names_the_page(live: LiveService, shared_store: Path, tmp_path: Path) -> None:
    assert any(f"http://127.0.0.1:{live.port}/ (" in line for line in messages(live.log))
    log = tmp_path / "log"
    # `live` has compiled every loop.
    with starting(shared_store, log, SCENE_PORT="0", SCENE_HOST="0.0.0.0") as process:
        wait_for("ready: ", log, process)
        (line,) = [line for line in messages(log) if line.startswith("ready: ")]
        found = re.fullmatch(r"ready: (http://127\.0\.0\.1:\d+/) \(\d+ models?, \d+\.\d s\)", line)
        assert found is not None, line
        assert "<html" in httpx.get(found[1]).text
    assert not any("compil" in line for line in messages(log))
    assert any("SCENE_API_KEY is not set" in line for line in messages(log))
    assert not any("SCENE_API_KEY is not set" in line for line in messages(live.log))
