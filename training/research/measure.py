"""Measure models on every data source, and reuse finished reports on disk.

An entry is one model of an experiment: a machine, a baseline or a reference.

<folder>/<name>/seed-<n>/row.json         settings, training scenes (as digest), number of weights
                        trials.jsonl      all settings that the tuning of a baseline tried
                        run/              training run of a machine, and its calibration
                        <source>.json     report on one data source
                        pooled.json       report on all data sources together (tasks of `WHOLE_SET`)

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any, TypeAlias

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from training.datasets import DatasetError
from training.datasets.batches import TrainingData
from training.evaluation.model import Model
from training.evaluation.report import SourceReport, digest, measure, pooled, write_whole
from training.evaluation.results import Reports
from training.evaluation.setting import Setting
from training.evaluation.tasks import ONCE, WHOLE_SET
from training.fit.checkpoint import RunError
from training.fit.configuration import ConfigError
from training.research.entries import Entry

# A progress function receives the row, the source, and a note on the current step.
Progress: TypeAlias = Callable[[str, str, str], None]

# Seconds between two checks for messages of the processes.
_TICK = 0.2
# Linear algebra libraries read these variables when a process loads them.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

# The last note on a row and source tells whether the report was measured now or read from a file.
DONE, KNOWN = "done", "known"

POOLED = "pooled"
"""Name of the union of all data sources."""


class BenchmarkError(RuntimeError):
    """A folder or report belongs to another experiment. The message names the folder or file."""


@contextmanager
def resumable(console: Console, *others: type[Exception]) -> Iterator[None]:
    """Print expected errors, and those of the types `others`; after Ctrl-C, how to continue."""
    ours = (ConfigError, DatasetError, BenchmarkError, RunError, BrokenProcessPool)
    expected: tuple[type[Exception], ...] = (*ours, *others)
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
        row = {"name": entry.name, "seed": entry.seed, "identity": entry.identity}
        row["material"] = self.data.digest
        if not path.exists():
            write_whole(path, json.dumps(row))
        stored, reason = _read_row(path), ""
        if stored["identity"] != entry.identity:
            reason = f"{path.parent} holds reports of another configuration of {entry.name}"
        elif stored.get("material") != self.data.digest:
            reason = (
                f"the reports in {path.parent} belong to other training scenes, or do not record "
                "their scenes (files, sources, limit, split and vocabulary must be equal)"
            )
        if reason:
            raise BenchmarkError(f"{reason}: use --fresh or another folder")

    def parameters(self, entries: Sequence[Entry]) -> dict[str, int]:
        """Return the number of trained weights by name, for entries that record this number."""
        rows = [_read_row(self.folder_of(entry) / "row.json") for entry in entries]
        return {row["name"]: row["parameters"] for row in rows if row.get("parameters") is not None}

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
                try:
                    report = SourceReport.read(path, setting)
                except ValueError as error:
                    raise BenchmarkError(str(error)) from error
                if set(self.tasks_on(source)) <= set(report.outcomes):
                    reports[source] = report
        return reports

    def measure(self, entry: Entry, progress: Progress) -> None:
        """Measure an entry on every data source that lacks a finished report.

        The model is trained only if a report is missing.
        """
        reports, folder = self.finished(entry), self.folder_of(entry)
        model: Model | None = None
        for source, setting in self.settings.items():
            if source in reports:
                progress(entry.name, source, KNOWN)
                continue
            say = partial(progress, entry.name, source)
            if model is None:
                say("training")
                model = entry.make(self.data, folder, say)
                if model.parameters is not None:
                    row = _read_row(folder / "row.json") | {"parameters": model.parameters}
                    write_whole(folder / "row.json", json.dumps(row))
            path = folder / f"{source}.json"
            measure(model, setting, source, tasks=self.tasks_on(source), path=path, progress=say)
            say(DONE)

    def report(self, entry: Entry) -> dict[str, SourceReport]:
        """Return the reports of an entry, by data source. The pooled report has all tasks."""
        reports = self.finished(entry)
        if POOLED in self.settings:
            merged = pooled([reports[name] for name in self.settings if name != POOLED], POOLED)
            merged.outcomes |= reports[POOLED].outcomes
            reports[POOLED] = merged
        return {source: reports[source] for source in self.settings}


def measure_entries(
    plan: Plan,
    entries: Sequence[Entry],
    progress: Progress,
    *,
    workers: int = 1,
    fresh: bool = False,
    failures: tuple[type[Exception], ...] = (),
) -> tuple[Reports, dict[str, str]]:
    """Measure all entries, and skip finished reports. KeyboardInterrupt stops the processes.

    Args:
        workers: number of processes with one thread each. 1 measures in this process.
        fresh: delete earlier reports of these entries.
        failures: exception types that end only the entry in which they occur.

    Returns:
        The reports by (name, seed), and the error messages of failed entries by name.
    """
    if fresh:
        for entry in entries:
            shutil.rmtree(plan.folder_of(entry), ignore_errors=True)
    missing = [entry for entry in entries if len(plan.finished(entry)) < len(plan.settings)]
    for entry in entries:
        if entry not in missing:
            plan.measure(entry, progress)
    if missing and workers > 1:
        failed = _in_processes(plan, failures, missing, progress, min(workers, len(missing)))
    else:
        failed = [_measure(plan, failures, entry, progress) for entry in missing]
    reasons = {
        entry.name: f"seed {entry.seed}: {error}"
        for entry, error in zip(missing, failed, strict=True)
        if error
    }
    measured = [entry for entry in entries if entry.name not in reasons]
    return {(entry.name, entry.seed): plan.report(entry) for entry in measured}, reasons


def _measure(
    plan: Plan, failures: tuple[type[Exception], ...], entry: Entry, progress: Progress
) -> Exception | None:
    """Measure an entry; return its error if it failed."""
    try:
        plan.measure(entry, progress)
    except failures as error:
        return error
    return None


def _in_processes(
    plan: Plan,
    failures: tuple[type[Exception], ...],
    entries: Sequence[Entry],
    progress: Progress,
    workers: int,
) -> list[Exception | None]:
    """Measure entries in processes; return the error of each entry that failed, else None."""
    context = multiprocessing.get_context("spawn")
    # SimpleQueue has no sending thread, so the queue has all messages of a finished entry.
    messages: SimpleQueue[tuple[str, str, str]] = context.SimpleQueue()
    # Pickling avoids the shared memory of torch, which is small in containers.
    begin = (pickle.dumps(partial(_measure, plan, failures)), messages)
    with _one_thread(), ProcessPoolExecutor(workers, context, _start_worker, begin) as pool:
        try:
            futures = [pool.submit(_measure_here, entry) for entry in entries]
            while True:
                done, waiting = wait(futures, _TICK, FIRST_EXCEPTION)
                while not messages.empty():
                    progress(*messages.get())
                for future in done:
                    future.result()  # raises an unexpected error at once
                if not waiting:
                    return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that start here use one thread each."""
    earlier = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_work: Callable[[Entry, Progress], Exception | None]
_progress: Progress


def _start_worker(material: bytes, messages: SimpleQueue[tuple[str, str, str]]) -> None:
    global _work, _progress  # set once in each process
    torch.set_num_threads(1)
    # Ctrl-C reaches every process of the terminal; only the main process handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The main process wrote these bytes and passed them on in memory.
    _work = pickle.loads(material)  # noqa: S301  # nosec B301
    _progress = lambda *message: messages.put(message)  # noqa: E731


def _measure_here(entry: Entry) -> Exception | None:
    return _work(entry, _progress)


@contextmanager
def shown(console: Console, title: str, total: int) -> Iterator[Progress]:
    """Show a progress bar for finished pairs (row, data source). `total` is the number of pairs."""
    columns = (
        "[progress.description]{task.description}",
        BarColumn(),
        "{task.completed}/{task.total}",
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Bar(*columns, console=console) as bar:
        task = bar.add_task(title, total=total, note="")

        def show(row: str, source: str, note: str) -> None:
            bar.update(task, note=f"{row}, {source}: {note}")
            if note in (DONE, KNOWN):
                bar.advance(task)

        yield show


def _read_row(path: Path) -> dict[str, Any]:
    row: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return row


def slug(name: str) -> str:
    """Convert a name to a folder name: lower-case words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
