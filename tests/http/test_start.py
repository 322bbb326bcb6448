"""The start of ``python -m app``: first the port, then the models, then the page's address."""

import json
import os
import pty
import re
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.__main__ import _bind
from tests.http.stores import corrupt, publish
from tests.services import PATIENCE, LiveService, begin, free_port, is_ready, launch, wait_until

pytestmark = pytest.mark.system

Start = Callable[..., subprocess.Popen[str]]
IN_USE = "SCENE_{0}: another program uses 127.0.0.1:{1}; set SCENE_{0} to a free port\n"
WAITING = """
import sys, time
from pathlib import Path
from app.__main__ import main
from app.registry import Store

load = Store.load

def waiting(*arguments):
    while not Path({go!r}).exists():
        time.sleep(0.01)
    return load(*arguments)

Store.load = waiting
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


@pytest.mark.parametrize("name", ["PORT", "HEALTH_PORT"])
def test_a_used_port_ends_the_start(starting: Start, log: Path, name: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert starting(**{"PORT": 0, name: port}).wait(timeout=PATIENCE) == 3
    assert log.read_text() == IN_USE.format(name, port)


@pytest.mark.parametrize("host", ["203.0.113.1", "no-such-host.invalid"])
def test_an_invalid_address_ends_the_start(starting: Start, log: Path, host: str) -> None:
    assert starting(HOST=host, PORT=0).wait(timeout=PATIENCE) == 3
    (line,) = log.read_text().splitlines()
    assert line.startswith(f"SCENE_HOST: the service cannot listen on {host}:0: ")


def test_connections_are_refused_until_ready(starting: Start, log: Path, tmp_path: Path) -> None:
    port, go = free_port(), tmp_path / "go"
    process = starting(WAITING.format(go=str(go)), PORT=port)
    wait_for("Waiting for application startup", log, process)
    with socket.socket() as other, pytest.raises(OSError, match="in use"):
        other.bind(("127.0.0.1", port))
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    go.touch()
    wait_until(lambda: is_ready(port) or process.poll() is not None, log)
    assert process.poll() is None, log.read_text()


INTERRUPTED = """
import importlib.abc, os, runpy, signal, sys, time

class Interrupt(importlib.abc.MetaPathFinder):
    def find_spec(self, name, *_):
        if name == "numba":
            interrupt()

def interrupt(*_):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)

if {during!r} == "imports":
    sys.meta_path.insert(0, Interrupt())
else:
    import app.serving.runtime
    app.serving.runtime.load_model_set = interrupt
runpy.run_module("app", run_name="__main__")
"""
"""A program that gets Ctrl-C while it imports numba, or while it loads the models."""


@pytest.mark.parametrize("during", ["imports", "load"])
def test_an_interrupted_start_has_no_traceback(shared_store: Path, log: Path, during: str) -> None:
    program = ("-c", INTERRUPTED.format(during=during))
    process = begin(shared_store, log, program=program, SCENE_PORT=str(free_port()))
    # A shell reports this as status 130.
    assert process.wait(timeout=PATIENCE) == -signal.SIGINT
    assert "Traceback" not in log.read_text()
    assert "ready" not in log.read_text()


def test_both_address_families_have_one_port() -> None:
    sockets = _bind("::", 0, 1.0)
    try:
        names = [one.getsockname()[:2] for one in sockets]
    finally:
        for one in sockets:
            one.close()
    assert {host for host, _ in names} == {"0.0.0.0", "::"}
    assert len({port for _, port in names}) == 1


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
    assert any(line.startswith("from other machines: http://") for line in messages(log))
    assert not any("SCENE_API_KEY is not set" in line for line in messages(live.log))


def test_sighup_loads_the_store_at_once(store: Path, log: Path) -> None:
    with launch(store, log, SCENE_STORE_POLL="0", SCENE_ADMIN_KEY="a former key") as service:
        (warning,) = (line for line in messages(log) if "SCENE_ADMIN_KEY" in line)
        assert "has no effect" in warning
        publish(store, "home", "2.0.0", seed=2, alias="default")
        service.process.send_signal(signal.SIGHUP)
        wait_until(lambda: "the alias default names home@2.0.0 now" in log.read_text(), log)
        answer = service.client.post("/missing", json={"objects": ["bed"]}).json()
        assert answer["model"]["version"] == "2.0.0"
        corrupt(store, "home", "2.0.0")
        service.process.send_signal(signal.SIGHUP)
        refused = "the service refused the changes in the store: home@2.0.0: checksum_mismatch"
        wait_until(lambda: refused in log.read_text(), log)
        assert service.client.post("/missing", json={"objects": ["bed"]}).is_success


def test_a_closed_terminal_ends_the_service(shared_store: Path, log: Path) -> None:
    terminal, side = pty.openpty()
    process = begin(shared_store, log, stdin=side, SCENE_PORT="0")
    try:
        wait_for("ready: ", log, process)
        process.send_signal(signal.SIGHUP)
        wait_for("has loaded the store", log, process)
        os.close(terminal)
        process.send_signal(signal.SIGHUP)
        assert process.wait(timeout=PATIENCE) == -signal.SIGTERM
    finally:
        process.kill()
        os.close(side)
