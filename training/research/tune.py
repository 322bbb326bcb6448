"""`python -m training tune`: search for settings on validation scenes with optuna.

<folder>/<configuration>/study.log   all trials, as a journal of optuna
                         trial-<n>/  curve, reports and checkpoint of a trial
                         best.toml   the best configuration

Several processes may run the same command. They share the trials through the journal. On several
machines, --folder is on a shared file system.

A search space is a TOML file of settings with choices or intervals:

    "machine.states" = [8, 16, 32]
    "objects.weight_prior" = { low = 0.5, high = 5.0, log = true }

Source: Akiba et al., "Optuna: a next-generation hyperparameter optimization framework" (2019).
"""

from __future__ import annotations

import math
import os
import shutil
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
import typer
from pydantic import BaseModel, ValidationError
from rich.console import Console
from rich.table import Table

from training.datasets.batches import TrainingData
from training.evaluation.artifact_model import relation_score
from training.evaluation.asking import missing_score
from training.evaluation.metrics import Metric, paired_difference
from training.evaluation.model import Model
from training.evaluation.report import SourceReport, measure, pooled, settings_by_source
from training.evaluation.tasks import in_words
from training.fit.configuration import Config, ConfigError, first_error
from training.fit.draft import draft_artifact
from training.fit.trainer import Trainer
from training.machines import BoltzmannMachine
from training.research.measure import resumable
from training.runs.config_files import (
    config_toml,
    data_folder,
    load_config,
    own_or_shipped,
    read_toml,
    shortened,
    with_settings,
)
from training.runs.live import SCORES
from training.runs.pipeline import prepare

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

By: TypeAlias = Literal["mrr", "r-precision", "both"]

FIGURES = {
    "MRR": ("T2 missing", "MRR, one removed"),
    "R-precision": ("T1a relations", "R-precision, instance counts"),
}
"""Metrics that rank the trials, by short name: (task, metric) of the evaluation."""

_BY: dict[By, tuple[str, ...]] = {
    "mrr": ("MRR",),
    "r-precision": ("R-precision",),
    "both": tuple(FIGURES),
}
# Trials are comparable only with the same scenes and seed.
_FIXED = ("data.", "training.seed", "training.threads")
# Pruning needs this number of finished trials, and starts after this percentage of the first phase.
_RIVALS = 4
_WARM_UP = 33

console = Console()


class _Interval(BaseModel, extra="forbid", frozen=True, strict=True):
    low: int | float
    high: int | float
    log: bool = False


def tune(
    configuration: Annotated[str, typer.Argument(help="a TOML file, or a shipped configuration")],
    space: Annotated[
        Path | None, typer.Option(help="TOML file of the search space; by default the shipped file")
    ] = None,
    trials: Annotated[
        int, typer.Option(min=1, help="number of trials, including earlier trials")
    ] = 20,
    by: Annotated[By, typer.Option(help="metric to maximise")] = "both",
    seed: Annotated[int, typer.Option(help="seed of the sampler")] = 0,
    length: Annotated[
        float, typer.Option(min=0.001, max=1, help="share of the steps and epochs of a trial")
    ] = 1.0,
    study: Annotated[
        Path | None,
        typer.Option(help="journal of the trials, which processes share; default: in the folder"),
    ] = None,
    prune: Annotated[bool, typer.Option(help="stop trials below the median")] = True,
    data: Annotated[Path | None, typer.Option("--data", help="folder with the scene files")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="folder for the results")] = Path(
        "runs/tuning"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="delete earlier trials")] = False,
) -> None:
    """Search for better settings on validation scenes only.

    The first trial uses the unchanged configuration. Optuna chooses the settings of the other
    trials. The command writes the best configuration to FOLDER/CONFIGURATION/best.toml. After
    Ctrl-C, run the same command again: it keeps finished trials and resumes the interrupted trial.
    """
    with resumable(console):
        original = load_config(configuration)
        distributions = load_space(own_or_shipped(space, original, "spaces", "--space"), original)
        results = folder / original.name
        journal = study or results / "study.log"
        if fresh:
            shutil.rmtree(results, ignore_errors=True)
            journal.unlink(missing_ok=True)
        config = shortened(original, length)
        with console.status("reading and encoding scenes"):
            scenes = prepare(config, data_folder(configuration, config, data))
        search = Search(results, config, scenes.training_data(), distributions, by, journal)
        trial_study = search.open(scenes.digest, seed, prune=prune)
        search.run(trial_study, trials + 1, seed)
    console.print(_table(trial_study, original.name))
    if not _finished(trial_study):
        console.print("[red]error:[/red] all trials failed or were stopped early")
        raise typer.Exit(1)
    _write_best(search, trial_study, original)


def load_space(path: Path, config: Config) -> dict[str, BaseDistribution]:
    """Return the distribution of each setting in a search space.

    Raises:
        ConfigError: the file is missing or not TOML, an entry is neither a list of choices nor an
            interval, a value is invalid for its setting, or a setting cannot be searched.
    """
    values = read_toml(path)
    if not values:
        raise ConfigError(f"the search space {path.name} contains no settings")
    distributions = {}
    for name, entry in values.items():
        if name.startswith(_FIXED):
            raise ConfigError(f"{name!r} must be equal in all trials: remove it from the space")
        try:
            distributions[name] = _distribution(entry)
        except ValueError as error:
            reason = first_error(error) if isinstance(error, ValidationError) else error
            raise ConfigError(
                f"{path.name}: {name}: {reason}; write a list of choices, or "
                "{ low = ..., high = ... }"
            ) from error
        for value in entry if isinstance(entry, list) else (entry["low"], entry["high"]):
            with_settings(config, {name: value})
    return distributions


def _distribution(entry: Any) -> BaseDistribution:
    from optuna import distributions

    if isinstance(entry, list):
        return distributions.CategoricalDistribution(entry)
    bounds = _Interval.model_validate(entry)
    if not bounds.low < bounds.high:
        raise ValueError(f"low must be below high, not {bounds.low} and {bounds.high}")
    if isinstance(bounds.low, int) and isinstance(bounds.high, int):
        return distributions.IntDistribution(bounds.low, bounds.high, log=bounds.log)
    return distributions.FloatDistribution(bounds.low, bounds.high, log=bounds.log)


@dataclass(eq=False)
class Search:
    """A search for settings. Each trial trains a machine and measures it on validation scenes."""

    folder: Path
    config: Config
    data: TrainingData
    space: Mapping[str, BaseDistribution]
    by: By
    journal: Path

    def open(self, scenes: str, seed: int, *, prune: bool) -> Study:
        """Open the optuna study, or create it. A study of another search is a ConfigError."""
        import optuna
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.journal.parent.mkdir(parents=True, exist_ok=True)
        backend = JournalFileBackend(str(self.journal))
        pruners = optuna.pruners
        study = optuna.create_study(
            storage=optuna.storages.JournalStorage(backend),
            study_name=self.config.name,
            direction="maximize",
            load_if_exists=True,
            pruner=pruners.MedianPruner(_RIVALS, _WARM_UP) if prune else pruners.NopPruner(),
        )
        identity = {"config": self.config.digest, "scenes": scenes, "by": self.by}
        if study.user_attrs.setdefault("identity", identity) != identity:
            raise ConfigError(
                f"{self.journal} holds a search with another configuration, scenes or metric; use "
                "--fresh or another folder"
            )
        study.set_user_attr("identity", identity)
        return study

    def run(self, study: Study, trials: int, seed: int = 0) -> None:
        """Run trials until the study has `trials`; the first uses the unchanged settings."""
        import optuna

        self._requeue(study)
        while len(_counted_trials(study)) < trials:
            trial = study.ask()
            if sum(other.number < trial.number for other in _counted_trials(study)) >= trials:
                # Another process took the last trial in the meantime.
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
                return
            trial.set_user_attr("process", _process())
            # With one seed for all, each process would draw the same settings.
            study.sampler = optuna.samplers.TPESampler(seed=seed + trial.number)
            settings = {} if _is_original(trial) else _suggest_settings(trial, self.space)
            self._run(study, trial, settings)

    def _requeue(self, study: Study) -> None:
        """Queue the trials of ended processes again; the new trials resume from the checkpoints."""
        from optuna.trial import TrialState

        for trial in study.get_trials(states=(TrialState.RUNNING,)):
            if not _is_running(trial.user_attrs.get("process", "")):
                attributes = {"as it is": _is_original(trial), "folder": _folder(trial)}
                study.enqueue_trial(trial.params, user_attrs=attributes)
                study.tell(trial.number, state=TrialState.FAIL)

    def _run(self, study: Study, trial: Trial, settings: Mapping[str, Any]) -> None:
        """Run one trial, and store its settings, its value or the reason of its end."""
        import optuna
        from optuna.trial import TrialState

        state, reason, value = TrialState.COMPLETE, "", None
        try:
            value = self.value_of(trial, settings)
        except FloatingPointError as error:
            state, reason = TrialState.FAIL, str(error)
        except optuna.TrialPruned:
            state, reason = TrialState.PRUNED, "below the median of earlier trials"
        trial.set_user_attr("settings", settings)
        trial.set_user_attr("reason", reason)
        study.tell(trial, value, state)
        console.print(f"{shown(settings)}: {reason or value}", markup=False)

    def value_of(self, trial: Trial, settings: Mapping[str, Any]) -> float:
        """Train the machine of one trial, and return its metric on validation scenes.

        If its best score is below the median of earlier trials, optuna.TrialPruned is raised.
        """
        import optuna

        config = with_settings(self.config, settings)
        folder = self.folder / _folder(trial)
        trainer = Trainer(config, self.data, folder)
        trainer.resume()
        reported = 0
        scores: dict[str, float] = {}

        def report(*_: object) -> None:
            nonlocal reported
            for point in trainer.curve[reported:]:
                reported += 1
                scores[SCORES[point.phase]] = point.score
                values = [scores[name] for name in _BY[self.by] if name in scores]
                step = round(100 * point.done) + 100 * (point.phase == "relations")
                trial.report(float(np.nansum(values)), step)
                if trial.should_prune():
                    raise optuna.TrialPruned

        try:
            machine = trainer.run(passed=report).machine
        except (FloatingPointError, optuna.TrialPruned):
            (folder / "checkpoint.pt").unlink(missing_ok=True)
            raise
        metrics = self._measure(machine, folder)
        (folder / "checkpoint.pt").unlink(missing_ok=True)
        trial.set_user_attr("figures", {name: str(m.figure()) for name, m in metrics.items()})
        return sum(metrics[name].value for name in _BY[self.by] if name in metrics)

    def _measure(self, machine: BoltzmannMachine, folder: Path) -> dict[str, Metric]:
        data, artifact = self.data, draft_artifact(machine, self.data.vocabulary)
        relations = relation_score(artifact, given=False)
        model = Model(missing=missing_score(artifact), relations=relations)
        tasks = [task for task, _ in FIGURES.values()]
        settings = settings_by_source(data.validation, data.structure, data.train, seen=None)
        for source, setting in settings:
            measure(model, setting, source, tasks=tasks, path=folder / f"{source}.json")
        return self.metrics(folder)

    def metrics(self, folder: Path) -> dict[str, Metric]:
        """Return `FIGURES` of a finished trial in its folder, over all validation scenes."""
        sources = sorted({scene.source for scene in self.data.validation.scenes})
        report = pooled([SourceReport.read(folder / f"{source}.json") for source in sources])
        return {
            name: outcome.metrics[metric]
            for name, (task, metric) in FIGURES.items()
            if (outcome := report.outcomes.get(task))
        }


def shown(settings: Mapping[str, Any]) -> str:
    """Format the changed settings of a trial in one line."""
    parts = (
        f"{name.partition('.')[2]} {f'{value:.4g}' if isinstance(value, float) else value}"
        for name, value in settings.items()
    )
    return ", ".join(parts) or "as it is"


def _counted_trials(study: Study) -> list[FrozenTrial]:
    """Return the trials that ended by themselves or that still run."""
    return [t for t in study.trials if "settings" in t.user_attrs or t.state.name == "RUNNING"]


def _folder(trial: Trial | FrozenTrial) -> str:
    """Return the name of a trial's folder, which it keeps if it is queued again."""
    return str(trial.user_attrs.get("folder", f"trial-{trial.number}"))


def _is_original(trial: Trial | FrozenTrial) -> bool:
    """Return whether a trial uses the unchanged configuration."""
    return bool(trial.user_attrs.get("as it is", trial.number == 0))


def _process() -> str:
    return f"{socket.gethostname()} {os.getpid()}"


def _is_running(process: str) -> bool:
    """Return whether another process runs; those of other machines count as running."""
    host, _, number = process.partition(" ")
    if host != socket.gethostname():
        return True
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return False
    return process != _process()


def _finished(study: Study) -> list[FrozenTrial]:
    return [trial for trial in study.trials if trial.state.name == "COMPLETE"]


def _suggest_settings(trial: Trial, space: Mapping[str, BaseDistribution]) -> dict[str, Any]:
    from optuna.distributions import FloatDistribution, IntDistribution

    for name, entry in space.items():
        if isinstance(entry, IntDistribution):
            trial.suggest_int(name, entry.low, entry.high, log=entry.log)
        elif isinstance(entry, FloatDistribution):
            trial.suggest_float(name, entry.low, entry.high, log=entry.log)
        else:
            trial.suggest_categorical(name, entry.choices)  # type: ignore[attr-defined]
    return trial.params


def _table(study: Study, title: str) -> Table:
    """Return a table of the trials from best to worst. Trials without a metric come last."""
    headings = (f"{in_words(task)}, {name}" for name, (task, _) in FIGURES.items())
    table = Table(*headings, "state", "settings", title=title)
    trials = [trial for trial in study.trials if "settings" in trial.user_attrs]
    for trial in sorted(trials, key=lambda t: math.inf if t.value is None else -t.value):
        attributes = trial.user_attrs
        figures = (attributes.get("figures", {}).get(name, "") for name in FIGURES)
        state = ": ".join(filter(None, (trial.state.name.lower(), attributes.get("reason"))))
        table.add_row(*figures, state, shown(attributes["settings"]))
    return table


def _write_best(search: Search, study: Study, original: Config) -> None:
    """Write the best configuration to best.toml, with the original number of steps."""
    best = study.best_trial
    first = next((t for t in _finished(study) if not t.user_attrs["settings"]), None)
    settings = best.user_attrs["settings"]
    tuned = with_settings(original, settings).model_copy(update={"name": f"{original.name}-tuned"})
    figures = ", ".join(f"{name} {text}" for name, text in best.user_attrs["figures"].items())
    comment = [
        f"{original.name}, {shown(settings)}.",
        f"Metrics on validation scenes, {search.config.objects.steps} steps: {figures}.",
    ]
    if settings and first is not None:
        ours, theirs = (search.metrics(search.folder / _folder(trial)) for trial in (best, first))
        differences = (f"{name} {paired_difference(ours[name], theirs[name])}" for name in ours)
        comment.append(f"Paired difference from {original.name}: {', '.join(differences)}.")
        comment.append(
            f"The figures of the best of {len(study.trials)} trials are optimistic: train both "
            "configurations with several seeds."
        )
    path = search.folder / "best.toml"
    text = "".join(f"# {line}\n" for line in comment) + "\n" + config_toml(tuned)
    path.write_text(text, encoding="utf-8")
    console.print("\n".join(comment), markup=False)
    console.print(f"best configuration: {path}")
