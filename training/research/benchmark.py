"""`python -m training benchmark`: compare machines and baselines on the same scenes.

Each machine or baseline is one row of the result tables. An interrupted run can be continued.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from training.datasets.batches import seen_triples
from training.evaluation.everyday_task import EVERYDAY, facts_file
from training.evaluation.report import settings_by_source
from training.evaluation.results import SHOWN, Shown, grid, summarise, write
from training.evaluation.setting import Setting
from training.evaluation.tasks import TASKS
from training.fit.configuration import Config, ConfigError
from training.research.entries import Entry, baseline_entries, machine_entry, reference_entries
from training.research.measure import POOLED, Plan, measure_entries, resumable
from training.research.plots import write_plots
from training.runs.config_files import data_folder, load_config, with_settings
from training.runs.pipeline import SplitScenes, prepare

DEFAULT = ("places-triway", "places-gbm", "places-rbm")
"""Configurations that the command measures if it is called without configurations."""

Data = Annotated[Path | None, typer.Option("--data", help="folder with the scene files")]
Limit = Annotated[int, typer.Option(min=1, help="maximum scenes per data source in slow tasks")]
Workers = Annotated[int, typer.Option(min=1, help="processes with one thread each")]
Fresh = Annotated[bool, typer.Option("--fresh", help="delete earlier runs and reports")]

console = Console()


def benchmark(
    machines: Annotated[
        list[str] | None,
        typer.Argument(
            help="configurations with the same data section; the first is the reference. "
            "Default: the shipped machines."
        ),
    ] = None,
    data: Data = None,
    folder: Annotated[Path, typer.Option("--folder", help="folder for the results")] = Path(
        "runs/benchmark"
    ),
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
    with resumable(console):
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
        plan = _plan(folder, scenes, limit, tuple(shown))
    related, learning = plan.data.related, configs[0].objects
    entries: list[Entry] = []
    for seed in range(seeds):
        seeded = [with_settings(config, {"training.seed": seed}) for config in configs]
        entries += [machine_entry(config) for config in seeded]
        entries += baseline_entries(seed, baselines, related=related, learning=learning)
    entries += reference_entries()
    reports, failures = measure_entries(plan, entries, console, workers=workers, fresh=fresh)
    with console.status("resampling scenes"):
        results = summarise(reports, configs[0].name)
    contents = {"contents": dict(scenes.digests), "failures": failures}
    remarks = [f"{name} could not be measured: {reason}" for name, reason in failures.items()]
    table = grid(["", ""], ([config.name, config.description] for config in configs))
    text = "\n\n".join([f"# {folder.name}", table, *remarks, results.markdown(shown)])
    write(folder, contents | results.to_dict(), text)
    console.print(*remarks, sep="\n", markup=False, soft_wrap=True)
    write_plots(folder, [config.name for config in configs], reports)
    console.print(f"all results: results.md, results.json and plots in {folder}", soft_wrap=True)


def _plan(folder: Path, scenes: SplitScenes, limit: int, tasks: tuple[str, ...]) -> Plan:
    """Return the questions about the test scenes of each data source, and of all together."""
    data = scenes.complete_data()
    common = data.structure, data.train, seen_triples(data.train.scenes, data.train.v.shape[1])
    settings = dict(settings_by_source(data.test, *common, limit=limit))
    facts = EVERYDAY if facts_file() else None
    settings[POOLED] = Setting(data.test, *common, limit, everyday=facts)
    return Plan(folder, data, settings, tasks)
