"""One domain measured from its scenes to its tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from training.batches import seen_triples
from training.benchmark.domains import Domain
from training.benchmark.entries import (
    RELATION_TASKS,
    Entry,
    Material,
    bare_machine_entry,
    baseline_entries,
    machine_entry,
    plain_baseline_entries,
    reference_entries,
)
from training.benchmark.measure import (
    POOLED,
    Plan,
    Progress,
    forget,
    parameters,
)
from training.benchmark.plots import write_plots
from training.benchmark.sections import (
    TABLES,
    YARDSTICKS,
    write_protocol,
    write_shuffled,
    write_tables,
)
from training.benchmark.summary import Results, summarise
from training.benchmark.workers import fill
from training.config import Config, ConfigError, DataConfig
from training.evaluation.everyday import EVERYDAY, facts_file
from training.evaluation.report import SourceReport, settings_by_source
from training.evaluation.seed_protocol import SEED_TASKS
from training.evaluation.tasks import Setting
from training.pipeline import SplitScenes, prepare

# What a quick run does instead: it shows that everything works, its figures mean nothing.
_QUICK_SCENES = 150
_QUICK_EPOCHS = 2
_QUICK_LIMIT = 30
QUICK_BASELINES = (
    "popularity",
    "EASE",
    "frequency table",
    "frequency table, completing",
    "frequency table p(i | a, j)",
)

# Called with the number of (row, source) pairs of what begins now; returns who hears of them.
Begin = Callable[[str, int], Progress]
Measured = Mapping[tuple[str, int], Mapping[str, SourceReport]]


@dataclass(frozen=True)
class Options:
    """What is measured of every domain.

    Attributes:
        tasks: names in `TASKS`.
        seeds: training seeds of every row whose training is random.
        baselines: only these; all by default.
        limit: scenes a source where a task is slow.
        workers: processes.
        quick: few scenes, epochs and baselines.
        fresh: earlier reports are forgotten.
    """

    tasks: tuple[str, ...]
    seeds: int
    baselines: tuple[str, ...] | None
    limit: int
    workers: int
    quick: bool
    fresh: bool

    @property
    def chosen_baselines(self) -> tuple[str, ...] | None:
        """Names of baselines, None for all."""
        return QUICK_BASELINES if self.quick and self.baselines is None else self.baselines

    def shuffled_tasks(self) -> tuple[str, ...]:
        """The tasks of `YARDSTICKS` that are wanted.

        Raises:
            ValueError: none of them is.
        """
        found = tuple(task for task in YARDSTICKS if task in self.tasks)
        if not found:
            raise ValueError(f"on shuffled scenes only {', '.join(YARDSTICKS)} are asked")
        return found

    def configs(self, domain: Domain, seed: int) -> list[Config]:
        """The domain's configurations as they are trained for one seed."""
        changes: dict[str, int] = {"seed": seed}
        found = []
        for config in domain.configs:
            if self.quick:
                changes["epochs"] = min(config.training.epochs, _QUICK_EPOCHS)
            training = config.training.model_copy(update=changes)
            found.append(config.model_copy(update={"training": training}))
        return found

    def data(self, domain: Domain) -> DataConfig:
        """The scenes that all rows learn from."""
        if not self.quick:
            return domain.data
        few = min(domain.data.limit or _QUICK_SCENES, _QUICK_SCENES)
        return domain.data.model_copy(update={"limit": few})


def compare_domain(
    domain: Domain, data: Path, folder: Path, options: Options, begin: Begin
) -> Results:
    """Every row of a domain on its test scenes; the tables and plots are written into the folder.

    Raises:
        ConfigError: see `require_groups`; the scenes cannot be found.
        DatasetError: they cannot be read.
        BenchmarkError: see `Plan.known`.
        ValueError: an unknown baseline.
    """
    require_groups(domain)
    scenes = _scenes(domain, data, options)
    plan = _plan(folder, scenes, options, options.tasks)
    related = plan.material.related
    entries: list[Entry] = []
    for seed in range(1 if options.quick else options.seeds):
        entries += [machine_entry(config) for config in options.configs(domain, seed)]
        entries += baseline_entries(seed, options.chosen_baselines, related=related)
    entries += reference_entries()
    reports = _measured(plan, entries, options, begin(domain.name, plan_size(plan, entries)))
    ours = domain.configs[0].name
    results = summarise(reports, ours, parameters(folder, entries))
    write_tables(folder / TABLES, results, scenes.digests)
    machines = [entry for entry in entries if entry.name in {c.name for c in domain.configs}]
    write_plots(plan, machines, reports, results)
    return results


def compare_by_seed_protocol(
    domain: Domain, data: Path, folder: Path, options: Options, begin: Begin
) -> Results:
    """The machines of a domain, trained once on the random split, asked as the seed paper asks."""
    domain = domain.split_at_random()
    scenes = _scenes(domain, data, options)
    plan = _plan(folder, scenes, options, tuple(SEED_TASKS))
    entries = [bare_machine_entry(config) for config in options.configs(domain, 0)]
    title = f"{domain.name}, seed protocol"
    reports = _measured(plan, entries, options, begin(title, plan_size(plan, entries)))
    results = summarise(reports, domain.configs[0].name, parameters(folder, entries))
    # Nobody is called better by these figures.
    results = replace(results, differences=())
    write_protocol(folder, results, scenes.digests)
    return results


def compare_on_shuffled(
    domain: Domain, data: Path, folder: Path, options: Options, begin: Begin
) -> dict[str, Results]:
    """The control by task: rows that learnt from shuffled scenes, asked about the real test scenes.

    Baselines are tuned, and epochs chosen, on shuffled validation scenes. One seed of every row.
    In each task "ours" is the yardstick; it is measured whichever baselines are wanted.

    Raises:
        ConfigError: see `require_groups`.
        ValueError: see `Options.shuffled_tasks`; it is relations alone, and there are none.
    """
    require_groups(domain)
    real = _scenes(domain, data, options)
    scenes = real.shuffled(seed=0)
    tasks, names = options.shuffled_tasks(), options.chosen_baselines
    plan = _plan(folder, scenes, options, tasks, asked_by=real)
    if not plan.material.related:
        asked, tasks = tasks, tuple(task for task in tasks if task not in RELATION_TASKS)
        if not tasks:
            raise ValueError(
                f"{domain.name} has no relations to shuffle: {', '.join(asked)} would be empty"
            )
        plan = replace(plan, tasks=tasks)
    entries = [bare_machine_entry(config) for config in options.configs(domain, 0)]
    # A baseline is fitted once, whichever tasks it is asked.
    baselines: dict[str, Entry] = {}
    for task in tasks:
        yardstick, _ = YARDSTICKS[task]
        baselines |= {
            entry.name: entry
            for entry in plain_baseline_entries(0, task)
            if names is None or entry.name in (yardstick, *names)
        }
    entries += baselines.values()
    title = f"{domain.name}, shuffled"
    reports = _measured(plan, entries, options, begin(title, plan_size(plan, entries)))
    weights = parameters(folder, entries)
    results = {
        task: summarise(found, yardstick, weights)
        for task in tasks
        if _answers(found := _of_task(reports, task), yardstick := YARDSTICKS[task][0])
    }
    write_shuffled(folder, results, scenes.digests)
    return results


def require_groups(domain: Domain) -> None:
    """In tables that rank rows no group of scenes may be in two parts.

    Raises:
        ConfigError: the domain splits its scenes otherwise.
    """
    if domain.leaks:
        names = ", ".join(config.name for config in domain.configs)
        raise ConfigError(
            f'{names}: data.split = "{domain.data.split}" leaves near-duplicates of test scenes in '
            'the training part; tables and shuffled scenes need "group". --seed-protocol asks such '
            "a configuration, without tables"
        )


def _of_task(reports: Measured, task: str) -> dict[tuple[str, int], dict[str, SourceReport]]:
    return {
        row: {
            source: replace(report, outcomes={task: report.outcomes[task]})
            for source, report in by_source.items()
        }
        for row, by_source in reports.items()
    }


def _answers(reports: Measured, row: str) -> bool:
    """The row was asked anything: not every set of scenes has every question."""
    return any(
        outcome is not None
        for (name, _), by_source in reports.items()
        if name == row
        for report in by_source.values()
        for outcome in report.outcomes.values()
    )


def plan_size(plan: Plan, entries: Sequence[Entry]) -> int:
    """(row, source) pairs."""
    return len(entries) * len(plan.settings)


def _scenes(domain: Domain, data: Path, options: Options) -> SplitScenes:
    config = domain.configs[0].model_copy(update={"data": options.data(domain)})
    return prepare(config, data)


def _plan(
    folder: Path,
    scenes: SplitScenes,
    options: Options,
    tasks: tuple[str, ...],
    asked_by: SplitScenes | None = None,
) -> Plan:
    """What the rows that learn from some scenes are asked.

    Args:
        asked_by: whose training scenes say which questions are put; the same by default.
    """
    material = Material.of(scenes)
    data = material.data
    train = data.train if asked_by is None else asked_by.training_data().train
    seen = seen_triples(data.train.scenes, data.train.v.shape[1])
    limit = _QUICK_LIMIT if options.quick else options.limit
    settings = dict(settings_by_source(data.test, data.structure, train, seen, limit=limit))
    facts = EVERYDAY if facts_file() else None
    settings[POOLED] = Setting(data.test, data.structure, train, seen, limit, everyday=facts)
    return Plan(folder, material, settings, tasks)


def _measured(
    plan: Plan, entries: Sequence[Entry], options: Options, progress: Progress
) -> dict[tuple[str, int], dict[str, SourceReport]]:
    if options.fresh:
        forget(plan.folder, entries)
    open_ = [entry for entry in entries if len(plan.known(entry)) < len(plan.settings)]
    for entry in entries:
        if entry not in open_:
            plan.measure(entry, progress)
    if options.workers > 1 and open_:
        fill(plan, open_, progress, min(options.workers, len(open_)))
        open_ = []
    for entry in open_:
        plan.measure(entry, progress)
    return {(entry.name, entry.seed): plan.report(entry) for entry in entries}
