"""`python -m training benchmark`: compare machines and baselines on the same scenes.

Each machine or baseline is one row of the result tables. An interrupted run can be continued. The
command writes these files:

<folder>/<domain>/results.*                  results of the comparison
<folder>/<domain>/shuffled/<task>/results.*  results after training on shuffled scenes
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from training.datasets.batches import seen_triples
from training.evaluation.baselines import RELATIONS
from training.evaluation.everyday_task import EVERYDAY, facts_file
from training.evaluation.report import settings_by_source
from training.evaluation.results import Reports, Results, only, summarise, write
from training.evaluation.setting import Setting
from training.evaluation.tasks import TASKS
from training.fit.configuration import Config, ConfigError, DataConfig
from training.research.baselines import BASELINES
from training.research.entries import Entry, baseline_entries, machine_entry, reference_entries
from training.research.measure import POOLED, Plan, measure_entries, resumable, shown, slug
from training.research.plots import write_plots
from training.runs.config_files import data_folder, load_config, shortened, with_settings
from training.runs.pipeline import SplitScenes, prepare

DEFAULT = ("indoor-triway", "indoor-gbm", "indoor-rbm")
"""Configurations that the command measures if it is called without configurations."""

YARDSTICKS = {
    "T1a relations": ("relation popularity", "R-precision, distinct classes"),
    "T1 pairs": ("relation popularity", "accuracy"),
    "T2 missing": ("popularity", "MRR, one removed"),
    "T3 outliers": ("popularity", "hit@1, signature"),
}
"""Baseline of each task that no model should exceed after training on shuffled scenes; metric."""

_RELATION_TASKS = ("T1a relations", "T1 pairs")
# A quick run leaves out tasks that are slow even for a few scenes.
_SLOW_TASKS = ("Density",)
# A quick run only tests the command, so its results are meaningless.
_QUICK_SCENES = 150
_QUICK = 0.1  # share of the training
_QUICK_LIMIT = 30
QUICK_BASELINES = (
    "popularity",
    "EASE",
    "frequency table",
    "frequency table, completing",
    "frequency table p(i | a, j)",
)

console = Console()


@dataclass(frozen=True)
class Domain:
    """Configurations with the same data section. The first one is the reference of differences."""

    name: str
    configs: tuple[Config, ...]


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    root: Path
    tasks: tuple[str, ...]
    seeds: int = 1
    baselines: tuple[str, ...] | None = None
    limit: int = 300
    workers: int = 1
    quick: bool = False
    fresh: bool = False

    def configs(self, domain: Domain, seed: int) -> list[Config]:
        """Return the configurations of the domain with the given training seed."""
        configs = [with_settings(config, {"training.seed": seed}) for config in domain.configs]
        return [shortened(config, _QUICK) for config in configs] if self.quick else configs

    def scenes(self, domain: Domain, **changes: Any) -> SplitScenes:
        """Read and split the scenes of the domain. `changes` replace values of its data section."""
        data = domain.configs[0].data.model_copy(update=changes)
        if self.quick:
            few = min(data.limit or _QUICK_SCENES, _QUICK_SCENES)
            data = data.model_copy(update={"limit": few})
        return prepare(domain.configs[0].model_copy(update={"data": data}), self.root)


def benchmark(
    machines: Annotated[
        list[str] | None,
        typer.Argument(
            help="configurations; those with the same data section are compared with each other, "
            "and the first is the reference. Default: the indoor machines."
        ),
    ] = None,
    data: Annotated[Path | None, typer.Option("--data", help="folder with the scene files")] = None,
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
    limit: Annotated[
        int, typer.Option(min=1, help="maximum scenes per data source in slow tasks")
    ] = 300,
    workers: Annotated[int, typer.Option(min=1, help="processes with one thread each")] = 2,
    shuffled: Annotated[
        bool, typer.Option("--shuffled", help="also train all models on shuffled scenes")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="small run to test the command")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="delete earlier reports")] = False,
) -> None:
    """Train machines and baselines on the same scenes, and evaluate all on the same test scenes.

    The command writes results.json, results.md and plots into one folder per domain. The option
    --shuffled writes into a subfolder. After Ctrl-C, run the same command again: it continues and
    skips finished tasks.
    """
    with resumable(console, ValueError, FloatingPointError):
        baseline_names = None if baseline is None else tuple(b for b in baseline if b != "none")
        names = machines or DEFAULT
        domains = read_domains(names)
        options = Options(
            root=data_folder(names[0], domains[0].configs[0], data),
            tasks=chosen_tasks(task, quick),
            seeds=1 if quick else seeds,
            baselines=QUICK_BASELINES if quick and baseline_names is None else baseline_names,
            limit=_QUICK_LIMIT if quick else limit,
            workers=workers,
            quick=quick,
            fresh=fresh,
        )
        if shuffled:
            shuffled_tasks(options.tasks)  # report invalid tasks before hours of training
        for domain in domains:
            results = folder / domain.name
            compare_domain(domain, results, options)
            if shuffled:
                compare_on_shuffled(domain, results / "shuffled", options)
            console.print(
                f"all results: results.md and results.json in {results} and its subfolders, with "
                "plots beside them",
                soft_wrap=True,
            )


def read_domains(references: Sequence[str]) -> list[Domain]:
    """Read configurations, and group them by data section into domains.

    Raises:
        ConfigError: a configuration cannot be read, or a name occurs twice.
    """
    groups: dict[DataConfig, list[Config]] = {}
    for reference in references:
        config = load_config(reference)
        if any(config.name == other.name for group in groups.values() for other in group):
            raise ConfigError(f"two configurations have the name {config.name}: rename one of them")
        groups.setdefault(config.data, []).append(config)
    domains: dict[str, Domain] = {}
    for configs in groups.values():
        # The first name without its last word: "indoor".
        name = configs[0].name.rpartition("-")[0] or configs[0].name
        if name in domains:
            raise ConfigError(
                f"{configs[0].name} and {domains[name].configs[0].name} have different data "
                f"sections, but their results have the same folder {name!r}: rename one of them"
            )
        domains[name] = Domain(name, tuple(configs))
    return list(domains.values())


def chosen_tasks(names: Sequence[str] | None, quick: bool) -> tuple[str, ...]:
    """Return the tasks with these names or prefixes; by default all, without slow ones if `quick`.

    Raises:
        ValueError: a name matches no task.
    """
    if not names:
        return tuple(name for name in TASKS if not quick or name not in _SLOW_TASKS)
    selected: set[str] = set()
    for part in names:
        # A full name selects only that task, even if it is a prefix of other names.
        matches = {part} & set(TASKS) or {name for name in TASKS if name.startswith(part)}
        if not matches:
            raise ValueError(f"unknown task {part!r}: use a name, or the start, of {list(TASKS)}")
        selected |= matches
    return tuple(name for name in TASKS if name in selected)


def shuffled_tasks(tasks: Sequence[str]) -> tuple[str, ...]:
    """Return the tasks that training on shuffled scenes supports, see `YARDSTICKS`.

    Raises:
        ValueError: no task is supported.
    """
    supported = tuple(task for task in YARDSTICKS if task in tasks)
    if not supported:
        raise ValueError(f"--shuffled needs at least one of the tasks {', '.join(YARDSTICKS)}")
    return supported


def compare_domain(domain: Domain, folder: Path, options: Options) -> None:
    """Measure the machines and baselines of a domain on its test scenes; write tables and plots."""
    scenes = options.scenes(domain)
    plan = _plan(folder, scenes, options, options.tasks)
    entries: list[Entry] = []
    for seed in range(options.seeds):
        entries += [machine_entry(config) for config in options.configs(domain, seed)]
        entries += baseline_entries(
            seed, options.baselines, related=plan.data.related, learning=domain.configs[0].objects
        )
    entries += reference_entries()
    reports = _measure_all(plan, entries, options, domain.name)
    results = summarise(reports, domain.configs[0].name, plan.parameters(entries))
    _write(folder, scenes, results.to_dict(), f"# {domain.name}\n\n{results.markdown()}")
    console.print(*results.tables())
    names = {config.name for config in domain.configs}
    write_plots(plan, [entry for entry in entries if entry.name in names], reports, results)


def compare_on_shuffled(domain: Domain, folder: Path, options: Options) -> None:
    """Run the control experiment: train models on shuffled scenes, and test them on real scenes.

    Baseline settings and training epochs are selected on shuffled validation scenes. Each model is
    trained with one seed. The reference of a task is its baseline in `YARDSTICKS`. These baselines
    are always measured.

    Raises:
        ValueError: no task is supported, see `shuffled_tasks`, or relations are needed.
    """
    real = options.scenes(domain)
    scenes = real.shuffled(seed=0)
    tasks = shuffled_tasks(options.tasks)
    plan = _plan(folder, scenes, options, tasks, asked_by=real)
    if not plan.data.related:
        tasks = tuple(task for task in tasks if task not in _RELATION_TASKS)
        if not tasks:
            raise ValueError(
                f"the scenes of {domain.name} contain no relations, but the selected tasks need "
                "relations: select other tasks"
            )
        plan = replace(plan, tasks=tasks)
    entries = [machine_entry(config, calibrated=False) for config in options.configs(domain, 0)]
    yardsticks = {YARDSTICKS[task][0] for task in tasks}
    chosen = BASELINES if options.baselines is None else yardsticks | set(options.baselines)
    # A baseline that supports several of the tasks is fitted once.
    names = [
        name
        for name, baseline in BASELINES.items()
        if baseline.scores in (("missing",), RELATIONS) and name in chosen
    ]
    learning = domain.configs[0].objects
    entries += baseline_entries(0, names, related=plan.data.related, whole=False, learning=learning)
    reports = _measure_all(plan, entries, options, f"{domain.name}, shuffled")
    weights = plan.parameters(entries)
    for task in tasks:
        yardstick, metric = YARDSTICKS[task]
        shown_metrics = {task: (metric,)}
        task_reports: Reports = {
            row: {source: only(report, shown_metrics) for source, report in by_source.items()}
            for row, by_source in reports.items()
        }
        # A task without metrics needs data that these scenes lack, for example room types.
        outcomes = [report.outcomes[task] for report in task_reports[yardstick, 0].values()]
        if any(outcome and outcome.metrics for outcome in outcomes):
            results = summarise(task_reports, yardstick, weights)
            text = shuffled_text(task, results)
            _write(folder / slug(task), scenes, results.to_dict(), text)
            console.print("trained on shuffled scenes:", *results.tables(shown_metrics))


def _plan(
    folder: Path,
    scenes: SplitScenes,
    options: Options,
    tasks: tuple[str, ...],
    asked_by: SplitScenes | None = None,
) -> Plan:
    """Plan the measurement of models that learn from `scenes`.

    The training part of `asked_by`, by default `scenes`, determines the questions.
    """
    data = scenes.complete_data()
    train = data.train if asked_by is None else asked_by.training_data().train
    seen, limit = seen_triples(data.train.scenes, data.train.v.shape[1]), options.limit
    settings = dict(settings_by_source(data.test, data.structure, train, seen, limit=limit))
    facts = EVERYDAY if facts_file() else None
    settings[POOLED] = Setting(data.test, data.structure, train, seen, limit, everyday=facts)
    return Plan(folder, data, settings, tasks)


def _measure_all(plan: Plan, entries: Sequence[Entry], options: Options, title: str) -> Reports:
    workers, fresh = options.workers, options.fresh
    with shown(console, title, len(entries) * len(plan.settings)) as progress:
        return measure_entries(plan, entries, progress, workers=workers, fresh=fresh)[0]


def _write(folder: Path, scenes: SplitScenes, values: dict[str, Any], text: str) -> None:
    """Write the results and the sha256 of each data source."""
    write(folder, {"contents": dict(scenes.digests)} | values, text)


def shuffled_text(task: str, results: Results) -> str:
    """Return the Markdown page of one task of the control experiment."""
    _, metric = YARDSTICKS[task]
    better_models = [
        f"{difference.row} by {-difference.figure.value:.3f}"
        for difference in results.differences
        if difference.source == POOLED and difference.verdict == "worse"
    ]
    return f"""# Shuffled scenes, {task}

All models are trained on shuffled scenes: the objects are permuted between scenes. Each scene keeps
its number of classes, and each class keeps its number of scenes, but co-occurrence is random. Test
scenes are real. No model should exceed {results.ours}. A model above it uses information from
outside the training scenes. A star marks a model that is worse than the bold model: the whole
interval of the paired difference is on one side of zero.

{results.markdown({task: (metric,)})}
Models above {results.ours} over the whole interval: {", ".join(better_models) or "none"}.
"""
