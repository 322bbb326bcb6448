"""`python -m training benchmark` and `ablate`: compare models on the same scenes.

Each machine or baseline is one row of the result tables. `ablate` compares a full model with
ablations, its variants. An interrupted run can be continued. Reliability plots show the predicted
probability against the observed frequency.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import BaseModel, Field, ValidationError

from training.datasets.batches import seen_triples
from training.datasets.console import console
from training.datasets.files import write_whole
from training.evaluation.calibration_task import NAMES
from training.evaluation.everyday_task import EVERYDAY, facts_file
from training.evaluation.metrics import Scored
from training.evaluation.results import SHOWN, Reports, Shown, grid, summarise
from training.evaluation.setting import Outcome, Setting
from training.evaluation.tasks import TASKS
from training.fit.configuration import Config, ConfigError, first_error
from training.research.measure import (
    POOLED,
    Entry,
    Plan,
    baseline_entries,
    machine_entry,
    measure_entries,
    reference_entries,
    resumable,
    slug,
)
from training.runs.config_files import (
    data_folder,
    load_config,
    own_or_shipped,
    read_toml,
    with_settings,
)
from training.runs.pipeline import prepare

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEFAULT = ("places-triway", "places-gbm", "places-rbm")
"""Configurations that the command measures if it is called without configurations."""

Folder = Annotated[Path, typer.Option("--folder", help="folder for the results")]
Data = Annotated[Path | None, typer.Option("--data", help="folder with the scene files")]
Limit = Annotated[int, typer.Option(min=1, help="maximum scenes per data source in slow tasks")]
Workers = Annotated[int, typer.Option(min=1, help="processes with one thread each")]
Fresh = Annotated[bool, typer.Option("--fresh", help="delete earlier runs and reports")]


def benchmark(
    machines: Annotated[
        list[str] | None,
        typer.Argument(
            help="configurations with the same data section; the first is the reference. "
            "Default: the shipped machines."
        ),
    ] = None,
    data: Data = None,
    folder: Folder = Path("runs/benchmark"),
    seeds: Annotated[
        int, typer.Option(min=1, help="training seeds, for models with random training")
    ] = 3,
    baseline: Annotated[
        list[str] | None, typer.Option(help="measure only these baselines; 'none' leaves out all")
    ] = None,
    task: Annotated[
        list[str] | None, typer.Option(help="measure only these tasks, by name or prefix: T2, T3")
    ] = None,
    limit: Limit = 300,
    workers: Workers = 2,
    fresh: Fresh = False,
) -> None:
    """Train machines and baselines on the same scenes, and evaluate all on the same test scenes.

    The command writes results.json, results.md and plots into a folder with the first word of the
    first configuration. After Ctrl-C, run the same command again: it skips finished reports.
    """
    with resumable():
        shown = {name: SHOWN[name] for name in chosen_tasks(task)}
        baselines = None if baseline is None else [name for name in baseline if name != "none"]
        names = machines or DEFAULT
        configs = read_configs(names)
        # The first name without its last word: "places".
        results = folder / (configs[0].name.rpartition("-")[0] or configs[0].name)
        compare_machines(
            configs, data_folder(names[0], configs[0], data), results, shown,
            seeds=seeds, baselines=baselines, limit=limit, workers=workers, fresh=fresh,
        )  # fmt: skip


def read_configs(references: Sequence[str]) -> list[Config]:
    """Read the configurations to compare.

    Raises:
        ConfigError: a configuration is unreadable, a name occurs twice, or data sections differ.
    """
    configs = [load_config(reference) for reference in references]
    first, *others = configs
    for number, config in enumerate(others, 1):
        if config.name in {other.name for other in configs[:number]}:
            raise ConfigError(f"two configurations have the name {config.name}: rename one of them")
        if config.data != first.data:
            raise ConfigError(
                f"{config.name} and {first.name} have different data sections, so they cannot be "
                "compared: measure each of them with a command of its own"
            )
    return configs


def chosen_tasks(names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the tasks with these names or prefixes; by default all.

    Raises:
        ValueError: a name matches no task.
    """
    selected: set[str] = set()
    for part in names or TASKS:
        # A full name selects only that task, even if it is a prefix of other names.
        matches = {part} & set(TASKS) or {name for name in TASKS if name.startswith(part)}
        if not matches:
            raise ValueError(f"unknown task {part!r}: use a name, or the start, of {list(TASKS)}")
        selected |= matches
    return tuple(name for name in TASKS if name in selected)


def compare_machines(
    configs: Sequence[Config],
    root: Path,
    folder: Path,
    shown: Shown,  # the tasks to measure, and their metrics in the tables
    *,
    seeds: int,
    baselines: Sequence[str] | None,
    limit: int,
    workers: int,
    fresh: bool,
) -> None:
    """Measure machines and baselines on test scenes, and write tables and plots into the folder.

    `configs` have the same data section; the first is the reference of all differences. `root` is
    the folder of the scene files. `baselines` is None for all. A model whose training diverges has
    its error in the results instead of metrics.

    Raises:
        ValueError: a baseline is unknown, or the reference has no metric.
    """
    with console.status("reading and encoding scenes"):
        scenes = prepare(configs[0], root)
        data = scenes.complete_data()
        seen = seen_triples(data.train.scenes, data.train.v.shape[1])
    every = Setting(data.test, data.structure, data.train, seen, limit)
    pooled = replace(every, everyday=EVERYDAY if facts_file() else None)
    plan = Plan(folder, data, {**dict(every.by_source()), POOLED: pooled}, tuple(shown))
    related, learning = data.related, configs[0].objects
    entries: list[Entry] = []
    for seed in range(seeds):
        seeded = [with_settings(config, {"training.seed": seed}) for config in configs]
        entries += [machine_entry(config) for config in seeded]
        entries += baseline_entries(seed, baselines, related=related, learning=learning)
    entries += reference_entries()
    reports, failures = measure_entries(plan, entries, workers=workers, fresh=fresh)
    with console.status("resampling scenes"):
        results = summarise(reports, configs[0].name)
    contents = {"contents": dict(scenes.digests), "failures": failures}
    remarks = [f"{name} could not be measured: {reason}" for name, reason in failures.items()]
    table = grid(["", ""], ([config.name, config.description] for config in configs))
    text = "\n\n".join([f"# {folder.name}", table, *remarks, results.markdown(shown)])
    write_whole(folder / "results.md", text)
    write_whole(folder / "results.json", json.dumps(contents | results.to_dict(), indent=1) + "\n")
    console.print(*remarks, sep="\n", soft_wrap=True)
    write_plots(folder, [config.name for config in configs], reports)
    console.print(f"all results: results.md, results.json and plots in {folder}", soft_wrap=True)


PRIMARY: dict[str, tuple[str, ...]] = {
    "T1a relations": ("R-precision, instance counts",),
    "T1 pairs": ("accuracy", "accuracy, unseen pairs", "accuracy, rare classes"),
    "T1b completion": ("R-precision",),
    "T2 missing": ("MRR, one removed", "MRR, 25 % shown"),
    "T2-at missing at a place": ("MRR",),
    "T3 outliers": ("hit@1, uniform", "hit@1, by popularity", "hit@1, signature"),
}
"""Tasks of an ablation, and their metrics in the tables. JSON files hold all metrics."""


def ablate(
    configuration: Annotated[str, typer.Argument(help="configuration of the full model")],
    rows: Annotated[
        Path | None, typer.Option(help="TOML file of the ablations; by default the shipped file")
    ] = None,
    row: Annotated[
        list[str] | None, typer.Option(help="train only these ablations and the full model")
    ] = None,
    data: Data = None,
    folder: Annotated[Path, typer.Option("--folder", help="folder for runs and results")] = Path(
        "runs/ablation"
    ),
    seeds: Annotated[int, typer.Option(min=1, help="number of training seeds per model")] = 1,
    limit: Limit = 300,
    workers: Workers = 2,
    fresh: Fresh = False,
) -> None:
    """Train the full model and each of its ablations, and compare them on the same test scenes.

    The command writes results.json and results.md into FOLDER/CONFIGURATION. If the training of
    an ablation diverges, the results contain the error in place of its metrics. After Ctrl-C, run
    the same command again: it skips finished models and tasks.
    """
    with resumable():
        full = load_config(configuration)
        ablations = load_rows(own_or_shipped(rows, full, "ablations", "--rows"), full)
        names = [ablation.name for ablation in ablations]
        if unknown := sorted(set(row or ()) - set(names)):
            raise ConfigError(f"unknown rows {unknown}: choose from {', '.join(names)}")
        configs = [full, *(config for config in ablations if not row or config.name in row)]
        compare_machines(
            configs, data_folder(configuration, full, data), folder / full.name,
            PRIMARY, seeds=seeds, baselines=(), limit=limit, workers=workers, fresh=fresh,
        )  # fmt: skip


class _Change(BaseModel, extra="forbid", frozen=True):
    name: str
    what: str
    start: str | None = Field(default=None, alias="from")
    changes: dict[str, Any] = Field(default_factory=dict)


class _File(BaseModel, extra="forbid", frozen=True):
    row: tuple[_Change, ...] = Field(min_length=1)


def load_rows(path: Path, full: Config) -> list[Config]:
    """Read one configuration for each `[[row]]` of a TOML file, with the scenes of the full model.

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
    """Return the configuration of one ablation; see `load_rows` for the errors."""
    try:
        start = load_config(row.start) if row.start else full
        changed = with_settings(start, row.changes).model_copy(update={"data": full.data})
        if changed == full:
            raise ConfigError(f"the row has the same settings as {full.name}: change a setting")
        names = {"name": row.name, "description": row.what}
        return Config.model_validate(changed.model_dump() | names)
    except (ConfigError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise ConfigError(f"{file}: {row.name}: {reason}") from error


def write_plots(folder: Path, machines: Sequence[str], reports: Reports) -> None:
    """Write reliability-<machine>.png for each machine with measured calibration, of seed 0."""
    for name in machines:
        report = reports.get((name, 0), {}).get(POOLED)
        outcome = None if report is None else report.outcomes.get("Calibration")
        if outcome is not None:
            figure = reliability_diagrams(outcome, f"{name}, {POOLED}")
            figure.savefig(folder / f"reliability-{slug(name)}.png", dpi=110)


def reliability_diagrams(outcome: Outcome, title: str) -> Figure:
    """Plot reliability diagrams, one per question, with and without calibration."""
    from matplotlib.figure import Figure  # slow to import

    questions = [name for name in NAMES if f"ECE, {name}" in outcome.metrics]
    figure = Figure(figsize=(3.2 * len(questions), 3.6), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(1, len(questions), squeeze=False).flat
    for axis, name in zip(axes, questions, strict=True):
        axis.plot([1e-5, 1], [1e-5, 1], color="0.7", linewidth=1)
        for suffix, marker in ((", uncalibrated", "x"), ("", "o")):
            metric = outcome.metrics[f"ECE, {name}{suffix}"]
            if not isinstance(metric, Scored):
                raise TypeError(f"the metric ECE of {name} does not store its answers")
            probability, frequency = metric.reliability()
            label = f"{suffix[2:] or 'as published'}, ECE {metric.value:.3f}"
            axis.plot(probability, frequency, marker=marker, linewidth=1, label=label)
        axis.set_xscale("symlog", linthresh=1e-3)  # most probabilities are small
        axis.set_yscale("symlog", linthresh=1e-3)
        axis.set(xlim=(0, 1.1), ylim=(0, 1.1), xlabel="probability", title=name)
        axis.legend(fontsize=7)
    return figure
