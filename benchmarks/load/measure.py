"""Compare the service with a plain FastAPI app.

A window is a period of load on one of the two. Windows alternate until both are steady.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, TypeAlias

import uvloop

from benchmarks.load.windows import Window, at_concurrency, at_rate, joined

Load: TypeAlias = Callable[[int, Sequence[bytes], float], Coroutine[Any, Any, Window]]
"""Function that sends requests to a port for some seconds and returns the measured window."""

_STEADY = 0.1
_FEWEST, _MOST = 3, 10


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results of the same requests to the service and to the plain app.

    Attributes:
        kind: kind of request, for example "12 labels".
        route: path of the requests.
        load: description of the load, for example "32 connections".
        service: all windows of the service, joined into one window.
        plain: all windows of the plain app, joined into one window.
        ratios: rate of the service divided by the rate of the plain app, for each pair of windows.
        steady: True if the service and the plain app were steady at the end, see `is_steady`.
    """

    kind: str
    route: str
    load: str
    service: Window
    plain: Window
    ratios: tuple[float, ...]
    steady: bool

    @property
    def rate_ratio(self) -> float:
        """Rate of the service divided by the rate of the plain app, as median over windows."""
        return median(self.ratios)


def concurrency(connections: int) -> Load:
    """Return a load function with this number of connections, which send without pauses."""

    async def load(port: int, requests: Sequence[bytes], seconds: float) -> Window:
        return await at_concurrency(port, requests, connections, seconds)

    return load


def rate(a_second: float) -> Load:
    """Return a load function that sends requests at a fixed rate, without waiting for answers."""

    async def load(port: int, requests: Sequence[bytes], seconds: float) -> Window:
        return await at_rate(port, requests, a_second, seconds)

    return load


def compare(
    ports: tuple[int, int],
    requests: Sequence[bytes],
    load: Load,
    names: tuple[str, str, str],
    *,
    seconds: float,
) -> Comparison:
    """Load the service and the plain app alternately until both are steady, at most ten times each.

    Args:
        ports: port of the service and port of the plain app.
        requests: requests as bytes, sent in turn.
        load: function that runs one window of load.
        names: kind of request, route, and description of the load.
        seconds: length of one window.
    """
    series: tuple[list[Window], list[Window]] = ([], [])
    for port in ports:
        uvloop.run(load(port, requests, seconds / 3))
    steady = False
    while not steady and len(series[0]) < _MOST:
        for port, windows in zip(ports, series, strict=True):
            windows.append(uvloop.run(load(port, requests, seconds)))
        steady = len(series[0]) >= _FEWEST and all(map(is_steady, series))
    service, plain = (joined(windows) for windows in series)
    pairs = zip(*series, strict=True)
    ratios = tuple(ours.rate / theirs.rate for ours, theirs in pairs)
    return Comparison(*names, service, plain, ratios, steady)


def is_steady(windows: Sequence[Window]) -> bool:
    """Return True if the rate and the median latency vary little over the last three windows.

    Each value must be within 10 % of the mean of the three windows.
    """
    last = windows[-_FEWEST:]
    for values in ([w.rate for w in last], [w.quantile(0.5) for w in last]):
        mean = sum(values) / len(values)
        if max(abs(value - mean) for value in values) > _STEADY * mean:
            return False
    return True
