"""Measure the entries of a result table on every data source, and reuse finished reports on disk.

An entry is one model of an experiment: a machine, a baseline with tuned settings, or an untrained
reference.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
import typer
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from app.registry import RegistryError
from app.scene.spatial_relations import STACKED
from training.datasets import DatasetError
from training.datasets.batches import SceneTensors, TrainingData, subset
from training.datasets.cases import some_scenes
from training.datasets.console import console, print_marked
from training.evaluation.asking import artifact_model, ask_rows
from training.evaluation.baselines import PLACED, frequency, placed_product
from training.evaluation.generation_task import held_out_scenes, independent_scenes
from training.evaluation.outlier_tasks import intruder_weights, with_intruders
from training.evaluation.pair_task import SHIFTS, baseline_log_odds, lateral_shift, listed_pairs
from training.evaluation.parts import Ranking
from training.evaluation.report import Progress, SourceReport, digest, measure, pooled, silent
from training.evaluation.results import Reports
from training.evaluation.selection import TRIALS, Baseline
from training.evaluation.setting import Model, ObjectScore, Setting, Structure, suspicion_of
from training.evaluation.tasks import ONCE, WHOLE_SET
from training.fit.calibrate import calibrate
from training.fit.configuration import Config, ConfigError, ObjectsConfig
from training.fit.draft import placed_draft
from training.fit.objects import ObjectScenes
from training.fit.trainer import Trainer
from training.research.baselines import BASELINES
from training.runs.folder import RunError, load_run, save_run

# Weights of log popularity in the ranking of intruders: scores of baselines have different scales.
_WEIGHTS = (0.0, *np.geomspace(0.005, 2.0, TRIALS - 1).tolist())
_SCENES = 300  # maximum scenes that choose a weight or a shift


@dataclass(frozen=True, eq=False)
class Entry:
    """One model of an experiment, with one training seed."""

    name: str
    seed: int
    identity: str  # all settings that affect the results; part of the names of reports on disk
    make: Callable[[TrainingData, Path, Progress], Model]  # train it, or read it from its folder


def baseline_entries(
    seed: int,
    names: Sequence[str] | None = None,
    *,
    related: bool = True,
    learning: ObjectsConfig | None = None,
) -> Iterator[Entry]:
    """Generate the entries of the baselines in `names`; None means all baselines.

    Deterministic baselines have an entry for seed 0 only. `related=False` leaves out relation
    baselines. `learning` are settings of the machines for objects, see `object_scenes`.

    Raises:
        ValueError: a name is not in `BASELINES`.
    """
    if unknown := sorted(set(names or ()) - set(BASELINES)):
        raise ValueError(f"unknown baselines {unknown}: choose from {list(BASELINES)}")
    config = learning or ObjectsConfig()
    decisive = config.model_dump(include={"source_weights", "open_sources"})
    for name, baseline in BASELINES.items():
        is_usable = related or not baseline.answer.of_relations
        is_selected = names is None or name in names
        if is_usable and is_selected and (baseline.stochastic or seed == 0):
            make = partial(_baseline_model, baseline, seed, config)
            yield Entry(name, seed, f"{name}, seed {seed}, {decisive}, {SHIFTS}", make)


def reference_entries() -> Iterator[Entry]:
    """Generate the untrained references for the evaluation of generated scenes."""
    yield Entry("independent classes", 0, "independent classes", _independent)
    yield Entry("held-out scenes (floor)", 0, "held-out scenes (floor)", _held_out)


def _independent(data: TrainingData, *_: object) -> Model:
    return Model(generate=independent_scenes, parameters=data.train.v.shape[1])


def _held_out(*_: object) -> Model:
    return Model(generate=held_out_scenes)


def machine_entry(config: Config) -> Entry:
    """Return the entry of a machine, calibrated as for publication."""
    identity = f"{config.digest}, calibrated"
    return Entry(config.name, config.training.seed, identity, partial(_machine_model, config))


def _baseline_model(
    baseline: Baseline,
    seed: int,
    learning: ObjectsConfig,
    data: TrainingData,
    folder: Path,  # noqa: ARG001
    say: Progress,
) -> Model:
    """Fit a baseline; one for objects or rooms to `object_scenes`.

    An object baseline ranks intruders with a prior of popularity, as `/outliers` does. For T2-at
    (missing object at a place), its score is multiplied by a frequency table.
    """

    def fit(baseline: Baseline, data: TrainingData) -> Model:
        parts = data.train, data.validation, data.structure
        return baseline.fit(*parts, seed=seed, progress=say)

    if baseline.answer.of_relations:
        return with_lateral_shift(fit(baseline, data), data)
    objects = replace(data, train=object_scenes(data.train, data.structure, learning))
    model = fit(baseline, objects)
    if model.missing is None:
        return model
    model = replace(model, suspicion=tuned_suspicion(model.missing, objects, seed))
    if not data.related:
        return model
    product = fit(placed_product(baseline.name, model, fit(PLACED, data)), objects)
    return replace(model, at_place=product.at_place)


def with_lateral_shift(model: Model, data: TrainingData) -> Model:
    """Return a model of relations with the shift of left and front that a machine also gets."""
    if model.relations is None:
        return model
    scenes = some_scenes(data.validation, _SCENES, 0)
    log_odds = baseline_log_odds(scenes, model.relations)
    shift = lateral_shift(log_odds, listed_pairs(scenes, data.structure, STACKED))
    return replace(model, lateral=shift)


def object_scenes(train: SceneTensors, structure: Structure, config: ObjectsConfig) -> SceneTensors:
    """Return the scenes from which a machine learns objects, with its weights and masks."""
    learnt = ObjectScenes.of(train, structure, config)
    shows = torch.zeros_like(train.annotated_classes)
    shows[[train.source_names.index(name) for name in learnt.sources]] = learnt.shows
    weight_of = config.source_weights
    weighted = [
        replace(scene, weight=scene.weight * weight_of.get(scene.source, 1.0))
        for scene in train.scenes
    ]
    v = train.v * shows[train.source]
    kept = (v.sum(1) >= 2) & torch.tensor([scene.weight > 0 for scene in weighted])
    masked = replace(train, scenes=weighted, v=v, annotated_classes=shows)
    return subset(masked, kept)


def tuned_suspicion(score: ObjectScore, data: TrainingData, seed: int) -> ObjectScore:
    """Return the suspicion with the weight of popularity that finds most validation intruders."""
    scenes = some_scenes(subset(data.validation, data.validation.complete), _SCENES, seed)
    log_popularity = frequency(data.train.v, data.train.weight).logit()
    hits = dict.fromkeys(_WEIGHTS, 0.0)
    for weights in intruder_weights(scenes, data.train).values():
        cases = with_intruders(scenes, data.structure, weights)
        if len(cases.v):
            plain = ask_rows(suspicion_of(score), cases.v, block=32)
            for weight in _WEIGHTS:
                values = plain + weight * log_popularity
                first = Ranking.of(cases.scene, cases.intruder, values, len(scenes)).top(1)
                hits[weight] += first.value
    return suspicion_of(score, log_popularity, max(hits, key=lambda weight: hits[weight]))


def _machine_model(config: Config, data: TrainingData, folder: Path, say: Progress) -> Model:
    """Train or load a machine, and calibrate it. Its weights that are held at 0 do not count."""
    run, seed = folder / "run", config.training.seed
    try:
        machine = load_run(run).machine
    except RunError:  # no finished run

        def progress(phase: str, done: float, loss: float) -> None:
            say(f"{phase} {done:.0%}, {loss:.3f}")

        result = Trainer(config, data).run(progress)
        save_run(run, config, result)
        machine = result.machine
    draft = placed_draft(machine, data)
    say("calibrating")
    artifact = replace(draft, calibration=calibrate(draft, data, config.objects, seed))
    profiles = ObjectScenes.of(data.train, data.structure, config.objects).sources
    model = artifact_model(artifact, profiles=profiles)
    zero = sum(machine.get_parameter(name).numel() for name in config.machine.without)
    return replace(model, parameters=machine.parameter_count - zero)


# Linear algebra libraries read these variables when a process loads them.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

POOLED = "pooled"  # name of the union of all data sources


@contextmanager
def resumable() -> Iterator[None]:
    """Print expected errors; after Ctrl-C, print how to continue."""
    expected = (
        ConfigError, DatasetError, RunError, RegistryError, BrokenProcessPool, ValueError,
        FloatingPointError,
    )  # fmt: skip
    try:
        yield
    except expected as error:
        print_marked("error:", "red", str(error))
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
    plan: Plan, entries: Sequence[Entry], *, workers: int = 1, fresh: bool = False
) -> tuple[Reports, dict[str, str]]:
    """Return the reports by (name, seed), and the error messages of diverged entries by name.

    A name whose training diverges with one seed has no reports. Finished reports are read, unless
    `fresh` deletes them. `workers` processes with one thread each measure the rest; 1 means this
    process. KeyboardInterrupt stops the processes.
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
