"""Start the service or the plain FastAPI app, each as a process on a fixed processor core."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

_PATIENCE = 180.0
ROOT = Path(__file__).resolve().parents[2]


class ServerError(RuntimeError):
    """A server process ended, or the server was not ready in time."""


@dataclass(frozen=True)
class Server:
    """A server that is ready to answer.

    Attributes:
        port: port on 127.0.0.1.
        pid: process id.
        seconds: time from the start of the process until /health/ready returns status 200.
    """

    port: int
    pid: int
    seconds: float

    @property
    def memory(self) -> int:
        """Resident memory of the process in bytes."""
        pages = Path(f"/proc/{self.pid}/statm").read_text("ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")


def cores() -> tuple[set[int], set[int]]:
    """Return the processor cores for the servers and the cores for the client.

    The two sets are disjoint if at least two cores are available.
    """
    every = sorted(os.sched_getaffinity(0))
    return ({every[0]}, set(every[1:])) if len(every) > 1 else (set(every), set(every))


@contextmanager
def service(
    store: Path, *, root: Path = ROOT, pinned: bool = True, **settings: str
) -> Iterator[Server]:
    """Run the service (``python -m app``).

    Args:
        store: folder of the model store.
        root: folder of the sources.
        pinned: whether the service stays on the servers' core, see `cores`.
        settings: further settings of the service. `name` sets the variable SCENE_NAME.
    """
    port = free_port()
    variables = {"SCENE_STORE": str(store.resolve()), "SCENE_PORT": str(port)}
    variables |= {f"SCENE_{name.upper()}": value for name, value in settings.items()}
    if root != ROOT:
        variables["PYTHONPATH"] = os.pathsep.join((str(root), str(root / "clients" / "python")))
    command = [sys.executable, "-m", "app"]
    with running(command, port, variables, root=root, pinned=pinned) as server:
        yield server


@contextmanager
def plain() -> Iterator[Server]:
    """Run the plain app (``python -m benchmarks.load.plain``)."""
    port = free_port()
    command = [sys.executable, "-m", "benchmarks.load.plain", str(port)]
    with running(command, port, {}, pinned=True) as server:
        yield server


def free_port() -> int:
    """Return a free port of the loopback address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def running(
    command: list[str],
    port: int,
    variables: dict[str, str],
    *,
    root: Path = ROOT,
    pinned: bool = False,
) -> Iterator[Server]:
    """Run a server as a process until the end of the context.

    Args:
        command: the program and its arguments.
        port: port of the server on 127.0.0.1.
        variables: its environment, in addition to this process's.
        root: its working directory.
        pinned: whether the server stays on the servers' core, see `cores`.

    Raises:
        ServerError: the process ended, or the server was not ready in time.
    """
    # SCENE_* settings of this machine must not affect the benchmark.
    environment = {name: value for name, value in os.environ.items() if name[:6] != "SCENE_"}
    start = time.perf_counter()
    process = subprocess.Popen(
        command,
        cwd=root,
        env=environment | variables,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    if pinned:
        os.sched_setaffinity(process.pid, cores()[0])
    try:
        _wait(process, port, start)
        yield Server(port, process.pid, time.perf_counter() - start)
    finally:
        process.terminate()
        try:
            process.wait(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait(process: subprocess.Popen[bytes], port: int, start: float) -> None:
    with httpx.Client(timeout=_PATIENCE) as client:
        while time.perf_counter() - start < _PATIENCE:
            if process.poll() is not None:
                raise ServerError(f"the server ended with status {process.returncode}")
            try:
                if client.get(f"http://127.0.0.1:{port}/health/ready").is_success:
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.005)
    raise ServerError(f"the server was not ready within {_PATIENCE:.0f} s")
