"""`python -m training benchmark`: everything on the same scenes, resumed where it stopped."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from training.benchmark.compare import (
    Options,
    compare_by_seed_protocol,
    compare_domain,
    compare_on_shuffled,
    require_groups,
)
from training.benchmark.domains import default_configs, read_domains
from training.benchmark.measure import DONE, KNOWN, BenchmarkError, Progress
from training.benchmark.sections import SEED_PROTOCOL, SHUFFLED, assemble
from training.checkpoints import CheckpointError
from training.config import ConfigError, data_folder
from training.datasets import DatasetError
from training.evaluation.tasks import TASKS

SEEDS = 3
WORKERS = 2

# Log Z by annealing takes a while however few the scenes are.
_SLOW_TASKS = ("Density",)

console = Console()


def benchmark(
    machines: Annotated[
        list[str] | None,
        typer.Argument(
            help="configurations; those of one data section are measured together, the first of "
            "them compared with all other rows. By default the indoor and the everyday machines."
        ),
    ] = None,
    data: Annotated[Path | None, typer.Option("--data", help="folder with the scene files")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="for reports and results")] = Path(
        "runs/benchmark"
    ),
    seeds: Annotated[int, typer.Option(min=1, help="training seeds, where they matter")] = SEEDS,
    baseline: Annotated[
        list[str] | None, typer.Option(help="only these baselines; none for no baseline")
    ] = None,
    task: Annotated[
        list[str] | None, typer.Option(help="only these tasks, by name or its beginning: T2, T3")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="scenes a source where a task is slow")] = 300,
    workers: Annotated[int, typer.Option(min=1, help="processes, of one thread each")] = WORKERS,
    seed_protocol: Annotated[
        bool, typer.Option("--seed-protocol", help="the seed paper's protocol as well")
    ] = False,
    shuffled: Annotated[
        bool, typer.Option("--shuffled", help="the same rows trained on shuffled scenes as well")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="a small run, to see it work")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="forget earlier reports")] = False,
) -> None:
    """Train every baseline and machine on the same groups and evaluate all on the same scenes.

    Writes results.json, results.md and plots into a folder for each domain; what was asked beside
    the tables has a folder and results of its own there. Ctrl-C loses at most the task at hand; the
    same command goes on from there.
    """
    try:
        options = Options(
            tasks=chosen_tasks(task, quick),
            seeds=seeds,
            baselines=None if baseline is None else tuple(b for b in baseline if b != "none"),
            limit=limit,
            workers=workers,
            quick=quick,
            fresh=fresh,
        )
        if shuffled:
            options.shuffled_tasks()  # a request that cannot be met fails before hours of training
        machines = machines or default_configs()
        domains = read_domains(machines)
        root = data_folder(machines[0], domains[0].configs[0], data)
        for domain in domains:
            if shuffled or not seed_protocol:
                require_groups(domain)
        for domain in domains:
            place = folder / domain.name
            with _Shown() as shown:
                # The seed protocol is all that may be asked of a random split.
                if not domain.leaks:
                    compare_domain(domain, root, place, options, shown.begin)
                    assemble(place, domain.name)
                if seed_protocol:
                    compare_by_seed_protocol(
                        domain, root, place / SEED_PROTOCOL, options, shown.begin
                    )
                    assemble(place, domain.name)
                if shuffled:
                    compare_on_shuffled(domain, root, place / SHUFFLED, options, shown.begin)
            text = assemble(place, domain.name)
            console.print(text, markup=False)
            console.print(f"every figure: {place / 'results.json'}; plots beside it")
    except (
        ConfigError, DatasetError, BenchmarkError, CheckpointError, BrokenProcessPool,
        ValueError, FloatingPointError,
    ) as error:  # fmt: skip
        console.print(f"[red]error:[/red] {error}")
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; the same command goes on from there")
        raise typer.Exit(130) from None


def chosen_tasks(wanted: Sequence[str] | None, quick: bool) -> tuple[str, ...]:
    """Names in `TASKS`: those wanted, by their names or how these begin; all by default.

    Raises:
        ValueError: a name that no task has or begins with.
    """
    if not wanted:
        return tuple(name for name in TASKS if not quick or name not in _SLOW_TASKS)
    found: set[str] = set()
    for part in wanted:
        # A task that is named in full is meant alone, though others may begin like it.
        named = {part} & set(TASKS) or {name for name in TASKS if name.startswith(part)}
        if not named:
            raise ValueError(f"unknown task {part!r}, must be of {list(TASKS)}")
        found |= named
    return tuple(name for name in TASKS if name in found)


class _Shown:
    """Progress bars, one for each thing that is measured."""

    def __init__(self) -> None:
        self._bar = Bar(
            "[progress.description]{task.description}",
            BarColumn(),
            "{task.completed}/{task.total}",
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}"),
            console=console,
        )

    def __enter__(self) -> _Shown:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, title: str, total: int) -> Progress:
        """A new bar; returns who hears of what is done."""
        bar = self._bar.add_task(title, total=total, note="")

        def show(row: str, source: str, note: str) -> None:
            self._bar.update(bar, note=f"{row}, {source}: {note}")
            if note in (DONE, KNOWN):
                self._bar.advance(bar)

        return show
