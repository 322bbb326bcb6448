"""Compare the service with a plain FastAPI app in alternating windows until both are steady."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, TypeAlias

import uvloop

from benchmarks.load.windows import Window, at_concurrency, at_rate, joined

Load: TypeAlias = Callable[[int, Sequence[bytes], float], Coroutine[Any, Any, Window]]
"""Function of (port, requests, seconds) that returns a window."""

_STEADY = 0.1
_FEWEST, _MOST = 3, 10


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results of the same requests to the service and to the plain app.

    Attributes:
        kind, route, load: kind of request, route and load.
        service, plain: all windows of each, joined.
        ratios: ratio of the rates, one per pair of windows.
        steady: True if the last three windows of both were within 10 % of their mean.
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
        """Median over windows of the service's rate divided by the plain app's rate."""
        return median(self.ratios)

    @property
    def p99_ratio(self) -> float:
        """p99 of the service divided by p99 of the plain app."""
        return self.service.quantile(0.99) / self.plain.quantile(0.99)

    @property
    def extra_p50(self) -> float:
        """p50 of the service minus p50 of the plain app, in seconds."""
        return self.service.quantile(0.5) - self.plain.quantile(0.5)


def concurrency(connections: int) -> Load:
    """Return a load of this number of connections, each without pauses."""

    async def load(port: int, requests: Sequence[bytes], seconds: float) -> Window:
        return await at_concurrency(port, requests, connections, seconds)

    return load


def rate(a_second: float) -> Load:
    """Return a load of this number of requests per second, independent of the answers."""

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
    """Alternate windows until both are steady, at most ten times.

    Args:
        ports: port of the service and port of the plain app.
        names: kind, route and load.
        seconds: length of one window.
    """
    found: tuple[list[Window], list[Window]] = ([], [])
    for port in ports:
        uvloop.run(load(port, requests, seconds / 3))
    steady = False
    while not steady and len(found[0]) < _MOST:
        for port, windows in zip(ports, found, strict=True):
            windows.append(uvloop.run(load(port, requests, seconds)))
        steady = len(found[0]) >= _FEWEST and all(map(is_steady, found))
    service, plain = (joined(windows) for windows in found)
    pairs = zip(*found, strict=True)
    ratios = tuple(ours.rate / theirs.rate for ours, theirs in pairs)
    return Comparison(*names, service, plain, ratios, steady)


def is_steady(windows: Sequence[Window]) -> bool:
    """Return True if rate and p50 of the last three windows are within 10 % of their mean."""
    last = windows[-_FEWEST:]
    for values in ([w.rate for w in last], [w.quantile(0.5) for w in last]):
        mean = sum(values) / len(values)
        if max(abs(value - mean) for value in values) > _STEADY * mean:
            return False
    return True
