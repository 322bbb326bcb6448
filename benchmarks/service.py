"""Benchmark of the service: start-up time, and latency of /missing on one warm connection."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import quantiles

import httpx

from benchmarks.load import servers
from benchmarks.load.questions import labels_of
from benchmarks.report import Result
from benchmarks.timing import Timings

READY, IMPORTS = "python -m app, until /health/ready", "python, importing numba, numpy and FastAPI"
LIVE, MISSING = "GET /health/live", "POST /missing"


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
        ServerError: the store is missing, or the service does not become ready.
    """
    if not store.is_dir():
        raise servers.ServerError(
            f"the store {store} does not exist: publish a model or use --store"
        )
    ready: list[float] = []
    imports: list[float] = []
    requested: dict[str, list[float]] = {}
    facts: dict[str, str | int | float] = {}
    for turn in range(rounds):
        imports.append(_seconds(_import_libraries))
        with servers.service(store, pinned=False) as started:
            ready.append(started.seconds)
            if turn == rounds - 1:
                requested, facts = _ask(started.port, objects, requests)
    return [
        Result(
            title="Start-up of the service",
            subject=READY,
            timings=Timings({READY: ready, IMPORTS: imports}),
        ),
        Result(
            title=f"One question about {objects} objects, one connection kept alive",
            subject=MISSING,
            timings=Timings(requested),
            facts=facts,
        ),
    ]


def _ask(
    port: int, objects: int, requests: int
) -> tuple[dict[str, list[float]], dict[str, str | int | float]]:
    scene = {"objects": labels_of(port)[:objects]}
    client = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60)

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
