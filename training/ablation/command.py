"""`python -m training ablate`: every row trained and measured on the same scenes, resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from training.ablation.rows import load_rows, shipped_ablations
from training.ablation.table import COLUMNS, TASKS, Cost, markdown
from training.batches import seen_triples
from training.benchmark.entries import Entry, Material, machine_entry
from training.benchmark.measure import (
    DONE,
    KNOWN,
    BenchmarkError,
    Plan,
    forget,
    measure_entries,
    place_of,
)
from training.benchmark.summary import summarise
from training.benchmark.workers import fill
from training.checkpoints import CheckpointError
from training.config import Config, ConfigError, data_folder, load_config, with_settings
from training.datasets import DatasetError
from training.evaluation.report import SourceReport, pooled, settings_by_source
from training.evaluation.tasks import Setting
from training.pipeline import prepare
from training.runs import RunError, load_run
from training.trainer import TrainingData

console = Console()


def ablate(
    configuration: Annotated[str, typer.Argument(help="the full model's configuration")],
    rows: Annotated[
        Path | None, typer.Option(help="the rows; by default the shipped ones of its name")
    ] = None,
    row: Annotated[list[str] | None, typer.Option(help="only these, and the full model")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="training seeds of every row")] = 1,
    limit: Annotated[int | None, typer.Option(min=10, help="scenes a source")] = None,
    asked: Annotated[int, typer.Option(min=1, help="scenes a source where a task is slow")] = 300,
    epochs: Annotated[int | None, typer.Option(min=1, help="at most, for every row")] = None,
    workers: Annotated[int, typer.Option(min=1, help="processes, of one thread each")] = 2,
    data: Annotated[Path | None, typer.Option("--data", help="folder with the scene files")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="for runs and results")] = Path(
        "runs/ablation"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="forget earlier runs")] = False,
) -> None:
    """Train the full model and each of its ablations, and compare them on the same scenes.

    Writes results.json and results.md into <folder>/<configuration>. A row that diverges is
    reported and left out. Ctrl-C loses at most an epoch or a task; the same command goes on from
    there.
    """
    try:
        configs = _configs(configuration, rows, row, limit, epochs)
        place = folder / configs[0].name
        with console.status("reading and encoding scenes"):
            material = Material.of(
                prepare(configs[0], data_folder(configuration, configs[0], data))
            )
        plan = Plan(place, material, _settings(material.data, asked), tasks=TASKS)
        entries = [
            machine_entry(with_settings(config, {"training.seed": seed}))
            for config in configs
            for seed in range(seeds)
        ]
        if fresh:
            forget(place, entries)
        reports, failures = _run(plan, entries, workers)
    except (
        ConfigError, DatasetError, BenchmarkError, CheckpointError, BrokenProcessPool,
    ) as error:  # fmt: skip
        console.print(f"[red]error:[/red] {error}")
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; the same command goes on from there")
        raise typer.Exit(130) from None
    if configs[0].name in failures:
        console.print(f"[red]error:[/red] {configs[0].name}: {failures[configs[0].name]}")
        raise typer.Exit(1)
    with console.status("resampling scenes"):
        results = summarise(reports, configs[0].name)
    costs = {config.name: cost for config in configs if (cost := _cost(place, config, seeds))}
    text = markdown(results, configs, costs, failures)
    written: dict[str, Any] = results.to_dict() | {"failures": failures}
    (place / "results.json").write_text(json.dumps(written, indent=1), encoding="utf-8")
    (place / "results.md").write_text(text, encoding="utf-8")
    console.print(text, markup=False, soft_wrap=True)
    console.print(f"every figure: {place / 'results.json'}")


def _configs(
    reference: str,
    path: Path | None,
    names: Sequence[str] | None,
    limit: int | None,
    epochs: int | None,
) -> list[Config]:
    """The full model and the rows, within the limits.

    Raises:
        ConfigError: see `load_rows`; no rows come with the configuration; an unknown row.
    """
    full = load_config(reference)
    if limit is not None:
        full = with_settings(full, {"data.limit": limit})
    shipped = shipped_ablations()
    if path is None and full.name not in shipped:
        raise ConfigError(
            f"no ablation comes with {full.name}, only with {', '.join(shipped)}: name a TOML "
            "file with --rows"
        )
    found = load_rows(path or shipped[full.name], full)
    if unknown := sorted(set(names or ()) - {config.name for config in found}):
        raise ConfigError(f"no rows {unknown}, only {', '.join(c.name for c in found)}")
    chosen = [full, *(config for config in found if not names or config.name in names)]
    if epochs is None:
        return chosen
    return [
        with_settings(config, {"training.epochs": min(epochs, config.training.epochs)})
        for config in chosen
    ]


def _settings(scenes: TrainingData, limit: int) -> dict[str, Setting]:
    """The scenes of each source, of both parts; at most `limit` where a task is slow."""
    seen = seen_triples(scenes.train.scenes, scenes.train.v.shape[1])
    parts = {"validation": scenes.validation, "test": scenes.test}
    return {
        f"{part} {source}": setting
        for part, some in parts.items()
        for source, setting in settings_by_source(
            some, scenes.structure, scenes.train, seen, limit=limit
        )
    }


def _run(
    plan: Plan, entries: Sequence[Entry], workers: int
) -> tuple[dict[tuple[str, int], dict[str, SourceReport]], dict[str, str]]:
    """Reports by row and seed, pools among them; and why rows are missing there."""
    reports: dict[tuple[str, int], dict[str, SourceReport]] = {}
    failures: dict[str, str] = {}
    columns = (
        "[progress.description]{task.description}",
        BarColumn(),
        "{task.completed}/{task.total}",
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("ablation", total=len(entries) * len(plan.settings), note="")

        def show(row: str, source: str, note: str) -> None:
            bar.update(task, note=f"{row}, {source}: {note}")
            if note in (DONE, KNOWN):
                bar.advance(task)

        failed: dict[tuple[str, int], Exception] = {}
        if workers > 1:
            failed = fill(plan, entries, show, workers, failures=(FloatingPointError,))
            bar.update(task, completed=0)
        for number, entry in enumerate(entries, 1):
            try:
                if error := failed.get((entry.name, entry.seed)):
                    raise error
                found = measure_entries(plan, [entry], show)
            except FloatingPointError as error:
                failures[entry.name] = f"seed {entry.seed}: {error}"
            else:
                for key, by_source in found.items():
                    reports[key] = _with_pools(by_source)
            bar.update(task, completed=number * len(plan.settings))
    kept = {key: value for key, value in reports.items() if key[0] not in failures}
    return kept, failures


def _with_pools(reports: Mapping[str, SourceReport]) -> dict[str, SourceReport]:
    pools = {
        f"{part} pooled": pooled(
            [report for name, report in reports.items() if name.startswith(part)], f"{part} pooled"
        )
        for part in ("validation", "test")
    }
    return {name: _shown(report) for name, report in (pools | dict(reports)).items()}


def _shown(report: SourceReport) -> SourceReport:
    """The report with the metrics of the table alone: resampling the others takes minutes."""
    outcomes = {
        task: outcome
        and replace(
            outcome,
            metrics={
                name: metric
                for name, metric in outcome.metrics.items()
                if any((task, name) == (t, n) for _, t, n in COLUMNS)
            },
        )
        for task, outcome in report.outcomes.items()
    }
    return replace(report, outcomes=outcomes)


def _cost(folder: Path, config: Config, seeds: int) -> Cost | None:
    """What the row's runs took; None where one of them is missing."""
    places = [place_of(folder, config.name, seed) / "run" for seed in range(seeds)]
    try:
        runs = [load_run(place) for place in places]
    except RunError:
        return None
    held = {"kappa", *config.machine.without}
    weights = runs[0].machine.named_parameters()
    return Cost(
        weights=sum(p.numel() for name, p in weights if name not in held),
        seconds=sum(run.seconds for run in runs) / seeds,
    )
