"""``SCENE_WORKERS=2`` as it is run: real processes, real sockets, real deaths."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.http.conftest import ADMIN_KEY, LiveService, launch
from tests.http.stores import corrupt, make_store, publish
from tests.http.test_problems import problem

pytestmark = [
    pytest.mark.system,
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="asks /proc for the workers"),
]

ADMIN = {"X-Admin-Key": ADMIN_KEY}
SCENE = {"objects": ["bed", "chair", "lamp"], "seed": 3}
QUESTIONS = ("relations", "missing", "outliers", "generate")


def workers(service: LiveService) -> set[int]:
    """The processes below the supervisor."""
    supervisor = service.process.pid
    return {int(pid) for pid in _children(supervisor).split()}


def _children(pid: int) -> str:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text()


def is_gone(pid: int) -> bool:
    """Whether a process has ended, reaped or not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


def wait_until(condition: Callable[[], bool], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come about in time"
        time.sleep(0.05)


def serving(service: LiveService) -> set[int]:
    """The workers that live and have said that they serve."""
    text = service.log.read_text()
    living = {pid for pid in workers(service) if not is_gone(pid)}
    return {pid for pid in living if f"worker {pid} serves" in text}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[LiveService]:
    variables = {"SCENE_WORKERS": "2", "TMPDIR": str(tmp_path)}
    live = launch(make_store(tmp_path / "store"), tmp_path / "log", **variables)
    try:
        wait_until(lambda: len(serving(live)) == 2)
        yield live
    finally:
        live.client.close()
        live.process.terminate()
        try:
            live.process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            live.process.kill()


def store(service: LiveService) -> Path:
    return service.log.parent / "store"


@contextmanager
def client_of(service: LiveService, worker: int) -> Iterator[httpx.Client]:
    """A fresh connection that this very worker has accepted: the others are held meanwhile."""
    others = workers(service) - {worker}
    address = f"http://127.0.0.1:{service.port}"
    with httpx.Client(base_url=address, headers={"X-Request-Id": "same"}, timeout=60) as client:
        for pid in others:
            os.kill(pid, signal.SIGSTOP)
        try:
            assert client.get("/health/live").status_code == 200
        finally:
            for pid in others:
                os.kill(pid, signal.SIGCONT)
        yield client


def said(service: LiveService, worker: int) -> list[bytes]:
    """What a worker answers, all of it, to the same requests."""
    with client_of(service, worker) as client:
        answers = [client.post(f"/{question}", json=SCENE) for question in QUESTIONS]
        answers += [client.get(path) for path in ("/models", "/models/home")]
    assert {answer.status_code for answer in answers} == {200}
    return [answer.content for answer in answers]


def refresh(service: LiveService, worker: int) -> httpx.Response:
    with client_of(service, worker) as client:
        return client.post("/models/refresh", headers=ADMIN)


def processes(service: LiveService, message: str) -> set[int]:
    """Which processes wrote log lines that begin so."""
    entries = map(json.loads, service.log.read_text().splitlines())
    return {entry["process"] for entry in entries if entry["message"].startswith(message)}


def test_two_workers_are_one_service(service: LiveService) -> None:
    one, two = serving(service)
    old = said(service, one)
    assert said(service, two) == old
    assert processes(service, "POST /generate 200") == {one, two}

    publish(store(service), "home", "2.0.0", seed=2, alias="default")
    assert said(service, one) == said(service, two) == old
    assert refresh(service, two).json()["added"] == ["home@2.0.0"]
    new = said(service, one)
    assert new == said(service, two) != old

    alias = {"model": "home@1.0.0", "expected": "home@2.0.0"}
    with client_of(service, one) as client:
        response = client.put("/models/aliases/default", json=alias, headers=ADMIN)
    assert response.status_code == 200
    rolled_back = said(service, two)
    assert rolled_back == said(service, one) != new

    publish(store(service), "home", "3.0.0", seed=3, alias="default")
    corrupt(store(service), "home", "3.0.0")
    for worker in (one, two):
        problem(refresh(service, worker), 409, "refresh-refused")
        assert said(service, one) == said(service, two) == rolled_back


def test_a_killed_worker_is_replaced_under_load(service: LiveService) -> None:
    victim, survivor = serving(service)
    expected = service.client.post("/missing", json=SCENE).json()["missing"]
    address = f"http://127.0.0.1:{service.port}/missing"
    wrong: list[Any] = []
    answered = 0
    stop = threading.Event()

    def ask() -> None:
        nonlocal answered
        while not stop.is_set():
            try:
                # A connection each: one to the dead may break, and only that.
                response = httpx.post(address, json=SCENE, timeout=60)
            except httpx.TransportError:
                continue
            if response.status_code != 200 or response.json()["missing"] != expected:
                wrong.append(response.text)
            answered += 1
            time.sleep(0.02)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        # Published and not refreshed: what replaces the dead must not serve it.
        publish(store(service), "home", "2.0.0", seed=2, alias="default")
        os.kill(victim, signal.SIGKILL)
        wait_until(lambda: is_gone(victim))
        before = answered
        wait_until(lambda: len(serving(service)) == 2 and answered > before)
    finally:
        stop.set()
        thread.join(timeout=60)
    assert not wrong
    (new,) = serving(service) - {survivor}
    assert new != victim
    before_refresh = said(service, survivor)
    assert said(service, new) == before_refresh
    assert refresh(service, new).status_code == 200
    assert said(service, new) == said(service, survivor) != before_refresh
    assert f"worker {victim} ended by signal 9" in service.log.read_text()


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_it_stops_in_order(service: LiveService, signum: signal.Signals) -> None:
    pids = workers(service)
    # A request that is being sent when the signal comes is still answered.
    with socket.create_connection(("127.0.0.1", service.port), timeout=60) as connection:
        body = json.dumps(SCENE).encode()
        head = "POST /missing HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
        connection.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body[:5])
        time.sleep(0.5)
        service.process.send_signal(signum)
        time.sleep(0.5)
        connection.sendall(body[5:])
        assert connection.recv(65536).startswith(b"HTTP/1.1 200")
    assert service.process.wait(timeout=60) == 0
    assert all(map(is_gone, pids))
    assert service.log.read_text().count("Application shutdown complete") == 2
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", service.port), timeout=5)


def test_no_worker_outlives_its_supervisor(service: LiveService) -> None:
    pids = workers(service)
    service.process.kill()
    wait_until(lambda: all(map(is_gone, pids)), 60)


def test_an_address_in_use_is_said(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        settings = {"SCENE_STORE": str(tmp_path), "SCENE_PORT": port, "SCENE_WORKERS": "2"}
        run = subprocess.run(
            [sys.executable, "-m", "app"],
            env=os.environ | settings,
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert run.returncode == 3
    assert "Address already in use" in run.stderr
    assert "Traceback" not in run.stderr
