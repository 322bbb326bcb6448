"""`python -m training tune`: search for settings on validation scenes with optuna.

<folder>/<configuration>/<digest>/  curve and report of the settings of a trial
                         best.toml  the best configuration

The same seed draws the same settings. So the same command repeats its trials from these folders.

A search space is a TOML file of settings with choices or intervals:

    "machine.states" = [8, 16, 32]
    "objects.weight_prior" = { low = 0.5, high = 5.0, log = true }

Source: Akiba et al., "Optuna: a next-generation hyperparameter optimization framework" (2019).
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from pydantic import BaseModel, ValidationError

from training.datasets.batches import TrainingData
from training.datasets.console import console
from training.datasets.files import write_whole
from training.evaluation.asking import score_missing, score_relations
from training.evaluation.metrics import Metric, paired_difference
from training.evaluation.report import SourceReport, measure, pooled
from training.evaluation.setting import Model, Setting
from training.fit.configuration import Config, ConfigError, first_error
from training.fit.draft import draft_artifact
from training.fit.trainer import SCORES, CurvePoint, Trainer
from training.research.benchmark import Data, Folder
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
from training.runs.pipeline import prepare

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.distributions import BaseDistribution

FIGURES = {
    "MRR": ("T2 missing", "MRR, one removed"),
    "R-precision": ("T1a relations", "R-precision, instance counts"),
}
"""Metrics whose sum ranks the trials, by short name: (task, metric) of the evaluation."""

# Trials are comparable only with the same scenes and seed.
_FIXED = ("data.", "training.seed", "training.threads")
_RIVALS = 4  # finished trials before pruning starts
_WARM_UP = 33  # percentage of the first phase before pruning starts


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
    seed: Annotated[int, typer.Option(help="seed of the sampler")] = 0,
    length: Annotated[
        float, typer.Option(min=0.001, max=1, help="share of the steps and epochs of a trial")
    ] = 1.0,
    data: Data = None,
    folder: Folder = Path("runs/tuning"),
    fresh: Annotated[bool, typer.Option("--fresh", help="delete earlier trials")] = False,
) -> None:
    """Search for better settings on validation scenes only.

    The command first trains the unchanged configuration. Optuna chooses the settings of the trials,
    and stops trials below the median. The command writes the best configuration to
    FOLDER/CONFIGURATION/best.toml. After Ctrl-C, run the same command again: it keeps finished
    trials.
    """
    with resumable():
        original = load_config(configuration)
        distributions = load_space(own_or_shipped(space, original, "spaces", "--space"), original)
        results = folder / original.name
        if fresh:
            shutil.rmtree(results, ignore_errors=True)
        config = shortened(original, length)
        with console.status("reading and encoding scenes"):
            scenes = prepare(config, data_folder(configuration, config, data))
        search = Search(results, config, scenes.training_data(), distributions)
        unchanged = search.metrics_of({})
        study = search.run(trials, seed)
    _write_best(search, study, original, unchanged)


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
    """Return the distribution of a list of choices or of an interval."""
    from optuna import distributions

    if isinstance(entry, list):
        return distributions.CategoricalDistribution(entry)
    bounds = _Interval.model_validate(entry)
    if not bounds.low < bounds.high:
        raise ValueError(f"low must be below high, not {bounds.low} and {bounds.high}")
    if isinstance(bounds.low, int) and isinstance(bounds.high, int):
        return distributions.IntDistribution(bounds.low, bounds.high, log=bounds.log)
    return distributions.FloatDistribution(bounds.low, bounds.high, log=bounds.log)


@dataclass(frozen=True, eq=False)
class Search:
    """A search for settings. Each trial trains a machine and measures it on validation scenes."""

    folder: Path
    config: Config
    data: TrainingData
    space: Mapping[str, BaseDistribution]

    def run(self, trials: int, seed: int) -> Study:
        """Run trials, and return the study. A finished trial is read from its folder."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(
            direction="maximize",
            sampler=optuna.samplers.TPESampler(seed=seed),
            pruner=optuna.pruners.MedianPruner(_RIVALS, _WARM_UP),
        )
        for _ in range(trials):
            trial = study.ask(dict(self.space))
            try:
                study.tell(trial, self.value_of(trial))
            except optuna.TrialPruned:
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        return study

    def value_of(self, trial: Trial) -> float:
        """Train the machine of one trial, and return its metric on validation scenes.

        If the training diverges, or if its best score is below the median of earlier trials,
        optuna.TrialPruned is raised.
        """
        import optuna

        scores: dict[str, float] = {}

        def report(point: CurvePoint) -> None:
            """Report the sum of the last scores to optuna, at a step from 0 to 200."""
            scores[SCORES[point.phase]] = point.score
            step = round(100 * point.done) + 100 * (point.phase == "relations")
            trial.report(float(np.nansum(list(scores.values()))), step)
            if trial.should_prune():
                raise optuna.TrialPruned("below the median of earlier trials")

        try:
            metrics = self.metrics_of(trial.params, report)
        except (FloatingPointError, optuna.TrialPruned) as error:
            console.print(f"{shown(trial.params)}: {error}")
            raise optuna.TrialPruned from error
        figures = ", ".join(f"{name} {metric.figure()}" for name, metric in metrics.items())
        console.print(f"{shown(trial.params)}: {figures}")
        return sum(metric.value for metric in metrics.values())

    def metrics_of(
        self, settings: Mapping[str, Any], passed: Callable[[CurvePoint], None] = lambda _: None
    ) -> dict[str, Metric]:
        """Return `FIGURES` of a machine with changed settings, over all validation scenes.

        A machine without a finished report is trained. `passed` gets the points of its curve.

        Raises:
            FloatingPointError: the training diverged.
        """
        config = with_settings(self.config, settings)
        digest = sha256(f"{config.digest} {self.data.digest}".encode()).hexdigest()
        folder = self.folder / digest[:12]
        curve, path = folder / "curve.json", folder / "report.json"
        if path.exists():
            for values in json.loads(curve.read_text(encoding="utf-8")):
                passed(CurvePoint(**values))
        else:
            result = Trainer(config, self.data).run(passed=passed)
            write_whole(curve, json.dumps([asdict(point) for point in result.curve]))
            artifact = draft_artifact(result.machine, self.data.vocabulary)
            relations = partial(score_relations, artifact, given=False)
            model = Model(missing=partial(score_missing, artifact), relations=relations)
            every = Setting(self.data.validation, self.data.structure, self.data.train)
            tasks = [task for task, _ in FIGURES.values()]
            reports = [measure(model, s, name, tasks=tasks) for name, s in every.by_source()]
            pooled(reports).write(path)
        report = SourceReport.read(path)
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


def _write_best(
    search: Search, study: Study, original: Config, unchanged: Mapping[str, Metric]
) -> None:
    """Write the best configuration to best.toml, with the original number of steps."""
    settings, best = dict[str, Any](), unchanged
    values = [trial.value for trial in study.trials if trial.value is not None]
    if max(values, default=-math.inf) > sum(metric.value for metric in unchanged.values()):
        settings, best = study.best_params, search.metrics_of(study.best_params)
    figures = ", ".join(f"{name} {metric.figure()}" for name, metric in best.items())
    differences = (f"{name} {paired_difference(best[name], unchanged[name])}" for name in best)
    comment = [
        f"{original.name}, {shown(settings)}.",
        f"Metrics on validation scenes, {search.config.objects.steps} steps: {figures}.",
        f"Paired difference from {original.name}, optimistic: {', '.join(differences)}.",
    ]
    tuned = with_settings(original, settings).model_copy(update={"name": f"{original.name}-tuned"})
    path = search.folder / "best.toml"
    text = "".join(f"# {line}\n" for line in comment) + "\n" + config_toml(tuned)
    path.write_text(text, encoding="utf-8")
    console.print("\n".join(comment))
    console.print(f"best configuration: {path}")
