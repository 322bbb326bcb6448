"""Interleaved timing of several implementations, so that all run under the same conditions.

The speed of a shared computer varies within seconds. In each round, every implementation runs for a
short time slice. The order of the implementations rotates from round to round. The speed ratio is
computed within each round. The result is the median ratio over the rounds.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median, quantiles

import torch
from threadpoolctl import threadpool_limits


@dataclass(frozen=True)
class Ratio:
    """Speed ratio of two implementations over all rounds: median, first and third quartile."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Timings:
    """Seconds per call in each round, by name of the implementation."""

    seconds: Mapping[str, list[float]]

    def median(self, name: str) -> float:
        return median(self.seconds[name])

    def ratio(self, name: str, yardstick: str) -> Ratio:
        """Return the speed of `name` divided by the speed of `yardstick`."""
        pairs = zip(self.seconds[yardstick], self.seconds[name], strict=True)
        ratios = [other / own for other, own in pairs]
        if len(ratios) == 1:
            return Ratio(ratios[0], ratios[0], ratios[0])
        low, middle, high = quantiles(ratios, n=4, method="inclusive")
        return Ratio(middle, low, high)


def interleave(
    contenders: Mapping[str, Callable[[], object]], *, rounds: int, slice_seconds: float = 0.02
) -> Timings:
    """Time every implementation in every round, on one thread and without garbage collection.

    Args:
        contenders: the implementations by name, as functions without arguments.
        slice_seconds: approximate length of a time slice. Within a slice, one implementation is
            called repeatedly.
    """
    names = list(contenders)
    seconds: dict[str, list[float]] = {name: [] for name in names}
    threads = torch.get_num_threads()
    gc.collect()
    gc.disable()
    try:
        with threadpool_limits(1):
            torch.set_num_threads(1)
            calls = {name: _calls(contenders[name], slice_seconds) for name in names}
            for turn in range(rounds):
                first = turn % len(names)
                for name in names[first:] + names[:first]:
                    seconds[name].append(_seconds(contenders[name], calls[name]))
    finally:
        torch.set_num_threads(threads)
        gc.enable()
    return Timings(seconds)


def _calls(contender: Callable[[], object], slice_seconds: float) -> int:
    contender()  # warm up allocations and caches
    return max(1, round(slice_seconds / _seconds(contender, 1)))


def _seconds(contender: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        contender()
    return (time.perf_counter() - start) / calls
