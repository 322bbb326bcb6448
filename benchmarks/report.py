"""Benchmark results as tables, and a description of the computer."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from rich.console import Group
from rich.table import Table
from rich.text import Text

from benchmarks.timing import Timings

Fact = str | int | float

_PACKAGES = ("torch", "numpy", "scikit-learn", "rbms", "fastapi", "uvicorn", "pydantic")


@dataclass(frozen=True)
class Result:
    """Result of one benchmark.

    Attributes:
        title: description of the measurement.
        subject: name of our implementation in `timings`.
        timings: timings of all implementations.
        work: amount of work of one call, for example the number of chains.
        unit: unit of `work` per second. None shows only times.
        targets: minimum of our speed divided by the speed of another implementation, by name of the
            other implementation.
        facts: further results, by name.
    """

    title: str
    subject: str
    timings: Timings
    work: int = 1
    unit: str | None = None
    targets: Mapping[str, float] = field(default_factory=dict)
    facts: Mapping[str, Fact] = field(default_factory=dict)

    def table(self) -> Group:
        """Return a table with one line per implementation.

        The ratio is our speed divided by the speed of the implementation, with quartiles.
        """
        table = Table(title=self.title, title_justify="left")
        table.add_column("")
        table.add_column("a call", justify="right")
        if self.unit:
            table.add_column(self.unit, justify="right")
        table.add_column("ratio (quartiles)", justify="right")
        table.add_column("aim", justify="right")
        for name in self.timings.seconds:
            seconds = self.timings.median(name)
            row = [name, duration(seconds)]
            if self.unit:
                row.append(f"{self.work / seconds:,.0f}")
            if name != self.subject:
                ratio = self.timings.ratio(self.subject, name)
                row.append(f"{ratio.median:.3g}× ({ratio.low:.3g}–{ratio.high:.3g})")
                row.append(f"≥ {self.targets[name]:g}×" if name in self.targets else "")
            table.add_row(*row)
        facts = [Text(f"  {name}: {_show(value)}") for name, value in self.facts.items()]
        return Group(table, *facts)


def duration(seconds: float) -> str:
    """Format seconds with a suitable unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def describe_machine() -> dict[str, object]:
    """Describe this computer, its current load, and the installed packages."""
    load = os.getloadavg() if hasattr(os, "getloadavg") else ()
    return {
        "taken": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": [round(value, 2) for value in load],
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{package: version(package) for package in _PACKAGES},
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.is_file() else ""
    model = re.search(r"^model name\s*: (.+)$", text, re.M)
    return model[1].strip() if model else platform.processor() or "unknown"


def _show(value: Fact) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else value
