"""Benchmark of the service: start-up time, and latency of /missing on one warm connection."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import quantiles

import httpx

from benchmarks.report import Result
from benchmarks.timing import Timings

READY, IMPORTS = "python -m app, until /health/ready", "python, importing numba, numpy and FastAPI"
LIVE, MISSING = "GET /health/live", "POST /missing"

_PATIENCE = 60.0
_ROOT = Path(__file__).resolve().parent.parent


class NoModelError(RuntimeError):
    """The service cannot be measured: the model store is missing, or the service is not ready."""


@dataclass(frozen=True)
class Service:
    """A service that is ready to answer.

    Attributes:
        client: HTTP client with one keep-alive connection to the service.
        seconds: time from the start of the process until /health/ready returns status 200.
    """

    client: httpx.Client
    seconds: float


def service(
    *, store: Path = Path("model_store"), objects: int = 12, requests: int = 500, rounds: int = 3
) -> list[Result]:
    """Measure the start-up time of the service, and the latency on one connection.

    Args:
        store: directory of the model store. The default model is queried.
        objects: number of objects in the scene.
        requests: number of measured requests to each of two routes. Requests to the routes
            alternate. Additional warm-up requests (10 %) are not measured.
        rounds: number of times that the service is started.

    Raises:
        NoModelError: the service cannot be measured.
    """
    if not store.is_dir():
        raise NoModelError(f"the store {store} does not exist: publish a model or use --store")
    ready: list[float] = []
    imports: list[float] = []
    requested: dict[str, list[float]] = {}
    facts: dict[str, str | int | float] = {}
    for turn in range(rounds):
        imports.append(_seconds(_import_libraries))
        with running(store) as started:
            ready.append(started.seconds)
            if turn == rounds - 1:
                requested, facts = _ask(started.client, objects, requests)
    return [
        Result(
            name="start-up",
            title="Start-up of the service",
            subject=READY,
            timings=Timings({READY: ready, IMPORTS: imports}),
        ),
        Result(
            name="request",
            title=f"One question about {objects} objects, one connection kept alive",
            subject=MISSING,
            timings=Timings(requested),
            facts=facts,
        ),
    ]


@contextmanager
def running(store: Path) -> Iterator[Service]:
    """Run the service in a separate process, and stop the process at the end of the context.

    Raises:
        NoModelError: the process ended, or the service was not ready in time.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # SCENE_* settings of this machine must not affect the benchmark.
    environment = {name: value for name, value in os.environ.items() if name[:6] != "SCENE_"}
    environment |= {"SCENE_STORE": str(store.resolve()), "SCENE_PORT": str(port)}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "app"], cwd=_ROOT, env=environment, stderr=subprocess.DEVNULL
    )
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=_PATIENCE) as client:
            _wait(client, process, start)
            yield Service(client, time.perf_counter() - start)
    finally:
        process.terminate()
        try:
            process.wait(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait(client: httpx.Client, process: subprocess.Popen[bytes], start: float) -> None:
    answer = "no answer"
    while time.perf_counter() - start < _PATIENCE:
        if process.poll() is not None:
            raise NoModelError(f"the service ended with status {process.returncode}")
        try:
            response = client.get("/health/ready")
        except httpx.TransportError:
            time.sleep(0.005)
            continue
        if response.is_success:
            return
        # The service listens only after loading its models. Now it cannot become ready any more.
        answer = response.json()["title"]
        break
    raise NoModelError(f"the service is not ready: {answer}")


def _ask(
    client: httpx.Client, objects: int, requests: int
) -> tuple[dict[str, list[float]], dict[str, str | int | float]]:
    vocabulary = client.get("/models/default/vocabulary").raise_for_status().json()
    labels = [entry["label"] for entry in vocabulary["objects"] if not entry["structure"]]
    scene = {"objects": labels[:objects]}

    def live() -> None:
        client.get("/health/live").raise_for_status()

    def missing() -> None:
        client.post("/missing", json=scene).raise_for_status()

    for _ in range(max(1, requests // 10)):
        live()
        missing()
    seconds: dict[str, list[float]] = {MISSING: [], LIVE: []}
    for _ in range(requests):
        seconds[MISSING].append(_seconds(missing))
        seconds[LIVE].append(_seconds(live))
    model = client.post("/missing", json=scene).json()["model"]
    facts: dict[str, str | int | float] = {
        "model": f"{model['name']} {model['version']} ({model['variant']})",
        "classes": len(vocabulary["objects"]),
        f"{MISSING} / {LIVE}": 1 / Timings(seconds).ratio(MISSING, LIVE).median,
    }
    for name, values in seconds.items():
        deciles = quantiles(values, n=10, method="inclusive")
        facts[f"{name}, p50 in ms"] = deciles[4] * 1e3
        facts[f"{name}, p90 in ms"] = deciles[8] * 1e3
    return seconds, facts


def _import_libraries() -> None:
    subprocess.run([sys.executable, "-c", "import numba, numpy, fastapi"], check=True)


def _seconds(action: Callable[[], None]) -> float:
    start = time.perf_counter()
    action()
    return time.perf_counter() - start
