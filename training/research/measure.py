"""Measure models on every data source, and reuse finished reports on disk.

An entry is one model of an experiment: a machine, a baseline or a reference.

<folder>/<name>/seed-<n>/row.json       settings and training scenes (as digest), number of weights
                        run/            training run of a machine, and its calibration
                        <source>.json   report on one data source
                        pooled.json     report on all data sources together (tasks of `WHOLE_SET`)

Several processes fill these files in parallel. One process with one thread measures each entry.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle  # nosec B403
import re
import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from training.datasets import DatasetError
from training.datasets.batches import TrainingData
from training.evaluation.report import (
    Progress,
    SourceReport,
    digest,
    measure,
    pooled,
    silent,
    write_whole,
)
from training.evaluation.results import Reports
from training.evaluation.setting import Setting
from training.evaluation.tasks import ONCE, WHOLE_SET
from training.fit.checkpoint import RunError
from training.fit.configuration import ConfigError
from training.research.entries import Entry

# Linear algebra libraries read these variables when a process loads them.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

POOLED = "pooled"
"""Name of the union of all data sources."""


class BenchmarkError(RuntimeError):
    """A folder or report belongs to another experiment. The message names the folder or file."""


@contextmanager
def resumable(console: Console) -> Iterator[None]:
    """Print expected errors; after Ctrl-C, print how to continue."""
    expected = (ConfigError, DatasetError, BenchmarkError, RunError, BrokenProcessPool, ValueError)
    try:
        yield
    except expected as error:
        console.print(f"[red]error:[/red] {error}")
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to continue")
        raise typer.Exit(130) from None


@dataclass(frozen=True, eq=False)
class Plan:
    """The questions of an experiment. All entries get the same questions.

    Attributes:
        folder: folder of the reports.
        settings: evaluation setting by data source. The key `POOLED` is the union of all sources.
        tasks: names of the tasks to measure, which are keys of `EVERY_TASK`.
    """

    folder: Path
    data: TrainingData
    settings: Mapping[str, Setting]
    tasks: Sequence[str]

    def folder_of(self, entry: Entry) -> Path:
        """Return the folder of an entry and its training seed."""
        return self.folder / slug(entry.name) / f"seed-{entry.seed}"

    def tasks_on(self, source: str) -> list[str]:
        """Return the names of the tasks to measure on a data source, or on `POOLED`."""
        if source == POOLED:
            return [task for task in self.tasks if task in WHOLE_SET]
        return [task for task in self.tasks if task not in ONCE]

    def claim(self, entry: Entry) -> None:
        """Reserve the folder of an entry. Another entry or other scenes are a BenchmarkError."""
        path = self.folder_of(entry) / "row.json"
        row = {"identity": entry.identity, "material": self.data.digest}
        if not path.exists():
            write_whole(path, json.dumps(row))
        if row.items() - _read_row(path).items():
            raise BenchmarkError(
                f"{path.parent} holds reports of another configuration of {entry.name}, or of "
                "other training scenes (files, sources, limit, split and vocabulary must be "
                "equal): use --fresh or another folder"
            )

    def parameters(self, entries: Sequence[Entry]) -> dict[str, int]:
        """Return the number of trained weights by name, for entries that record this number."""
        rows = {entry.name: _read_row(self.folder_of(entry) / "row.json") for entry in entries}
        return {name: row["parameters"] for name, row in rows.items() if row.get("parameters")}

    def finished(self, entry: Entry) -> dict[str, SourceReport]:
        """Return the finished reports of an entry, by data source.

        Raises:
            BenchmarkError: the folder belongs to other scenes or another entry.
        """
        self.claim(entry)
        reports = {}
        for source, setting in self.settings.items():
            path = self.folder_of(entry) / f"{source}.json"
            if not self.tasks_on(source):
                reports[source] = SourceReport(source, digest(setting))
            elif path.exists():
                report = SourceReport.read(path, setting)
                if set(self.tasks_on(source)) <= set(report.outcomes):
                    reports[source] = report
        return reports

    def measure(self, entry: Entry, progress: Progress) -> None:
        """Measure an entry on every data source that lacks a finished report.

        The model is trained only if a report is missing.
        """
        folder, finished = self.folder_of(entry), self.finished(entry)
        missing = [source for source in self.settings if source not in finished]
        if not missing:
            return
        model = entry.make(self.data, folder, progress)
        row = _read_row(folder / "row.json") | {"parameters": model.parameters}
        write_whole(folder / "row.json", json.dumps(row))
        for source in missing:
            tasks = self.tasks_on(source)
            report = measure(model, self.settings[source], source, tasks=tasks, progress=progress)
            report.write(folder / f"{source}.json")

    def report(self, entry: Entry) -> dict[str, SourceReport]:
        """Return the reports of an entry, by data source. The pooled report has all tasks."""
        reports = self.finished(entry)
        merged = pooled([reports[name] for name in self.settings if name != POOLED], POOLED)
        merged.outcomes |= reports[POOLED].outcomes
        reports[POOLED] = merged
        return {source: reports[source] for source in self.settings}


def measure_entries(
    plan: Plan, entries: Sequence[Entry], console: Console, *, workers: int = 1, fresh: bool = False
) -> tuple[Reports, dict[str, str]]:
    """Measure all entries, and skip finished reports. KeyboardInterrupt stops the processes.

    Args:
        workers: number of processes with one thread each. 1 measures in this process.
        fresh: delete earlier reports of these entries.

    Returns:
        The reports by (name, seed), and the error messages of diverged entries by name.
    """
    if fresh:
        for entry in entries:
            shutil.rmtree(plan.folder_of(entry), ignore_errors=True)
    missing = [entry for entry in entries if len(plan.finished(entry)) < len(plan.settings)]
    columns = BarColumn(), "{task.completed}/{task.total}", TimeElapsedColumn()
    failures = {}
    with Bar(*columns, TextColumn("{task.description}"), console=console) as bar:
        task = bar.add_task("", total=len(entries), completed=len(entries) - len(missing))

        def say(note: str) -> None:
            bar.update(task, description=note)

        if workers > 1:
            outcomes = _in_processes(plan, missing, workers)
        else:
            outcomes = ((entry, _measure(plan, entry, say)) for entry in missing)
        for entry, error in outcomes:
            bar.update(task, advance=1, description=entry.name)
            if error:
                failures[entry.name] = f"seed {entry.seed}: {error}"
    measured = [entry for entry in entries if entry.name not in failures]
    return {(entry.name, entry.seed): plan.report(entry) for entry in measured}, failures


def _measure(plan: Plan, entry: Entry, progress: Progress) -> str:
    """Measure an entry. If its training diverges, return the message of the error."""
    try:
        plan.measure(entry, lambda note: progress(f"{entry.name}, {note}"))
    except FloatingPointError as error:
        return str(error)
    return ""


def _in_processes(
    plan: Plan, entries: Sequence[Entry], workers: int
) -> Iterator[tuple[Entry, str]]:
    """Measure entries in processes, and yield them as they end, with the results of `_measure`."""
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    context = multiprocessing.get_context("spawn")
    # Pickling avoids the shared memory of torch, which is small in containers.
    with ProcessPoolExecutor(workers, context, _start_worker, (pickle.dumps(plan),)) as pool:
        try:
            futures = {pool.submit(_measure_here, entry): entry for entry in entries}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


_plan: Plan


def _start_worker(plan: bytes) -> None:
    global _plan  # set once in each process
    torch.set_num_threads(1)
    # Ctrl-C reaches every process of the terminal; only the main process handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The main process wrote these bytes and passed them on in memory.
    _plan = pickle.loads(plan)  # noqa: S301  # nosec B301


def _measure_here(entry: Entry) -> str:
    return _measure(_plan, entry, silent)


def _read_row(path: Path) -> dict[str, Any]:
    row: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return row


def slug(name: str) -> str:
    """Convert a name to a folder name: lower-case words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
