"""``python -m benchmarks.load``: load test of the service, compared with a minimal FastAPI app.

The minimal ("plain") app validates the same requests and returns prepared answers (plain.py).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import httpx
import typer
import uvloop
from rich.console import Console
from rich.table import Table

from benchmarks.load import servers
from benchmarks.load.measure import Comparison, compare, concurrency, rate
from benchmarks.load.questions import KINDS, ROUTES, drawings, labels_of, requests
from benchmarks.load.windows import at_concurrency
from benchmarks.report import describe_machine

_MANY = 32
_DRAWN = 8
_QUANTILES = (0.5, 0.9, 0.99, 0.999)
# Requests per second at fixed rate, as a fraction of the service's throughput at 32 connections.
# The service is therefore not saturated.
_SHARE = 0.5


AIMS = {
    ("12 labels", "/relations"): 0.30,
    ("12 labels", "/outliers"): 0.30,
    ("12 labels", "/missing"): 0.18,
}
"""Target throughput by kind of request and route, as a fraction of the plain app's throughput.

Both are measured with 32 connections.
"""


def main(
    store: Annotated[Path, typer.Option(help="the model store to serve")] = Path("model_store"),
    seconds: Annotated[float, typer.Option(min=0.1, help="seconds per measurement")] = 1.5,
    kind: Annotated[list[str] | None, typer.Option(help="only these kinds of request")] = None,
) -> None:
    """Send the same requests to the service and to a plain FastAPI app, and compare their speed.

    The measurements are repeated until the rate and the latency of both are steady.
    """
    console = Console(width=140)
    for key, value in describe_machine().items():
        console.print(f"{key}: {value}", highlight=False)
    comparisons: list[Comparison] = []
    facts: dict[str, float] = {}
    with ExitStack() as stack:
        own = os.sched_getaffinity(0)
        stack.callback(os.sched_setaffinity, 0, own)
        service = stack.enter_context(servers.service(store))
        plain = stack.enter_context(servers.plain())
        os.sched_setaffinity(0, servers.cores()[1])
        facts["start to ready, s"] = service.seconds
        labels = labels_of(service.port)
        for comparison in _all(service.port, plain.port, kind or KINDS, labels, seconds):
            comparisons.append(comparison)
            console.print(_line(comparison), highlight=False)
        window = uvloop.run(at_concurrency(service.port, drawings(labels, _DRAWN), 1, 4 * seconds))
        facts[f"/generate of {_DRAWN} scenes, p99 at one connection, ms"] = 1e3 * window.quantile(
            0.99
        )
        facts["resident memory, MB"] = service.memory / 1e6
    console.print(_table(comparisons))
    for name, value in facts.items():
        console.print(f"{name}: {value:.3g}", highlight=False)


def _all(
    service: int, plain: int, kinds: Sequence[str], labels: Sequence[str], seconds: float
) -> Iterator[Comparison]:
    ports = (service, plain)
    for kind in kinds:
        for route in ROUTES:
            bodies = requests(kind, route, labels)
            _prepare_answer(ports, route, bodies[0])
            many = compare(
                ports,
                bodies,
                concurrency(_MANY),
                (kind, route, f"{_MANY} connections"),
                seconds=seconds,
            )
            yield many
            yield compare(
                ports, bodies, concurrency(1), (kind, route, "1 connection"), seconds=seconds
            )
            due = round(_SHARE * many.service.rate, -2) or _SHARE * many.service.rate
            yield compare(
                ports, bodies, rate(due), (kind, route, f"{due:.0f} a second"), seconds=seconds
            )


def _prepare_answer(ports: tuple[int, int], route: str, request: bytes) -> None:
    """Send one request to the service, and store the answer in the plain app for this route."""
    service, plain = ports
    _, _, body = request.partition(b"\r\n\r\n")
    headers = {"Content-Type": "application/json"}
    url = f"http://127.0.0.1:{service}{route}"
    answer = httpx.post(url, content=body, headers=headers).raise_for_status().content
    httpx.put(f"http://127.0.0.1:{plain}/answers{route}", content=answer).raise_for_status()


def _line(c: Comparison) -> str:
    steady = "" if c.steady else "  (not steady)"
    return f"{c.kind}, {c.route}, {c.load}: {c.rate_ratio:.2f} of the plain app's rate{steady}"


def _table(comparisons: Sequence[Comparison]) -> Table:
    table = Table(
        title="The service compared with a plain FastAPI app (service / plain app; milliseconds)"
    )
    for column in ("request", "load", "req/s", "ratio", "p50", "p90", "p99", "p99.9", "errors"):
        table.add_column(column, justify="left" if column in ("request", "load") else "right")
    table.add_column("aim")
    for c in comparisons:
        latencies = [
            f"{c.service.quantile(q) * 1e3:.2f} / {c.plain.quantile(q) * 1e3:.2f}"
            for q in _QUANTILES
        ]
        table.add_row(
            f"{c.route}, {c.kind}",
            c.load,
            f"{c.service.rate:,.0f} / {c.plain.rate:,.0f}",
            f"{c.rate_ratio:.2f}",
            *latencies,
            f"{c.service.errors} / {c.plain.errors}",
            _verdict(c),
        )
    return table


def _verdict(c: Comparison) -> str:
    aim = AIMS.get((c.kind, c.route))
    if aim is None or c.load != f"{_MANY} connections":
        return ""
    return f"{'met' if c.rate_ratio >= aim else 'MISSED'}: ≥ {aim} of the rate"


if __name__ == "__main__":
    typer.run(main)
