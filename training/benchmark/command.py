"""`python -m training benchmark`: everything on the same scenes, resumed where it stopped."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from training.batches import SceneTensors, seen_triples
from training.benchmark.entries import Entry, baseline_entries, machine_entry
from training.benchmark.measure import BenchmarkError, forget, measure_entries
from training.benchmark.summary import Results, summarise
from training.config import Config, ConfigError, DataConfig, load_config
from training.datasets import DatasetError
from training.evaluation.report import settings_by_source
from training.evaluation.tasks import TASKS, Setting
from training.pipeline import prepare
from training.trainer import TrainingData

POOLED = "pooled"
SEEDS = 3

# What --quick does instead: it shows that everything runs, its figures mean nothing.
_QUICK_SCENES = 150
_QUICK_EPOCHS = 2
_QUICK_LIMIT = 30
_QUICK_BASELINES = ("popularity", "EASE", "frequency table", "frequency table, completing")
_SLOW_TASKS = ("Density",)

console = Console()


def benchmark(
    machines: Annotated[
        list[str] | None,
        typer.Argument(help="configurations; the first is compared with all other rows"),
    ] = None,
    data: Annotated[Path, typer.Option("--data", help="folder with the scene files")] = Path(
        "../shared/data"
    ),
    folder: Annotated[Path, typer.Option("--folder", help="for reports and results")] = Path(
        "runs/benchmark"
    ),
    seeds: Annotated[int, typer.Option(min=1, help="training seeds of every row")] = SEEDS,
    baseline: Annotated[
        list[str] | None, typer.Option(help="only these baselines; none for no baseline")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="scenes a source where a task is slow")] = 600,
    quick: Annotated[bool, typer.Option("--quick", help="a small run, to see it work")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="forget earlier reports")] = False,
) -> None:
    """Train every baseline and machine on the same groups and evaluate all on the same scenes.

    Writes results.json and results.md into the folder. Ctrl-C loses at most the task at hand; the
    same command goes on from there.
    """
    tasks = [task for task in TASKS if not quick or task not in _SLOW_TASKS]
    try:
        configs = [load_config(name) for name in machines or ["indoor-triway"]]
        shared = _shared_data(configs, quick)
        with console.status("reading and encoding scenes"):
            scenes = prepare(configs[0].model_copy(update={"data": shared}), data).training_data()
        names = baseline if baseline is not None else (_QUICK_BASELINES if quick else None)
        entries = _entries(configs, scenes, 1 if quick else seeds, names, quick)
        if fresh:
            forget(folder, entries)
        settings = _settings(scenes, _QUICK_LIMIT if quick else limit)
        results = _run(folder, entries, settings, tasks, configs[0].name)
    except (ConfigError, DatasetError, BenchmarkError, ValueError, FloatingPointError) as error:
        console.print(f"[red]error:[/red] {error}")
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; the same command goes on from there")
        raise typer.Exit(130) from None
    (folder / "results.json").write_text(json.dumps(results.to_dict(), indent=1), encoding="utf-8")
    (folder / "results.md").write_text(results.markdown(), encoding="utf-8")
    console.print(results.markdown(), markup=False)
    console.print(f"every figure: {folder / 'results.json'}")


def _shared_data(configs: Sequence[Config], quick: bool) -> DataConfig:
    """The scenes that all machines learn from.

    Raises:
        ConfigError: two configurations want different ones.
    """
    first = configs[0]
    for config in configs[1:]:
        if config.data != first.data:
            raise ConfigError(
                f"{config.name} and {first.name} have different data sections: a benchmark "
                "trains all rows on the same scenes"
            )
    if not quick:
        return first.data
    few = min(first.data.limit or _QUICK_SCENES, _QUICK_SCENES)
    return first.data.model_copy(update={"limit": few})


def _entries(
    configs: Sequence[Config],
    scenes: TrainingData,
    seeds: int,
    baselines: Sequence[str] | None,
    quick: bool,
) -> list[Entry]:
    names = None if baselines is None else [name for name in baselines if name != "none"]
    entries: list[Entry] = []
    for seed in range(seeds):
        for config in configs:
            changes: dict[str, int] = {"seed": seed}
            if quick:
                changes["epochs"] = min(config.training.epochs, _QUICK_EPOCHS)
            training = config.training.model_copy(update=changes)
            entries.append(machine_entry(config.model_copy(update={"training": training}), scenes))
        entries += baseline_entries(scenes, seed, names)
    return entries


def _settings(scenes: TrainingData, limit: int) -> dict[str, Setting]:
    """The test scenes of each source, and of all."""
    seen = seen_triples(scenes.train.scenes, scenes.train.v.shape[1])
    test: SceneTensors = scenes.test
    settings = dict(settings_by_source(test, scenes.structure, scenes.train, seen, limit=limit))
    settings[POOLED] = Setting(test, scenes.structure, scenes.train, seen, limit)
    return settings


def _run(
    folder: Path,
    entries: Sequence[Entry],
    settings: dict[str, Setting],
    tasks: Sequence[str],
    ours: str,
) -> Results:
    columns = (
        "[progress.description]{task.description}",
        BarColumn(),
        "{task.completed}/{task.total}",
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("benchmark", total=len(entries) * len(settings), note="")

        def show(row: str, source: str, note: str) -> None:
            bar.update(task, note=f"{row}, {source}: {note}")
            if note in ("done", "known"):
                bar.advance(task)

        reports = measure_entries(folder, entries, settings, tasks, show)
    return summarise(reports, ours)
