"""The start of ``python -m app``: first the port, then the models, then the page's address."""

from __future__ import annotations

import json
import re
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.services import PATIENCE, LiveService, begin, free_port, is_ready, wait_until

pytestmark = pytest.mark.system

Start = Callable[..., subprocess.Popen[str]]
IN_USE = "SCENE_PORT: another program uses 127.0.0.1:{}; set SCENE_PORT to a free port\n"
HELD = """
import sys, time
from pathlib import Path
from app.__main__ import main
from app.registry import Store

load = Store.load

def held(*arguments):
    while not Path({go!r}).exists():
        time.sleep(0.01)
    return load(*arguments)

Store.load = held
sys.exit(main())
"""
"""A program for `begin`: it loads models as soon as a file exists."""


def messages(log: Path) -> list[str]:
    return [json.loads(line)["message"] for line in log.read_text().splitlines()]


def wait_for(text: str, log: Path, process: subprocess.Popen[str]) -> None:
    wait_until(lambda: text in log.read_text() or process.poll() is not None, log)
    assert process.poll() is None, log.read_text()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def starting(shared_store: Path, log: Path) -> Iterator[Start]:
    """Return a function that starts the service, which the end of the test kills."""
    started: list[subprocess.Popen[str]] = []

    def start(program: str | None = None, **variables: object) -> subprocess.Popen[str]:
        settings: Any = {f"SCENE_{name}": str(value) for name, value in variables.items()}
        if program:
            settings["program"] = ("-c", program)
        started.append(begin(shared_store, log, **settings))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait(timeout=PATIENCE)


@pytest.fixture
def taken() -> Iterator[socket.socket]:
    """A socket that is bound, and does not listen."""
    with socket.socket() as place:
        place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        place.bind(("127.0.0.1", 0))
        yield place


def test_a_used_port_ends_the_start_before_models_are_loaded(
    starting: Start, log: Path, taken: socket.socket
) -> None:
    taken.listen()
    port = taken.getsockname()[1]
    assert starting(PORT=port).wait(timeout=PATIENCE) == 3
    assert log.read_text() == IN_USE.format(port)


@pytest.mark.parametrize("host", ["203.0.113.1", "no-such-host.invalid"])
def test_an_address_that_the_machine_does_not_have(starting: Start, log: Path, host: str) -> None:
    assert starting(HOST=host, PORT=0).wait(timeout=PATIENCE) == 3
    (line,) = log.read_text().splitlines()
    assert line.startswith(f"SCENE_HOST: the service cannot listen on {host}:0: ")


def test_connections_are_refused_until_the_service_is_ready(
    starting: Start, log: Path, tmp_path: Path
) -> None:
    port, go = free_port(), tmp_path / "go"
    process = starting(HELD.format(go=str(go)), PORT=port)
    wait_for("Waiting for application startup", log, process)
    with socket.socket() as other, pytest.raises(OSError, match="in use"):
        other.bind(("127.0.0.1", port))
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    go.touch()
    wait_until(lambda: is_ready(port) or process.poll() is not None, log)
    assert process.poll() is None, log.read_text()


def test_the_log_names_the_page(live: LiveService, starting: Start, log: Path) -> None:
    assert any(f"http://127.0.0.1:{live.port}/ (" in line for line in messages(live.log))
    # `live` has compiled every loop.
    wait_for("ready: ", log, starting(PORT=0, HOST="0.0.0.0"))
    (line,) = [line for line in messages(log) if line.startswith("ready: ")]
    page = re.fullmatch(r"ready: (http://127\.0\.0\.1:\d+/) \(\d+ models?, \d+\.\d s\)", line)
    assert page is not None, line
    assert "<html" in httpx.get(page[1], timeout=PATIENCE).text
    assert not any("compil" in line for line in messages(log))
    assert any("SCENE_API_KEY is not set" in line for line in messages(log))
    assert not any("SCENE_API_KEY is not set" in line for line in messages(live.log))
