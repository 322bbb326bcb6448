"""Keeping processes running, with workers that load nothing: a few lines of Python each."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from app.workers.supervisor import Patience, Supervisor

pytestmark = [pytest.mark.anyio, pytest.mark.system]

QUICK = Patience(prepare=30, swap=30, drain=2, stable=60, pause=0.01, longest_pause=0.05)

# Says what a worker says, as fast as Python starts; notes its process in a file of its own.
WORKER = """
import json, os, pathlib, signal, socket, sys
listener, channel = map(int, sys.argv[-2:])
notes = pathlib.Path(sys.argv[1])
{before}
line = socket.socket(fileno=channel).makefile("rw", buffering=1)
def say(kind, change=0, generation=None, failures=()):
    print(json.dumps(dict(kind=kind, change=change, generation=generation,
        failures=failures)), file=line, flush=True)
say("hello")
for text in line:
    message = json.loads(text)
    if message["kind"] == "prepare":
        {prepare}
    if message["kind"] == "commit":
        say("committed", message["change"])
        (notes / str(os.getpid())).touch()
        {after}
"""
PREPARED = 'say("prepared", message["change"], "the only one")'


def supervisor(
    notes: Path,
    listener: socket.socket,
    *,
    count: int = 2,
    before: str = "",
    prepare: str = PREPARED,
    after: str = "pass",
    patience: Patience = QUICK,
    metrics: str | None = None,
) -> Supervisor:
    code = textwrap.dedent(WORKER).format(before=before, prepare=prepare, after=after)
    command = (sys.executable, "-S", "-c", code, str(notes))
    return Supervisor(listener, count, command=command, patience=patience, metrics=metrics)


@pytest.fixture
def listener() -> socket.socket:
    return socket.create_server(("127.0.0.1", 0))


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    folder = tmp_path / "notes"
    folder.mkdir()
    return folder


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():  # noqa: ASYNC110  of files and processes, which set no event
            await asyncio.sleep(0.02)


def numbers(folder: Path) -> set[int]:
    """The processes that have left a file here."""
    return {int(path.stem.rpartition("_")[2]) for path in folder.iterdir()}


async def served(notes: Path, count: int) -> set[int]:
    """The processes that have come to serve, once there are so many."""
    await until(lambda: len(numbers(notes)) >= count)
    return numbers(notes)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


async def test_workers_that_end_are_replaced(notes: Path, listener: socket.socket) -> None:
    with listener:
        running = asyncio.create_task(supervisor(notes, listener).run())
        first = await served(notes, 2)
        for pid in first:
            os.kill(pid, signal.SIGKILL)
        everyone = await served(notes, 4)
        assert [is_alive(pid) for pid in first] == [False, False]
        os.kill(os.getpid(), signal.SIGTERM)
        assert await running == 0
        assert not any(map(is_alive, everyone))


@pytest.mark.parametrize(
    ("before", "prepare"),
    [
        ("sys.exit(1)", PREPARED),
        ("os.kill(os.getpid(), signal.SIGKILL)", PREPARED),
        ("", 'say("refused", message["change"], None, [dict(subject="x", reason="y", detail="")])'),
        ("os.close(channel); import time; time.sleep(60)", PREPARED),
    ],
)
async def test_it_gives_up_where_no_worker_ever_serves(
    notes: Path, listener: socket.socket, before: str, prepare: str
) -> None:
    with listener:
        hopeless = supervisor(notes, listener, before=before, prepare=prepare)
        async with asyncio.timeout(60):
            assert await hopeless.run() == 3
    assert numbers(notes) == set()


async def test_a_command_that_is_none_is_given_up(listener: socket.socket) -> None:
    with listener:
        nothing = Supervisor(listener, 2, command=("/nonexistent/worker",), patience=QUICK)
        assert await nothing.run() == 3


async def test_it_does_not_give_up_while_one_serves(notes: Path, listener: socket.socket) -> None:
    # Whoever comes second ends before it serves, again and again.
    mine = "mine = notes.with_name('mine')\ntry: mine.open('x')\nexcept OSError: "
    before = mine + "(notes.with_name('tries')).open('a').write('x'); sys.exit(1)"
    with listener:
        running = asyncio.create_task(supervisor(notes, listener, before=before).run())
        await served(notes, 1)
        tries = notes.with_name("tries")
        await until(lambda: tries.exists() and len(tries.read_text()) >= 2 * QUICK.starts)
        assert not running.done()
        os.kill(os.getpid(), signal.SIGINT)
        assert await running == 0


async def test_a_worker_that_does_not_drain_is_killed(notes: Path, listener: socket.socket) -> None:
    deaf = "signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    with listener:
        running = asyncio.create_task(supervisor(notes, listener, before=deaf).run())
        pids = await served(notes, 2)
        os.kill(os.getpid(), signal.SIGTERM)
        async with asyncio.timeout(30):
            assert await running == 0
        assert not any(map(is_alive, pids))


async def test_metrics_of_the_dead_are_forgotten(
    notes: Path, listener: socket.socket, tmp_path: Path
) -> None:
    pytest.importorskip("prometheus_client")
    metrics = tmp_path / "metrics"
    metrics.mkdir()
    live = "os.environ['PROMETHEUS_MULTIPROC_DIR'] + f'/gauge_liveall_{os.getpid()}.db'"
    after = f"pathlib.Path({live}).touch()"
    with listener:
        running = asyncio.create_task(
            supervisor(notes, listener, after=after, metrics=str(metrics)).run()
        )
        dead, *_ = first = await served(notes, 2)
        os.kill(dead, signal.SIGKILL)
        (new,) = await served(notes, 3) - first
        living = (first | {new}) - {dead}
        await until(lambda: numbers(metrics) == living)
        os.kill(os.getpid(), signal.SIGTERM)
        assert await running == 0


def test_it_imports_no_model(tmp_path: Path) -> None:
    program = "import sys, app.__main__, app.workers.supervisor; print(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert {"torch", "numba", "numpy", "fastapi"}.isdisjoint(run.stdout.split())
