"""``python -m benchmarks.replicas``: waiting times of one and two replicas beside the model.

Requests arrive at random times at a fraction of the measured capacity, through HAProxy. The table
compares the measured mean latency with the model of `benchmarks.queueing`: the latency without
load, plus the predicted waiting time. All processes share the cores of this machine, so the
capacity of two replicas contains the cost of the client.
"""

from __future__ import annotations

from typing import Annotated

import httpx
import numpy as np
import typer
import uvloop

from benchmarks.engines import plain_processes
from benchmarks.load.questions import requests
from benchmarks.load.windows import Window, at_concurrency, at_times
from benchmarks.queueing import mean_wait

SHARES = (0.3, 0.5, 0.7, 0.8)
"""Offered rates as fractions of the capacity."""

_ROUTE, _KIND, _MANY = "/missing", "12 labels", 32


def main(
    seconds: Annotated[float, typer.Option(min=0.1, help="length of one window")] = 6,
    replicas: Annotated[list[int] | None, typer.Option(help="numbers of replicas")] = None,
) -> None:
    """Measure latency at random arrivals, and compare it with the queueing model."""
    print("replicas  share  offered/s  mean ms  model ms  p99 ms  other status")
    for count in replicas or (1, 2):
        with plain_processes(count) as port:
            bodies = requests(_KIND, _ROUTE, _labels(port))
            uvloop.run(at_concurrency(port, bodies, _MANY, 2))
            capacity = uvloop.run(at_concurrency(port, bodies, _MANY, seconds)).rate
            alone = float(uvloop.run(at_concurrency(port, bodies, 1, 2)).latency.mean())
            print(f"{count:8}  capacity {capacity:.0f}/s, {1e3 * alone:.2f} ms at one connection")
            for share in SHARES:
                rate = share * capacity
                window = uvloop.run(at_times(port, bodies, _arrivals(rate, seconds), 256))
                predicted = alone + mean_wait(rate, count / capacity, count)
                print(_line(count, share, rate, window, predicted))


def _arrivals(rate: float, seconds: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the times of a Poisson process."""
    pauses = np.random.default_rng(0).exponential(1 / rate, round(rate * seconds))
    return np.cumsum(pauses)


def _line(count: int, share: float, rate: float, window: Window, predicted: float) -> str:
    mean, p99 = 1e3 * window.latency.mean(), 1e3 * window.quantile(0.99)
    return (
        f"{count:8}  {share:5.1f}  {rate:9.0f}  {mean:7.2f}  {1e3 * predicted:8.2f}  {p99:6.2f}  "
        f"{window.errors}"
    )


def _labels(port: int) -> list[str]:
    url = f"http://127.0.0.1:{port}/models/default/vocabulary"
    entries = httpx.get(url).raise_for_status().json()["objects"]
    return [entry["label"] for entry in entries if not entry["structure"]]


if __name__ == "__main__":
    typer.run(main)
