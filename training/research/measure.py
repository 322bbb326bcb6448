"""Measure models on every data source, and reuse finished reports on disk.

An entry is one model of an experiment: a machine, a baseline or a reference.

<folder>/<name>/seed-<n>-<digest>/run/                    training run of a machine
                                 <source>-<digest>.json   report on one data source
                                 pooled-<digest>.json     report on all data sources together (tasks
                                                          of `WHOLE_SET`)

The digests cover the settings and training scenes, and the questions. So another experiment has
other folders and files. One process with one thread measures each entry.
"""

from __future__ import annotations

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
from hashlib import sha256
from pathlib import Path

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from app.registry import RegistryError
from training.datasets import DatasetError
from training.datasets.batches import TrainingData
from training.evaluation.report import Progress, SourceReport, digest, measure, pooled, silent
from training.evaluation.results import Reports
from training.evaluation.setting import Setting
from training.evaluation.tasks import ONCE, WHOLE_SET
from training.fit.configuration import ConfigError
from training.research.entries import Entry
from training.runs.folder import RunError

# Linear algebra libraries read these variables when a process loads them.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

POOLED = "pooled"  # name of the union of all data sources


@contextmanager
def resumable(console: Console) -> Iterator[None]:
    """Print expected errors; after Ctrl-C, print how to continue."""
    expected = (
        ConfigError, DatasetError, RunError, RegistryError, BrokenProcessPool, ValueError,
        FloatingPointError,
    )  # fmt: skip
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
    """The questions of an experiment. All entries get the same questions."""

    folder: Path  # of the reports
    data: TrainingData
    settings: Mapping[str, Setting]  # by data source. The key `POOLED` is the union of all sources
    tasks: Sequence[str]  # keys of `EVERY_TASK`

    def folder_of(self, entry: Entry) -> Path:
        """Return the folder of an entry with its training seed and scenes."""
        name = f"seed-{entry.seed}-{_short_digest(entry.identity, self.data.digest)}"
        return self.folder / slug(entry.name) / name

    def path_of(self, entry: Entry, source: str) -> Path:
        """Return the file of a report."""
        questions = _short_digest(digest(self.settings[source]), *self.tasks_on(source))
        return self.folder_of(entry) / f"{source}-{questions}.json"

    def tasks_on(self, source: str) -> list[str]:
        """Return the names of the tasks to measure on a data source, or on `POOLED`."""
        if source == POOLED:
            return [task for task in self.tasks if task in WHOLE_SET]
        return [task for task in self.tasks if task not in ONCE]

    def finished(self, entry: Entry) -> dict[str, SourceReport]:
        """Return the finished reports of an entry, by data source."""
        paths = {source: self.path_of(entry, source) for source in self.settings}
        return {source: SourceReport.read(path) for source, path in paths.items() if path.exists()}

    def measure(self, entry: Entry, progress: Progress) -> None:
        """Train an entry, and measure it on every data source that lacks a finished report."""
        finished = self.finished(entry)
        model = entry.make(self.data, self.folder_of(entry), progress)
        for source, setting in self.settings.items():
            if source not in finished:
                tasks = self.tasks_on(source)
                report = measure(model, setting, source, tasks=tasks, progress=progress)
                report.write(self.path_of(entry, source))

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
    """Return the reports by (name, seed), and the error messages of diverged entries by name.

    Finished reports are read, unless `fresh` deletes them. `workers` processes with one thread each
    measure the rest; 1 means this process. KeyboardInterrupt stops the processes.
    """
    if fresh:
        for entry in entries:
            shutil.rmtree(plan.folder_of(entry), ignore_errors=True)
    missing = [entry for entry in entries if len(plan.finished(entry)) < len(plan.settings)]
    columns = BarColumn(), "{task.completed}/{task.total}", TimeElapsedColumn()
    failures = {}
    with Bar(*columns, TextColumn("{task.description}"), console=console) as bar:
        task = bar.add_task("training", total=len(entries), completed=len(entries) - len(missing))

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
    """Unpickle the plan in a new process, which uses one thread."""
    global _plan  # set once in each process
    torch.set_num_threads(1)
    # Ctrl-C reaches every process of the terminal; only the main process handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The main process wrote these bytes and passed them on in memory.
    _plan = pickle.loads(plan)  # noqa: S301  # nosec B301


def _measure_here(entry: Entry) -> str:
    return _measure(_plan, entry, silent)


def _short_digest(*parts: str) -> str:
    return sha256("\n".join(parts).encode()).hexdigest()[:8]


def slug(name: str) -> str:
    """Convert a name to a folder name: lower-case words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
