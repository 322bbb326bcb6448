"""The queueing model, against closed forms and a simulation."""

from __future__ import annotations

import heapq

import numpy as np
import pytest

from benchmarks.queueing import erlang_c, mean_wait, replicas_for


def test_one_and_two_servers_are_the_textbook_formulas() -> None:
    for load in (0.1, 0.5, 0.9):
        assert erlang_c(1, load) == pytest.approx(load)
        assert mean_wait(load, 1.0, 1) == pytest.approx(load / (1 - load))
    assert erlang_c(2, 1.0) == pytest.approx(1 / 3)
    assert erlang_c(2, 1.5) == pytest.approx(9 / 14)


@pytest.mark.parametrize(("servers", "share"), [(2, 0.7), (8, 0.8)])
def test_a_simulation_waits_as_long(servers: int, share: float) -> None:
    """400,000 requests of exponential service time."""
    generator = np.random.default_rng(1)
    arrivals = np.cumsum(generator.exponential(1 / (servers * share), 400_000))
    free = [0.0] * servers
    waited = 0.0
    services = generator.exponential(1.0, 400_000)
    for arrival, service in zip(arrivals.tolist(), services.tolist(), strict=True):
        start = max(arrival, heapq.heappop(free))
        waited += start - arrival
        heapq.heappush(free, start + service)
    predicted = mean_wait(servers * share, 1.0, servers)
    assert waited / len(arrivals) == pytest.approx(predicted, rel=0.05)


def test_many_servers_are_sized() -> None:
    replicas = replicas_for(100_000, 1e-3, 1e-3, share=0.8)
    assert replicas == 125
    assert mean_wait(100_000, 1e-3, replicas) < 1e-6
    assert replicas_for(900, 1e-3, 3e-4) == 2
    with pytest.raises(ValueError, match="servers"):
        erlang_c(2, 2.0)
