"""Interleaved timing: what is compared is measured in turns, so that it sees the same machine.

A shared machine slows down and speeds up within seconds. Contenders take turns in short slices, the
first of a round changing from round to round, and a ratio is taken within each round; its median
over the rounds is the result.
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
    """How many times faster: median over rounds, and the first and third quartile."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Timings:
    """Seconds of one call by contender, one number a round."""

    seconds: Mapping[str, list[float]]

    def median(self, name: str) -> float:
        return median(self.seconds[name])

    def ratio(self, name: str, yardstick: str) -> Ratio:
        """How many times faster `name` is than `yardstick`."""
        pairs = zip(self.seconds[yardstick], self.seconds[name], strict=True)
        ratios = [other / own for other, own in pairs]
        if len(ratios) == 1:
            return Ratio(ratios[0], ratios[0], ratios[0])
        low, middle, high = quantiles(ratios, n=4, method="inclusive")
        return Ratio(middle, low, high)


def interleave(
    contenders: Mapping[str, Callable[[], object]],
    *,
    rounds: int,
    slice_seconds: float = 0.02,
) -> Timings:
    """Time every contender in every round, on one thread and without garbage collection.

    Args:
        rounds: at least 1.
        slice_seconds: a contender is called again until its turn has taken about so long.
    """
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1, not {rounds}")
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
    contender()  # the first call pays for allocations and caches
    return max(1, round(slice_seconds / _seconds(contender, 1)))


def _seconds(contender: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        contender()
    return (time.perf_counter() - start) / calls
