"""Means over training seeds with intervals over scenes, and paired differences to one row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from training.benchmark.remarks import Asked, remarks
from training.evaluation.answers import QUESTIONS
from training.evaluation.asking import SENSITIVITIES
from training.evaluation.everyday import LINES
from training.evaluation.evidence import KINDS
from training.evaluation.intervals import Figure, Floats, Metric, paired_difference
from training.evaluation.partial import SHARES
from training.evaluation.report import SourceReport

Reports = Mapping[tuple[str, int], Mapping[str, SourceReport]]

PRIMARY: dict[str, tuple[str, ...]] = {
    "T1a relations": ("R-precision, distinct classes", "R-precision, instance counts"),
    "T1 pairs": ("accuracy", "log-loss", "accuracy, unseen pairs", "accuracy, rare classes"),
    "T1 with evidence": tuple(f"change of R-precision, {kind}" for kind in KINDS[:2]),
    "T1b completion": ("R-precision",),
    "T2 missing": ("MRR", "top-1", "top-10"),
    "T2 missing, room type given": ("MRR", "MRR, room type withheld"),
    "T2 partial": (
        *(f"MRR, {share}" for share in SHARES),
        "precision@5, 50 %",
        "change of MRR, 50 %",
    ),
    "T2 with evidence": tuple(f"change of MRR, {kind}" for kind in KINDS),
    "T2-at missing at a place": ("MRR", "MRR, on-top"),
    "T3 outliers, uniform": ("hit@1", "AUROC", "alarms in untouched scenes", "intruders caught"),
    "T3 outliers, by popularity": ("hit@1",),
    "T3 outliers, same room type": ("hit@1",),
    "T3 signature": (
        "hit@1",
        "hit@1, log-odds alone",
        *(f"caught, {name}" for name in SENSITIVITIES),
    ),
    "T3 sensitivity": tuple(
        f"{figure}, {name}"
        for name in SENSITIVITIES
        for figure in ("alarms", "caught, uniform", "caught, by popularity")
    ),
    "T3 with evidence": tuple(f"change of hit@1, {kind}" for kind in KINDS),
    "T3b placement": ("hit@1",),
    "T4 generate": (
        "MMD², free",
        "MMD², given room types",
        "pair correlation, free",
        "marginal error, free",
        "copies of training scenes, free",
        "mirrored relations, free",
        "on-top cycles, free",
    ),
    "Density": ("gain over independent classes, upper log Z",),
    "Calibration": tuple(
        f"{figure}, {question}" for figure in ("ECE", "Brier skill") for question in QUESTIONS
    ),
    "Everyday": LINES,
}
"""What the Markdown tables show; the JSON holds every metric."""

SEED_PRIMARY: dict[str, tuple[str, ...]] = {
    "Seed T1": (
        "labelled relations switched on",
        "relations switched on per scene",
        "labelled relations per scene",
    ),
    "Seed T2": (
        "removed objects switched on, relations left on",
        "removed objects switched on, relations deleted",
    ),
    "Seed T3": ("error measure", "error measure, doing nothing"),
}
"""The same of the seed protocol."""

UNLISTED = "An unlisted relation counts as wrong"
"""What a precision of relations means: annotators list a part of what holds."""

_RELATION_TASKS = ("T1a", "T1b", "T1 with")

_LOWER_IS_BETTER = (
    "MMD²",
    "marginal error",
    "copies",
    "mirrored",
    "on-top cycles",
    "alarms",
    "ECE",
    "error",
    "log-loss",
    "outliers: plain scenes with an alarm",
    "generate: the scene has what never belongs",
    "generate: scenes of fewer",
)


class MeanOverSeeds(Metric):
    """The mean of one metric over training seeds, on the same resampled scenes for all."""

    def __init__(self, members: Sequence[Metric]) -> None:
        if not members:
            raise ValueError("a mean over seeds needs at least one metric")
        if len({member.scenes for member in members}) > 1:
            raise ValueError("the seeds were measured on different numbers of scenes")
        self.members = tuple(members)

    @property
    def scenes(self) -> int:
        """Scenes of each member."""
        return self.members[0].scenes

    @property
    def n(self) -> int:
        """Scored items of each member."""
        return self.members[0].n

    @property
    def value(self) -> float:
        """The mean."""
        return float(np.mean([member.value for member in self.members]))

    def resampled(self, resamples: int, seed: int) -> Floats:
        """The mean in each resample, (resamples,)."""
        draws = [member.draws(resamples, seed) for member in self.members]
        shortest = min(len(draw) for draw in draws)
        mean: Floats = np.mean([draw[:shortest] for draw in draws], axis=0)
        return mean


@dataclass(frozen=True)
class Cell:
    """One figure of the tables.

    Attributes:
        row, task, source, metric: where it stands.
        figure: mean over seeds, with the interval over scenes.
        seeds: the value of each seed.
    """

    row: str
    task: str
    source: str
    metric: str
    figure: Figure
    seeds: tuple[float, ...]


@dataclass(frozen=True)
class Difference:
    """Ours minus another row, with the paired interval over scenes."""

    row: str
    task: str
    source: str
    metric: str
    figure: Figure


@dataclass(frozen=True)
class Results:
    """Everything a benchmark found.

    Attributes:
        ours: the row that the others are compared with.
        cells, differences: in the order of rows, sources and tasks.
        parameters: trained weights by row, where a number says something.
        asked: what each task was asked, of every row and seed that took part.
    """

    ours: str
    cells: tuple[Cell, ...]
    differences: tuple[Difference, ...]
    parameters: Mapping[str, int] = field(default_factory=dict)
    asked: tuple[Asked, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "ours": self.ours,
            "parameters": dict(self.parameters),
            "cells": [asdict(cell) for cell in self.cells],
            "differences": [asdict(difference) for difference in self.differences],
            "asked": [asdict(asked) for asked in self.asked],
        }

    def markdown(self, primary: Mapping[str, tuple[str, ...]] = PRIMARY) -> str:
        """One table for each primary metric, rows by sources; below them what was left out.

        A star marks a row that ours is better than: the whole paired interval is on its side.
        """
        parts: list[str] = []
        for task, metrics in primary.items():
            tables = [table for metric in metrics if (table := self._table(task, metric))]
            if tables:
                asked = [asked for asked in self.asked if asked.task == task]
                parts += [*tables, *remarks(asked)]
        return "\n\n".join(parts) + "\n"

    def _table(self, task: str, metric: str) -> str:
        cells = [cell for cell in self.cells if (cell.task, cell.metric) == (task, metric)]
        if not cells:
            return ""
        sources = list(dict.fromkeys(cell.source for cell in cells))
        better = {
            (d.row, d.source)
            for d in self.differences
            if (d.task, d.metric) == (task, metric) and is_better(metric, d.figure)
        }
        values = {(cell.row, cell.source): cell.figure for cell in cells}
        lines = [
            f"### {task}: {metric}",
            "",
            *([f"{UNLISTED}.", ""] if task.startswith(_RELATION_TASKS) else []),
            "| | weights | " + " | ".join(sources) + " |",
            "|---" * (len(sources) + 2) + "|",
        ]
        for row in dict.fromkeys(cell.row for cell in cells):
            shown = [
                f"{values[row, source]}{' *' if (row, source) in better else ''}"
                if (row, source) in values
                else ""
                for source in sources
            ]
            name = f"**{row}**" if row == self.ours else row
            weights = f"{self.parameters[row]:,}" if row in self.parameters else ""
            lines.append(f"| {name} | {weights} | " + " | ".join(shown) + " |")
        return "\n".join(lines)


def is_better(metric: str, difference: Figure) -> bool:
    """The whole interval of a paired difference is on the good side of zero."""
    if metric.startswith(_LOWER_IS_BETTER):
        return difference.high < 0
    return difference.above_zero


def summarise(reports: Reports, ours: str, parameters: Mapping[str, int] | None = None) -> Results:
    """The figures of every row, and how far ours stands from each.

    Raises:
        ValueError: no report of `ours`.
    """
    means = {
        (row, source, task, name): MeanOverSeeds(metrics)
        for row in dict.fromkeys(name for name, _ in reports)
        for source, task, name, metrics in _by_metric(reports, row)
    }
    if not any(key[0] == ours for key in means):
        raise ValueError(f"there is no report of {ours}")
    cells = tuple(
        Cell(row, task, source, name, mean.figure(), tuple(m.value for m in mean.members))
        for (row, source, task, name), mean in means.items()
    )
    differences = tuple(
        Difference(row, task, source, name, paired_difference(mine, mean))
        for (row, source, task, name), mean in means.items()
        if row != ours and (mine := means.get((ours, source, task, name))) is not None
    )
    return Results(ours, cells, differences, parameters or {}, tuple(_asked(reports)))


def _asked(reports: Reports) -> Iterator[Asked]:
    for (row, seed), by_source in reports.items():
        for source, report in by_source.items():
            for task, outcome in report.outcomes.items():
                if outcome is not None:
                    counts = outcome.scenes, outcome.skipped
                    yield Asked(row, seed, task, source, *counts, outcome.notes)


def _by_metric(reports: Reports, row: str) -> Iterator[tuple[str, str, str, list[Metric]]]:
    """(source, task, metric name, one metric a seed) of a row.

    A metric that is pooled from fewer sources for one seed than for another is left out: a source
    has no skill where all of its asked relations hold.
    """
    found: dict[tuple[str, str, str], list[Metric]] = {}
    for (name, _), by_source in reports.items():
        if name != row:
            continue
        for source, report in by_source.items():
            for task, outcome in report.outcomes.items():
                for metric, value in (outcome.metrics if outcome else {}).items():
                    found.setdefault((source, task, metric), []).append(value)
    for (source, task, metric), values in found.items():
        if len({value.scenes for value in values}) == 1:
            yield source, task, metric, values
