"""``python -m benchmarks.queueing RATE``: number of replicas for a rate of requests.

The queueing model is M/M/c: c equal replicas behind a proxy.

Requests arrive at random times (Poisson), and the proxy sends a request to the replica with the
fewest requests. The model treats the replicas as servers of one queue.

    W = C(c, a) / (c / s - rate),   a = rate * s

W is the mean waiting time, s the mean service time and C the Erlang C formula. A replica works on
its requests alternately (processor sharing). Then, for one replica, W holds for every distribution
of the service time. Source: Kleinrock, Queueing Systems, volume 2, 1976, section 4.4. If replicas
answered one request after another in a constant time, W would be about half as long.
"""

from __future__ import annotations

import math
from typing import Annotated

import typer


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


def mean_wait(rate: float, service_time: float, servers: int) -> float:
    """Return the mean waiting time of a request in seconds.

    Args:
        rate: arrivals per second.
        service_time: mean service time in seconds.
        servers: number of replicas.

    Raises:
        ValueError: the replicas cannot answer this rate.
    """
    waits = erlang_c(servers, rate * service_time)
    return waits / (servers / service_time - rate)


def replicas_for(rate: float, service_time: float, wait: float, share: float = 1.0) -> int:
    """Return the smallest number of replicas with a mean waiting time of at most `wait`.

    Args:
        rate, service_time: see `mean_wait`.
        wait: maximum mean waiting time in seconds.
        share: maximum utilisation of a replica, above 0 and at most 1.
    """
    replicas = max(1, math.ceil(rate * service_time / share))
    while rate * service_time >= replicas or mean_wait(rate, service_time, replicas) > wait:
        replicas += 1
    return replicas


def main(
    rate: Annotated[float, typer.Argument(help="requests per second of all robots")],
    capacity: Annotated[
        float, typer.Option(help="requests per second that one replica can answer")
    ] = 629,
    wait: Annotated[float, typer.Option(help="maximum mean waiting time in ms")] = 1,
    share: Annotated[float, typer.Option(max=1, help="maximum utilisation of a replica")] = 0.7,
) -> None:
    """Print the number of replicas that answer a rate of requests."""
    replicas = replicas_for(rate, 1 / capacity, wait / 1e3, share)
    used = rate / capacity / replicas
    waits = 1e3 * mean_wait(rate, 1 / capacity, replicas)
    print(f"{replicas} replicas, utilisation {used:.2f}, mean waiting time {waits:.2f} ms")


if __name__ == "__main__":
    typer.run(main)
