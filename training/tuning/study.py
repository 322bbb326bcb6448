"""Trials on disk: each is run once, judged on validation scenes, and written down as it ends.

<folder>/study.json      the configuration and the scenes that all trials share
         trials.jsonl    one line a trial
         <digest>/       of a trial's configuration: its curve and reports; a checkpoint as it runs

Trials are given up by the median rule: a trial whose best epoch so far is below the median of what
earlier ones had reached by then.

Source: Golovin et al., "Google Vizier: a service for black-box optimization" (2017).
"""

from __future__ import annotations

import json
import math
import os
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from training.config import Config, with_settings
from training.curves import Epoch
from training.evaluation.contenders import Contender
from training.evaluation.intervals import Figure, Metric, paired_difference
from training.evaluation.missing import machine_score
from training.evaluation.relations import machine_score as relation_score
from training.evaluation.report import SourceReport, measure, pooled, settings_by_source
from training.trainer import Trainer, TrainingData

By: TypeAlias = Literal["mrr", "r-precision", "both"]
State: TypeAlias = Literal["finished", "pruned", "failed"]
# Called with (epochs done, what is being done).
Progress: TypeAlias = Callable[[float, str], None]
Figures: TypeAlias = Mapping[str, Mapping[str, Figure]]
Curve: TypeAlias = tuple[tuple[float, float | None], ...]

POOLED = "pooled"
FIGURES = {
    "MRR": ("T2 missing", "MRR"),
    "R-precision": ("T1a relations", "R-precision, instance counts"),
}
"""What trials are judged by: name to task and metric of the evaluation's tables."""

_BY: dict[By, tuple[str, ...]] = {
    "mrr": ("MRR",),
    "r-precision": ("R-precision",),
    "both": tuple(FIGURES),
}
# The median of fewer trials says little, and so does the first third of a run.
_RIVALS = 4
_WARM_UP = 1 / 3


class TuningError(RuntimeError):
    """A folder of another search, or scenes without what is to be maximised."""


class _GivenUp(Exception):  # noqa: N818
    """Ends a trial early; says why."""


@dataclass(frozen=True)
class Trial:
    """One point of a search.

    Attributes:
        digest: of its configuration; also the name of its folder.
        settings: what it changes.
        state: pruned and failed trials have a reason, and no figures.
        figures: by source, "pooled" among them, and name: on all validation scenes.
        curve: MRR and R-precision (None without relations) of every epoch, on the trainer's part
            of the validation scenes.
        seconds: wall time of training and judging.
        seed: of the training.
    """

    digest: str
    settings: Mapping[str, Any]
    state: State
    reason: str
    figures: Figures
    curve: Curve
    seconds: float
    seed: int

    def score(self, by: By) -> float:
        """What is maximised: a pooled figure, or the sum of both; -inf where there is none."""
        if self.state != "finished":
            return -math.inf
        return sum(f.value for name in _BY[by] if (f := self.figures[POOLED].get(name)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Trial:
        """What `asdict` made of a trial, through JSON."""
        figures = {
            source: {name: Figure(**figure) for name, figure in some.items()}
            for source, some in values["figures"].items()
        }
        curve = tuple(tuple(point) for point in values["curve"])
        return cls(**{**values, "figures": figures, "curve": curve})


class Study:
    """A search over one configuration on one set of scenes.

    Args:
        folder: of the study; made where there is none.
        config: what the trials change.
        data: the scenes; its test part is never looked at.
        scenes: digests of the sources: other scenes, other search.
        by: what is maximised.

    Attributes:
        trials: everything tried so far, in the order tried.

    Raises:
        TuningError: the folder holds a search over another configuration or other scenes, or no
            validation scene has what is to be maximised.
    """

    def __init__(
        self, folder: Path, config: Config, data: TrainingData, scenes: Mapping[str, str], by: By
    ) -> None:
        if by == "r-precision" and not any(s.evidence.holds.any() for s in data.validation.scenes):
            raise TuningError("no validation scene has relations: there is no R-precision")
        self.folder, self.config, self.data, self.by = folder, config, data, by
        _claim(folder, {"configuration": config.digest, "scenes": dict(scenes)})
        self.trials = _read(folder / "trials.jsonl")

    @property
    def best(self) -> Trial | None:
        """The first of the highest score; None where no trial has finished."""
        finished = [trial for trial in self.trials if trial.state == "finished"]
        return max(finished, key=lambda trial: trial.score(self.by), default=None)

    def known(self, settings: Mapping[str, Any]) -> Trial | None:
        """The trial of these settings, where there was one."""
        digest = with_settings(self.config, settings).digest
        return next((trial for trial in self.trials if trial.digest == digest), None)

    def run(self, settings: Mapping[str, Any], progress: Progress, *, prune: bool = True) -> Trial:
        """Run a trial, or go on with it, and write it down.

        KeyboardInterrupt passes through; the same trial then goes on from its last finished epoch.

        Args:
            prune: give it up where it is below the median of earlier trials.

        Raises:
            ConfigError: the settings do not fit the configuration.
        """
        config = with_settings(self.config, settings)
        place = self.folder / config.digest[:12]
        place.mkdir(parents=True, exist_ok=True)
        trainer = Trainer(config, self.data, place)
        trainer.resume()
        began, before = time.perf_counter(), trainer.seconds
        state: State = "finished"
        reason = ""
        figures: Figures = {}
        try:
            self._train(trainer, progress, prune)
            figures = self._judge(trainer, place, progress)
        except FloatingPointError as error:
            state, reason = "failed", str(error)
        except _GivenUp as error:
            state, reason = "pruned", str(error)
        seconds = before + time.perf_counter() - began
        trial = Trial(
            digest=config.digest,
            settings=dict(settings),
            state=state,
            reason=reason,
            figures=figures,
            curve=_curve(trainer.epochs),
            seconds=round(seconds, 2),
            seed=config.training.seed,
        )
        _append(self.folder / "trials.jsonl", trial)
        (place / "checkpoint.pt").unlink(missing_ok=True)
        self.trials.append(trial)
        return trial

    def difference(self, first: Trial, second: Trial, name: str) -> Figure | None:
        """The first minus the second in a pooled figure, paired by scenes; None where one lacks it.

        Raises:
            OSError, ValueError: the reports of the two were moved or changed.
        """
        a, b = (self._metric(trial, name) for trial in (first, second))
        return None if a is None or b is None else paired_difference(a, b)

    def _train(self, trainer: Trainer, progress: Progress, prune: bool) -> None:
        judged = 0

        def show(epoch: int, done: float, loss: float) -> None:
            nonlocal judged
            progress(epoch + done, f"loss {loss:.3f}")
            if prune and len(trainer.epochs) > judged:
                judged = len(trainer.epochs)
                self._compare(trainer)

        trainer.run(show)

    def _compare(self, trainer: Trainer) -> None:
        """Raise `_GivenUp` below the median of the trials that ran as many epochs in all."""
        epochs, planned = len(trainer.epochs), trainer.config.training.epochs
        rivals = [t for t in self.trials if t.state == "finished" and len(t.curve) == planned]
        if epochs < planned * _WARM_UP or len(rivals) < _RIVALS:
            return
        mine = _reached(_curve(trainer.epochs), self.by)
        median = statistics.median(_reached(t.curve[:epochs], self.by) for t in rivals)
        if mine < median:
            raise _GivenUp(
                f"{mine:.4f} after {epochs} epochs, where the median of {len(rivals)} trials "
                f"was {median:.4f}"
            )

    def _judge(self, trainer: Trainer, place: Path, progress: Progress) -> Figures:
        machine = trainer.machine
        contender = Contender(objects=machine_score(machine), relations=relation_score(machine))
        tasks = [task for task, _ in FIGURES.values()]
        done = float(len(trainer.epochs))
        reports = [
            measure(
                place / f"{source}.json",
                contender,
                setting,
                source,
                tasks=tasks,
                progress=lambda note: progress(done, note),
            )
            for source, setting in settings_by_source(
                self.data.validation, self.data.structure, self.data.train, seen=None
            )
        ]
        return {
            report.source: {
                name: metric.figure() for name in FIGURES if (metric := _metric(report, name))
            }
            for report in (*reports, pooled(reports, POOLED))
        }

    def _metric(self, trial: Trial, name: str) -> Metric | None:
        place = self.folder / trial.digest[:12]
        sources = [source for source in trial.figures if source != POOLED]
        texts = [(place / f"{source}.json").read_text(encoding="utf-8") for source in sources]
        reports = [SourceReport.from_dict(json.loads(text)) for text in texts]
        return _metric(pooled(reports, POOLED), name)


def _metric(report: SourceReport, name: str) -> Metric | None:
    task, metric = FIGURES[name]
    outcome = report.outcomes.get(task)
    return None if outcome is None else outcome.metrics.get(metric)


def _curve(epochs: list[Epoch]) -> Curve:
    # JSON has no nan.
    return tuple(
        (
            e.mrr_validation,
            None if math.isnan(e.r_precision_validation) else e.r_precision_validation,
        )
        for e in epochs
    )


def _reached(curve: Curve, by: By) -> float:
    """What is maximised, at its best epoch."""
    columns = [list(FIGURES).index(name) for name in _BY[by]]
    return max(sum(epoch[column] or 0.0 for column in columns) for epoch in curve)


def _claim(folder: Path, identity: dict[str, Any]) -> None:
    path = folder / "study.json"
    if path.exists():
        if json.loads(path.read_text(encoding="utf-8")) != identity:
            raise TuningError(
                f"{folder} holds a search over another configuration or other scenes; give "
                "--fresh or another folder"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(identity, indent=1), encoding="utf-8")


def _read(path: Path) -> list[Trial]:
    """The trials of a file; a last line that was cut off in the middle is removed from it."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    return [Trial.from_dict(json.loads(line)) for line in whole.splitlines()]


def _append(path: Path, trial: Trial) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(trial), allow_nan=False) + "\n")
        file.flush()
        os.fsync(file.fileno())
