"""`python -m training benchmark`: baselines and machines on the same scenes, resumed where stopped.

<folder>/<domain>/results.*                  the tables
<folder>/<domain>/seed-protocol/results.*    the seed paper's protocol
<folder>/<domain>/shuffled/<task>/results.*  rows trained on shuffled scenes, asked about real ones
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from training.baselines import BASELINES, RELATIONS
from training.batches import seen_triples
from training.config import (
    Config,
    ConfigError,
    DataConfig,
    data_folder,
    load_config,
    shipped_configs,
    with_settings,
)
from training.evaluation.everyday import EVERYDAY, facts_file
from training.evaluation.report import settings_by_source
from training.evaluation.seed_protocol import PAPER
from training.evaluation.setting import Setting
from training.evaluation.tasks import SEED_TASKS, TASKS
from training.experiments.measure import (
    POOLED,
    Plan,
    Reports,
    measure_rows,
    parameters,
    resumable,
    shown,
    slug,
)
from training.experiments.plots import write_plots
from training.experiments.results import (
    Results,
    grid,
    only,
    summarise,
    write,
)
from training.experiments.rows import (
    Material,
    Row,
    baseline_rows,
    machine_row,
    reference_rows,
)
from training.pipeline import SplitScenes, prepare

DOMAINS = ("indoor", "everyday")
"""Measured when no configuration is given."""

YARDSTICKS = {
    "T1a relations": ("relation popularity", "R-precision, distinct classes"),
    "T1 pairs": ("relation popularity", "accuracy"),
    "T2 missing": ("popularity", "MRR"),
    "T2 partial": ("popularity", "MRR, 50 %"),
    "T3 signature": ("popularity", "hit@1"),
}
"""The tasks on shuffled scenes: the row that all others must fall to, and its metric."""

_RELATION_TASKS = ("T1a relations", "T1 pairs")
# Log Z by annealing takes a while however few the scenes are.
_SLOW_TASKS = ("Density",)
# A quick run shows that everything works; its figures mean nothing.
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

console = Console()


@dataclass(frozen=True)
class Domain:
    """Configurations of one data section.

    Attributes:
        name: that of its first configuration, less its last word.
        configs: the first is compared with all other rows.
    """

    name: str
    configs: tuple[Config, ...]

    @property
    def leaks(self) -> bool:
        """Scenes of one group are in several parts: near-duplicates of test scenes are learnt."""
        return self.configs[0].data.split == "random"

    def require_groups(self) -> None:
        """In tables that rank rows no group of scenes may be in two parts.

        Raises:
            ConfigError: the domain splits its scenes otherwise.
        """
        if self.leaks:
            names = ", ".join(config.name for config in self.configs)
            raise ConfigError(
                f'{names}: data.split = "random" leaves near-duplicates of test scenes in the '
                'training part; tables and shuffled scenes need "group". --seed-protocol asks such '
                "a configuration, without tables"
            )


@dataclass(frozen=True)
class Options:
    """The command's options.

    Attributes:
        root: folder with the scene files.
        tasks: names in `TASKS`.
        seeds: training seeds of every row whose training is random.
        baselines: only these; all for None.
        limit: scenes a source where a task is slow.
        workers: processes.
        quick: few scenes, epochs and baselines.
        fresh: earlier reports are removed.
    """

    root: Path
    tasks: tuple[str, ...]
    seeds: int = 1
    baselines: tuple[str, ...] | None = None
    limit: int = 300
    workers: int = 1
    quick: bool = False
    fresh: bool = False

    def configs(self, domain: Domain, seed: int) -> list[Config]:
        """The domain's configurations as they are trained for one seed."""
        most = _QUICK_EPOCHS if self.quick else None
        return [
            with_settings(
                config,
                {
                    "training.seed": seed,
                    "training.epochs": min(config.training.epochs, most or config.training.epochs),
                },
            )
            for config in domain.configs
        ]

    def scenes(self, domain: Domain, **changes: Any) -> SplitScenes:
        """The domain's scenes."""
        data: DataConfig = domain.configs[0].data.model_copy(update=changes)
        if self.quick:
            few = min(data.limit or _QUICK_SCENES, _QUICK_SCENES)
            data = data.model_copy(update={"limit": few})
        return prepare(domain.configs[0].model_copy(update={"data": data}), self.root)


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
    seeds: Annotated[int, typer.Option(min=1, help="training seeds, where they matter")] = 3,
    baseline: Annotated[
        list[str] | None, typer.Option(help="only these baselines; none for no baseline")
    ] = None,
    task: Annotated[
        list[str] | None, typer.Option(help="only these tasks, by name or its beginning: T2, T3")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="scenes a source where a task is slow")] = 300,
    workers: Annotated[int, typer.Option(min=1, help="processes, of one thread each")] = 2,
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

    Writes results.json, results.md and plots into a folder for each domain; the seed protocol and
    the shuffled scenes have folders of their own there. Ctrl-C loses at most the task at hand; the
    same command goes on from there.
    """
    with resumable(console, ValueError, FloatingPointError):
        wanted = None if baseline is None else tuple(b for b in baseline if b != "none")
        names = machines or default_configs()
        domains = read_domains(names)
        options = Options(
            root=data_folder(names[0], domains[0].configs[0], data),
            tasks=chosen_tasks(task, quick),
            seeds=1 if quick else seeds,
            baselines=QUICK_BASELINES if quick and wanted is None else wanted,
            limit=_QUICK_LIMIT if quick else limit,
            workers=workers,
            quick=quick,
            fresh=fresh,
        )
        if shuffled:
            shuffled_tasks(options.tasks)  # a request that fails, fails before hours of training
        for domain in domains:
            if shuffled or not seed_protocol:
                domain.require_groups()
        for domain in domains:
            place = folder / domain.name
            # The seed protocol is all that may be asked of a random split.
            if not domain.leaks:
                compare_domain(domain, place, options)
            if seed_protocol:
                compare_by_seed_protocol(domain, place / "seed-protocol", options)
            if shuffled:
                compare_on_shuffled(domain, place / "shuffled", options)
            console.print(f"every figure: {place}/**/results.json; plots beside it")


def default_configs() -> list[str]:
    """The shipped configurations of `DOMAINS`, the Triway machine of each first."""
    names = [f"{domain}-{variant}" for domain in DOMAINS for variant in ("triway", "gbm", "rbm")]
    return [name for name in names if name in shipped_configs()]


def read_domains(references: Sequence[str]) -> list[Domain]:
    """The domains of some configurations, in the order in which they are first named.

    Raises:
        ConfigError: a configuration cannot be read, two have one name, or two domains would.
    """
    groups: dict[DataConfig, list[Config]] = {}
    for reference in references:
        config = load_config(reference)
        if any(config.name == other.name for group in groups.values() for other in group):
            raise ConfigError(f"two configurations are called {config.name}")
        groups.setdefault(config.data, []).append(config)
    domains: dict[str, Domain] = {}
    for configs in groups.values():
        name = configs[0].name.rpartition("-")[0] or configs[0].name
        if name in domains:
            raise ConfigError(
                f"{configs[0].name} and {domains[name].configs[0].name} have different data "
                f"sections, but would both be of the domain {name!r}: rename one"
            )
        domains[name] = Domain(name, tuple(configs))
    return list(domains.values())


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


def shuffled_tasks(tasks: Sequence[str]) -> tuple[str, ...]:
    """Those of the tasks that `YARDSTICKS` has.

    Raises:
        ValueError: there are none.
    """
    found = tuple(task for task in YARDSTICKS if task in tasks)
    if not found:
        raise ValueError(f"on shuffled scenes only {', '.join(YARDSTICKS)} are asked")
    return found


def compare_domain(domain: Domain, folder: Path, options: Options) -> Results:
    """Every row of a domain on its test scenes; writes tables and plots into the folder.

    Raises:
        ConfigError: see `Domain.require_groups`; the scenes cannot be found.
        DatasetError: they cannot be read.
        BenchmarkError: see `Plan.known`.
        ValueError: an unknown baseline.
    """
    domain.require_groups()
    scenes = options.scenes(domain)
    plan = _plan(folder, scenes, options, options.tasks)
    rows: list[Row] = []
    for seed in range(options.seeds):
        rows += [machine_row(config) for config in options.configs(domain, seed)]
        rows += baseline_rows(seed, options.baselines, related=plan.material.related)
    rows += reference_rows()
    reports = _measured(plan, rows, options, domain.name)
    results = summarise(reports, domain.configs[0].name, parameters(folder, rows))
    _write(folder, scenes, results.to_dict(), f"# {domain.name}\n\n{results.markdown()}")
    names = {config.name for config in domain.configs}
    write_plots(plan, [row for row in rows if row.name in names], reports, results)
    return results


def compare_by_seed_protocol(domain: Domain, folder: Path, options: Options) -> Results:
    """The machines of a domain, trained once on the random split, asked as the seed paper asks."""
    scenes = options.scenes(domain, split="random")
    plan = _plan(folder, scenes, options, tuple(SEED_TASKS))
    rows = [
        machine_row(with_settings(config, {"data.split": "random"}), calibrated=False)
        for config in options.configs(domain, 0)
    ]
    reports = _measured(plan, rows, options, f"{domain.name}, seed protocol")
    found = summarise(reports, domain.configs[0].name, parameters(folder, rows))
    # These figures do not rank rows.
    results = replace(found, differences=())
    _write(folder, scenes, results.to_dict() | {"paper": PAPER}, _protocol_text(results))
    return results


def compare_on_shuffled(domain: Domain, folder: Path, options: Options) -> dict[str, Results]:
    """The control by task: rows that learnt from shuffled scenes, asked about the real test scenes.

    Baselines are tuned, and epochs chosen, on shuffled validation scenes. One seed of every row.
    In each task "ours" is the yardstick; it is measured whichever baselines are wanted.

    Raises:
        ConfigError: see `Domain.require_groups`.
        ValueError: see `shuffled_tasks`; or only relations are asked, and there are none.
    """
    domain.require_groups()
    real = options.scenes(domain)
    scenes = real.shuffled(seed=0)
    asked = shuffled_tasks(options.tasks)
    plan = _plan(folder, scenes, options, asked, asked_by=real)
    if not plan.material.related:
        asked = tuple(task for task in asked if task not in _RELATION_TASKS)
        if not asked:
            raise ValueError(f"{domain.name} has no relations to shuffle")
        plan = replace(plan, tasks=asked)
    rows = [machine_row(config, calibrated=False) for config in options.configs(domain, 0)]
    # A baseline is fitted once, whichever tasks it is asked.
    names = [name for name, one in BASELINES.items() if one.scores in (("objects",), RELATIONS)]
    if options.baselines is not None:
        yardsticks = {YARDSTICKS[task][0] for task in asked}
        names = [name for name in names if name in yardsticks | set(options.baselines)]
    rows += baseline_rows(0, names, related=plan.material.related, whole=False)
    reports = _measured(plan, rows, options, f"{domain.name}, shuffled")
    weights = parameters(folder, rows)
    results = {}
    for task in asked:
        yardstick, metric = YARDSTICKS[task]
        some: Reports = {
            row: {source: only(report, {task: (metric,)}) for source, report in by_source.items()}
            for row, by_source in reports.items()
        }
        # Not every set of scenes has every question.
        if any(report.outcomes[task] for report in some[yardstick, 0].values()):
            results[task] = summarise(some, yardstick, weights)
            text = shuffled_text(task, results[task])
            _write(folder / slug(task), scenes, results[task].to_dict(), text)
    return results


def _plan(
    folder: Path,
    scenes: SplitScenes,
    options: Options,
    tasks: tuple[str, ...],
    asked_by: SplitScenes | None = None,
) -> Plan:
    """The questions to rows that learn from some scenes.

    Args:
        asked_by: whose training scenes say which questions are put; the same by default.
    """
    material = Material.of(scenes)
    data = material.data
    train = data.train if asked_by is None else asked_by.training_data().train
    seen = seen_triples(data.train.scenes, data.train.v.shape[1])
    limit = options.limit
    settings = dict(settings_by_source(data.test, data.structure, train, seen, limit=limit))
    facts = EVERYDAY if facts_file() else None
    settings[POOLED] = Setting(data.test, data.structure, train, seen, limit, everyday=facts)
    return Plan(folder, material, settings, tasks)


def _measured(plan: Plan, rows: Sequence[Row], options: Options, title: str) -> Reports:
    with shown(console, title, len(rows) * len(plan.settings)) as progress:
        reports, _ = measure_rows(
            plan, rows, progress, workers=options.workers, fresh=options.fresh
        )
    return reports


def _write(folder: Path, scenes: SplitScenes, values: dict[str, Any], text: str) -> None:
    """With sha256 of what was read, by source."""
    write(folder, {"contents": dict(scenes.digests)} | values, text)
    console.print(text, markup=False)


def _protocol_text(results: Results) -> str:
    names = list(dict.fromkeys(name for values in PAPER.values() for name in values))
    paper = grid(
        ["", *names],
        (
            [figure, *(f"{values[name]:.4f}" if name in values else "" for name in names)]
            for figure, values in PAPER.items()
        ),
    )
    return f"""# Seed protocol

One stochastic reconstruction answers, and scenes are split at random (60 / 30 / 10). These figures
are not comparable with other tables, and they leak: near-duplicates of test scenes are in the
training part; relations that are left on hold or betray the removed object; switching on more
relations can only help T1, and returning a scene as it was given scores 1/V in T3.

{results.markdown({name: task.shown for name, task in SEED_TASKS.items()})}
The paper's own figures, on its own data:

{paper}
"""


def shuffled_text(task: str, results: Results) -> str:
    """The page of one task of the control."""
    _, metric = YARDSTICKS[task]
    above = [
        f"{gap.row} by {-gap.figure.value:.3f}"
        for gap in results.differences
        if gap.source == POOLED and gap.verdict == "worse"
    ]
    return f"""# Shuffled scenes, {task}

Rows trained on scenes whose objects were permuted between scenes: each scene has as many classes as
before and each class is in as many scenes, but what stands together is chance. Test scenes are
real. Every row must fall to {results.ours}; a row above it was told something that training scenes
do not say. A star: the row in bold is better, with the whole interval.

{results.markdown({task: (metric,)})}
Above {results.ours} with the whole interval: {", ".join(above) or "no row"}.
"""
