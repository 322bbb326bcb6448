"""Queueing model of c equal replicas behind a proxy: M/G/c with the Allen–Cunneen approximation.

Requests arrive at random times (Poisson). Each replica answers one request at a time, and the proxy
sends a request to the replica with the fewest requests. The model treats the replicas as servers of
one queue.

    W = C(c, a) / (c / s - rate) * (1 + v) / 2,   a = rate * s

W is the mean waiting time, s the mean service time, C the Erlang C formula, and v the squared
coefficient of variation of the service time (0 for a constant time, 1 for an exponential one).
Source: Allen, Probability, Statistics and Queueing Theory, 1990, section 5.3.
"""

from __future__ import annotations

import math


def erlang_c(servers: int, load: float) -> float:
    """Return the probability that a request waits.

    Args:
        servers: number of servers c.
        load: offered load a = rate * service time, below c.

    Raises:
        ValueError: the load is not between 0 and the number of servers.
    """
    if not 0 <= load < servers:
        raise ValueError(f"the load {load:g} must be at least 0 and below {servers} servers")
    # The recursion of Erlang B, which cannot overflow for many servers.
    blocked = 1.0
    for number in range(1, servers + 1):
        blocked = load * blocked / (number + load * blocked)
    return blocked / (1 - load / servers * (1 - blocked))


def mean_wait(rate: float, service_time: float, servers: int, variation: float = 0.0) -> float:
    """Return the mean waiting time of a request in seconds.

    Args:
        rate: arrivals per second.
        service_time: mean service time in seconds.
        servers: number of replicas.
        variation: squared coefficient of variation of the service time.

    Raises:
        ValueError: the replicas cannot answer this rate.
    """
    waits = erlang_c(servers, rate * service_time)
    return waits / (servers / service_time - rate) * (1 + variation) / 2


def replicas_for(
    rate: float, service_time: float, wait: float, share: float = 1.0, variation: float = 0.0
) -> int:
    """Return the smallest number of replicas with a mean waiting time of at most `wait`.

    Args:
        rate, service_time, variation: see `mean_wait`.
        wait: maximum mean waiting time in seconds.
        share: maximum utilisation of a replica, above 0 and at most 1.
    """
    replicas = max(1, math.ceil(rate * service_time / share))
    while (
        rate * service_time >= replicas or mean_wait(rate, service_time, replicas, variation) > wait
    ):
        replicas += 1
    return replicas
