"""``.venv-ray/bin/python -m benchmarks.engines``: Ray Serve beside plain processes.

Both have two replicas behind HAProxy on this machine. The load runs on the same cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import httpx
import typer

from benchmarks.load.measure import compare, concurrency
from benchmarks.load.questions import requests
from benchmarks.load.servers import ServerError, free_port

AIM = 0.9
"""Minimum rate of Ray Serve as a fraction of the rate of plain processes."""

_ROOT = Path(__file__).resolve().parents[1]
_KIND, _ROUTE = "12 labels", "/missing"
_PATIENCE = 180.0
_PROXY = """
global
    nbthread 1
defaults
    mode http
    timeout connect 5s
    timeout client 60s
    timeout server 60s
    timeout http-keep-alive 20s
    option http-no-delay
    http-reuse always
    balance leastconn
listen service
    bind 127.0.0.1:{port}
    option httpchk GET /health/ready
"""


def main(
    connections: Annotated[int, typer.Option(min=1, help="connections of the client")] = 16,
    seconds: Annotated[float, typer.Option(min=0.1, help="length of one window")] = 3,
    replicas: Annotated[int, typer.Option(min=1, help="replicas of each engine")] = 2,
) -> None:
    """Send the same requests to both engines in alternating windows until both are steady."""
    with ExitStack() as stack:
        ports = tuple(
            stack.enter_context(engine(replicas)) for engine in (_ray_serve, plain_processes)
        )
        url = f"http://127.0.0.1:{ports[1]}/models/default/vocabulary"
        entries = httpx.get(url).raise_for_status().json()["objects"]
        bodies = requests(_KIND, _ROUTE, [e["label"] for e in entries if not e["structure"]])
        names = (_KIND, _ROUTE, f"{connections} connections")
        load = concurrency(connections)
        comparison = compare((ports[0], ports[1]), bodies, load, names, seconds=seconds)
    print(f"{_ROUTE}, {_KIND}, {connections} connections, {replicas} replicas")
    for name, window in (("Ray Serve", comparison.service), ("plain processes", comparison.plain)):
        p50, p99 = (1e3 * window.quantile(q) for q in (0.5, 0.99))
        print(
            f"{name}: {window.rate:,.0f} req/s, p50 {p50:.1f} ms, p99 {p99:.1f} ms, "
            f"{window.errors} errors"
        )
    steady = "" if comparison.steady else " (not steady)"
    verdict = "met" if comparison.rate_ratio >= AIM else "MISSED"
    ratios = " ".join(f"{ratio:.2f}" for ratio in comparison.ratios)
    print(f"ratio {comparison.rate_ratio:.2f}{steady}, windows {ratios}; aim {AIM}: {verdict}")


@contextmanager
def _ray_serve(replicas: int) -> Iterator[int]:
    port = free_port()
    command = ["deploy/ray/run.py", f"--port={port}", f"--replicas={replicas}"]
    with _running([sys.executable, *command], port):
        yield port


@contextmanager
def plain_processes(replicas: int) -> Iterator[int]:
    """Start plain processes behind HAProxy, and yield the proxy's port."""
    with ExitStack() as stack:
        text = _PROXY.format(port=(port := free_port()))
        for number in range(replicas):
            service = free_port()
            environment = {"SCENE_PORT": str(service)}
            stack.enter_context(_running([sys.executable, "-m", "app"], service, environment))
            text += f"    server replica{number} 127.0.0.1:{service} check\n"
        config = Path(stack.enter_context(TemporaryDirectory())) / "haproxy.cfg"
        config.write_text(text, "utf-8")
        stack.enter_context(_running(["haproxy", "-db", "-f", str(config)], port))
        yield port


@contextmanager
def _running(
    command: list[str], port: int, variables: dict[str, str] | None = None
) -> Iterator[None]:
    process = subprocess.Popen(
        command,
        cwd=_ROOT,
        env=os.environ | (variables or {}),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + _PATIENCE
        while not _is_ready(port):
            if process.poll() is not None or time.monotonic() > deadline:
                raise ServerError(f"{command[0]} is not ready")
            time.sleep(0.2)
        yield
    finally:
        process.terminate()
        process.wait(_PATIENCE)


def _is_ready(port: int) -> bool:
    try:
        return httpx.get(f"http://127.0.0.1:{port}/health/ready").is_success
    except httpx.TransportError:
        return False


if __name__ == "__main__":
    typer.run(main)
