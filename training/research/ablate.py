"""`python -m training ablate`: compare a full model with ablations, its variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel, Field, ValidationError
from rich.console import Console

from training.datasets.batches import TrainingData, seen_triples
from training.evaluation.report import SourceReport, pooled, settings_by_source
from training.evaluation.results import Reports, grid, only, summarise, write
from training.evaluation.setting import Setting
from training.fit.checkpoint import RunError
from training.fit.configuration import Config, ConfigError, first_error
from training.research.entries import Entry, machine_entry
from training.research.measure import Plan, measure_entries, resumable, shown
from training.runs.config_files import (
    data_folder,
    load_config,
    own_or_shipped,
    read_toml,
    shortened,
    with_settings,
)
from training.runs.folder import load_run
from training.runs.pipeline import prepare

PRIMARY: dict[str, tuple[str, ...]] = {
    "T1a relations": ("R-precision, instance counts",),
    "T1 pairs": ("accuracy", "accuracy, unseen pairs", "accuracy, rare classes"),
    "T1b completion": ("R-precision",),
    "T2 missing": ("MRR, one removed", "MRR, 25 % shown"),
    "T2-at missing at a place": ("MRR",),
    "T3 outliers": ("hit@1, uniform", "hit@1, by popularity", "hit@1, signature"),
}
"""Metrics in the result tables, by task. The report files hold all metrics of these tasks."""

console = Console()


def ablate(
    configuration: Annotated[str, typer.Argument(help="configuration of the full model")],
    rows: Annotated[
        Path | None, typer.Option(help="TOML file of the ablations; by default the shipped file")
    ] = None,
    row: Annotated[
        list[str] | None, typer.Option(help="train only these ablations and the full model")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="number of training seeds per model")] = 1,
    limit: Annotated[int | None, typer.Option(min=10, help="maximum scenes per source")] = None,
    asked: Annotated[
        int, typer.Option(min=1, help="maximum scenes per data source in slow tasks")
    ] = 300,
    length: Annotated[
        float, typer.Option(min=0.001, max=1, help="share of the steps and epochs of a training")
    ] = 1.0,
    workers: Annotated[int, typer.Option(min=1, help="number of single-threaded processes")] = 2,
    data: Annotated[Path | None, typer.Option("--data", help="folder with the scene files")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="folder for runs and results")] = Path(
        "runs/ablation"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="delete earlier runs")] = False,
) -> None:
    """Train the full model and each of its ablations, and compare them on the same scenes.

    The command writes results.json and results.md into FOLDER/CONFIGURATION. If the training of
    an ablation diverges, the results contain the error in place of its metrics. After Ctrl-C, run
    the same command again: it continues from the last checkpoint or task.
    """
    with resumable(console):
        configs = _configs(configuration, rows, row, limit, length)
        results_folder = folder / configs[0].name
        with console.status("reading and encoding scenes"):
            root = data_folder(configuration, configs[0], data)
            scenes = prepare(configs[0], root).complete_data()
        plan = Plan(results_folder, scenes, _settings(scenes, asked), tasks=tuple(PRIMARY))
        entries = [
            machine_entry(with_settings(config, {"training.seed": seed}))
            for config in configs
            for seed in range(seeds)
        ]
        with shown(console, "ablation", len(entries) * len(plan.settings)) as progress:
            diverged = (FloatingPointError,)
            measured, failures = measure_entries(
                plan, entries, progress, workers=workers, fresh=fresh, failures=diverged
            )
    if configs[0].name in failures:
        console.print(f"[red]error:[/red] {configs[0].name}: {failures[configs[0].name]}")
        raise typer.Exit(1)
    with console.status("resampling scenes"):
        reports: Reports = {row: _with_pools(by_source) for row, by_source in measured.items()}
        weights, seconds = _costs(plan, entries)
        results = summarise(reports, configs[0].name, weights)
    parts = [
        grid(
            ["", "", "training, s"],
            ([c.name, c.description, f"{seconds.get(c.name, 0):.0f}"] for c in configs),
        ),
        results.markdown(PRIMARY, changes=True),
        *(f"- {row} could not be measured: {why}" for row, why in failures.items()),
    ]
    text = "\n\n".join(parts).rstrip() + "\n"
    write(results_folder, results.to_dict() | {"failures": failures}, text)
    console.print(*results.tables(PRIMARY))
    for name, why in failures.items():
        console.print(f"{name} could not be measured: {why}", markup=False, soft_wrap=True)
    console.print(
        f"all results: {results_folder / 'results.md'}, {results_folder / 'results.json'}",
        soft_wrap=True,
    )


def _configs(
    reference: str, path: Path | None, names: Sequence[str] | None, limit: int | None, length: float
) -> list[Config]:
    """Return the configurations of the full model and of the selected ablations."""
    full = load_config(reference)
    if limit is not None:
        full = with_settings(full, {"data.limit": limit})
    rows = load_rows(own_or_shipped(path, full, "ablations", "--rows"), full)
    known = [row.name for row in rows]
    if unknown := sorted(set(names or ()) - set(known)):
        raise ConfigError(f"unknown rows {unknown}: choose from {', '.join(known)}")
    configs = [full, *(row for row in rows if not names or row.name in names)]
    return [shortened(config, length) for config in configs]


def _settings(scenes: TrainingData, limit: int) -> dict[str, Setting]:
    """Return the evaluation settings of the validation and test part of each data source."""
    seen = seen_triples(scenes.train.scenes, scenes.train.v.shape[1])
    common = scenes.structure, scenes.train, seen
    return {
        f"{part} {source}": setting
        for part, own in (("validation", scenes.validation), ("test", scenes.test))
        for source, setting in settings_by_source(own, *common, limit=limit)
    }


def _with_pools(reports: Mapping[str, SourceReport]) -> dict[str, SourceReport]:
    """Return the `PRIMARY` metrics, first of the pooled validation and test parts."""
    pools = {
        f"{part} pooled": pooled([r for name, r in reports.items() if name.startswith(part)])
        for part in ("validation", "test")
    }
    return {name: only(report, PRIMARY) for name, report in {**pools, **reports}.items()}


def _costs(plan: Plan, entries: Sequence[Entry]) -> tuple[dict[str, int], dict[str, float]]:
    """Return the number of weights not held at zero, and the mean seconds, by model name."""
    weights, seconds = {}, {}
    for name in dict.fromkeys(e.name for e in entries):
        try:
            runs = [load_run(plan.folder_of(e) / "run") for e in entries if e.name == name]
        except RunError:
            continue
        machine, zero_weights = runs[0].machine, runs[0].config.machine.without
        held = sum(machine.get_parameter(key).numel() for key in zero_weights)
        weights[name] = machine.parameter_count - held
        seconds[name] = sum(run.seconds for run in runs) / len(runs)
    return weights, seconds


class _Change(BaseModel, extra="forbid", frozen=True):
    name: str
    what: str
    start: str | None = Field(default=None, alias="from")
    changes: dict[str, Any] = Field(default_factory=dict)


class _File(BaseModel, extra="forbid", frozen=True):
    row: tuple[_Change, ...] = Field(min_length=1)


def load_rows(path: Path, full: Config) -> list[Config]:
    """Read the ablations in a TOML file: one configuration for each `[[row]]` of the file.

    All ablations use the scenes of the full model.

    Raises:
        ConfigError: the file is missing or not TOML, a setting is unknown or invalid, two ablations
            have the same name, or an ablation has the same settings as the full model.
    """
    try:
        file = _File.model_validate(read_toml(path))
    except ValidationError as error:
        raise ConfigError(f"{path.name}: {first_error(error)}") from error
    configs = [full]
    for row in file.row:
        if any(row.name == config.name for config in configs):
            raise ConfigError(f"{path.name}: the name {row.name} occurs twice: rename one row")
        configs.append(_config(row, full, path.name))
    return configs[1:]


def _config(row: _Change, full: Config, file: str) -> Config:
    try:
        start = load_config(row.start) if row.start else full
        changed = with_settings(start, row.changes).model_copy(update={"data": full.data})
        if changed == full:
            raise ConfigError(f"the row has the same settings as {full.name}: change a setting")
        values = changed.model_dump() | {"name": row.name, "description": row.what}
        return Config.model_validate(values)
    except (ConfigError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise ConfigError(f"{file}: {row.name}: {reason}") from error
