"""``python -m benchmarks.replicas``: latency of one and two replicas beside the queueing model.

Requests arrive at random times at a share of the measured capacity, through HAProxy. The model of
`benchmarks.queueing` adds the waiting time to the latency at one connection. Each round repeats all
measurements, because the speed of a machine changes. All processes share the cores of this machine,
so the capacity contains the cost of the client.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer
import uvloop

from benchmarks.load.questions import labels_of, requests
from benchmarks.load.servers import free_port, running
from benchmarks.load.windows import Window, at_concurrency, at_times
from benchmarks.queueing import mean_wait

SHARES = (0.3, 0.5, 0.7)
"""Offered rates as fractions of the capacity."""

_ROUTE, _KIND, _MANY = "/missing", "12 labels", 32
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
    seconds: Annotated[float, typer.Option(min=0.1, help="length of one window")] = 3,
    rounds: Annotated[int, typer.Option(min=1, help="number of rounds")] = 5,
    replicas: Annotated[list[int] | None, typer.Option(help="numbers of replicas")] = None,
) -> None:
    """Measure latency at random arrivals, and compare it with the queueing model."""
    print("median (lowest–highest) of the rounds; latency in ms")
    print("replicas  share  requests/s  mean  model  mean / model      p99  other status")
    for count in replicas or (1, 2):
        with plain_processes(count) as port:
            bodies = requests(_KIND, _ROUTE, labels_of(port))
            uvloop.run(at_concurrency(port, bodies, _MANY, 2))
            points = [_round(port, bodies, count, seconds, number) for number in range(rounds)]
        for share, same in zip(SHARES, zip(*points, strict=True), strict=True):
            print(_line(count, share, same))


@dataclass(frozen=True)
class Point:
    """A measured window and the mean latency in seconds that the model predicts."""

    rate: float
    window: Window
    predicted: float

    @property
    def mean(self) -> float:
        """Measured mean latency in seconds."""
        return float(self.window.latency.mean())


def _round(
    port: int, bodies: Sequence[bytes], count: int, seconds: float, seed: int
) -> list[Point]:
    points = []
    for share in SHARES:
        alone = uvloop.run(at_concurrency(port, bodies, 1, seconds / 3)).latency
        capacity = uvloop.run(at_concurrency(port, bodies, _MANY, seconds / 3)).rate
        rate = share * capacity
        window = uvloop.run(at_times(port, bodies, _arrivals(rate, seconds, seed), 256))
        wait = mean_wait(rate, count / capacity, count)
        points.append(Point(rate, window, float(alone.mean()) + wait))
    return points


def _arrivals(
    rate: float, seconds: float, seed: int
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the times of a Poisson process."""
    pauses = np.random.default_rng(seed).exponential(1 / rate, round(rate * seconds))
    return np.cumsum(pauses)


def _line(count: int, share: float, points: Sequence[Point]) -> str:
    ratios = [point.mean / point.predicted for point in points]
    rate = median(point.rate for point in points)
    mean, model, p99 = (
        1e3 * median(values)
        for values in (
            [point.mean for point in points],
            [point.predicted for point in points],
            [point.window.quantile(0.99) for point in points],
        )
    )
    return (
        f"{count:8}  {share:5.1f}  {rate:10.0f}  {mean:4.1f}  {model:5.1f}  "
        f"{median(ratios):4.2f} ({min(ratios):.2f}–{max(ratios):.2f})  {p99:5.1f}  "
        f"{sum(point.window.errors for point in points)}"
    )


@contextmanager
def plain_processes(replicas: int) -> Iterator[int]:
    """Start plain processes behind HAProxy, and yield the proxy's port."""
    with ExitStack() as stack:
        text = _PROXY.format(port=(port := free_port()))
        for number in range(replicas):
            service = free_port()
            environment = {"SCENE_PORT": str(service)}
            stack.enter_context(running([sys.executable, "-m", "app"], service, environment))
            text += f"    server replica{number} 127.0.0.1:{service} check\n"
        config = Path(stack.enter_context(TemporaryDirectory())) / "haproxy.cfg"
        config.write_text(text, "utf-8")
        stack.enter_context(running(["haproxy", "-db", "-f", str(config)], port, {}))
        yield port


if __name__ == "__main__":
    typer.run(main)
