"""Results of an experiment: means over training seeds, paired differences, JSON and Markdown.

A row of a result table is a model: a machine, a baseline or a reference.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from training.evaluation.metrics import Figure, Metric, mean_over_seeds, paired_difference
from training.evaluation.report import SourceReport, write_whole
from training.evaluation.tasks import TASKS, in_words

Reports = Mapping[tuple[str, int], Mapping[str, SourceReport]]
Shown = Mapping[str, tuple[str, ...]]

SHOWN: Shown = {name: task.shown for name, task in TASKS.items()}
"""Names of the metrics in tables, by task."""

# Annotators list only a part of the relations that hold.
UNLISTED = "An unlisted relation counts as wrong"

_RELATION_TASKS = ("T1a", "T1b", "T1 with")

_LOWER_IS_BETTER = (
    "MMD²",
    "marginal error",
    "copies",
    "mirrored",
    "on-top cycles",
    "alarms",
    "change of p",
    "ECE",
    "error",
    "log-loss",
    "outliers: plain scenes with an alarm",
    "generate: the scene has what never belongs",
    "generate: scenes of fewer",
)


@dataclass(frozen=True)
class Cell:
    """One metric of one row on one data source: its mean over training seeds, and their values."""

    row: str
    task: str
    source: str
    metric: str
    figure: Figure
    seeds: tuple[float, ...]


@dataclass(frozen=True)
class Difference:
    """Difference in one metric: the reference row minus another row, with its paired interval."""

    row: str
    task: str
    source: str
    metric: str
    figure: Figure

    @property
    def verdict(self) -> str:
        """`better` or `worse` than the other row, or `undecided` if the interval contains zero."""
        low, high = self.figure.low, self.figure.high
        if self.metric.startswith(_LOWER_IS_BETTER):
            low, high = -high, -low
        return "better" if low > 0 else "worse" if high < 0 else "undecided"


@dataclass(frozen=True)
class Asked:
    """Number of scenes of one task, for one row, training seed and data source."""

    row: str
    seed: int
    task: str
    source: str
    scenes: int
    skipped: int
    notes: Mapping[str, float]


@dataclass(frozen=True)
class Results:
    """The results of an experiment, sorted by row, data source and task.

    Attributes:
        ours: name of the reference row of all comparisons.
        differences: paired differences from the reference row.
        parameters: number of trained weights by row name, for rows with weights.
        asked: number of scenes of each task.
    """

    ours: str
    cells: tuple[Cell, ...]
    differences: tuple[Difference, ...]
    parameters: Mapping[str, int] = field(default_factory=dict)
    asked: tuple[Asked, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-serialisable dictionary."""
        return {
            "ours": self.ours,
            "parameters": dict(self.parameters),
            "cells": [asdict(cell) for cell in self.cells],
            "differences": [asdict(row) | {"verdict": row.verdict} for row in self.differences],
            "asked": [asdict(entry) for entry in self.asked],
        }

    def markdown(self, shown: Shown = SHOWN, *, changes: bool = False) -> str:
        """Return one Markdown table per metric, and remarks on each task.

        A star marks a row that is worse than the reference row: the whole interval of the paired
        difference agrees. With `changes`, the intervals are those of the differences, the row minus
        the reference row.
        """
        parts: list[str] = []
        for task, metrics in shown.items():
            tables = [table for name in metrics if (table := self._table(task, name, changes))]
            if tables:
                parts += [*tables, *remarks([entry for entry in self.asked if entry.task == task])]
        return "\n\n".join(parts) + "\n"

    def tables(self, shown: Shown = SHOWN) -> Iterator[Table]:
        """Generate one table per task for the terminal, of the pooled sources if there are any."""
        sources = list(dict.fromkeys(cell.source for cell in self.cells))
        columns = [source for source in sources if "pooled" in source] or sources
        for task, metrics in shown.items():
            table = Table("metric, model", *columns, title=in_words(task), box=box.SIMPLE_HEAD)
            for metric in metrics:
                texts = self._texts(task, metric)
                rows = {row: cells for row, cells in texts.items() if cells.keys() & set(columns)}
                if rows:
                    table.add_row(f"[bold]{metric}[/bold]")
                for row, cells in rows.items():
                    table.add_row(f"  {row}", *(cells.get(source, "") for source in columns))
            if table.row_count:
                yield table

    def _texts(self, task: str, metric: str, changes: bool = False) -> dict[str, dict[str, str]]:
        """Return the cells of a metric as texts, by row and data source."""
        differences = {
            (difference.row, difference.source): difference
            for difference in self.differences
            if (difference.task, difference.metric) == (task, metric)
        }
        texts: dict[str, dict[str, str]] = {}
        for cell in self.cells:
            if (cell.task, cell.metric) == (task, metric):
                difference = differences.get((cell.row, cell.source))
                texts.setdefault(cell.row, {})[cell.source] = _text(cell, difference, changes)
        return texts

    def _table(self, task: str, metric: str, changes: bool) -> str:
        texts = self._texts(task, metric, changes)
        if not texts:
            return ""
        sources = list(dict.fromkeys(source for cells in texts.values() for source in cells))
        lines = []
        for row, cells in texts.items():
            name = f"**{row}**" if row == self.ours else row
            weights = f"{self.parameters[row]:,}" if row in self.parameters else ""
            lines.append([name, weights, *(cells.get(source, "") for source in sources)])
        parts = [f"### {task}: {metric}"]
        if task.startswith(_RELATION_TASKS):
            parts.append(f"{UNLISTED}.")
        if changes:
            parts.append(f"In brackets: paired 95 % interval of the row minus {self.ours}.")
        return "\n\n".join([*parts, grid(["", "weights", *sources], lines)])


def _text(cell: Cell, difference: Difference | None, changes: bool) -> str:
    if changes and difference is not None:
        # 0.0 - x avoids the text "-0.000".
        low, high = (0.0 - round(x, 3) for x in (difference.figure.high, difference.figure.low))
        return f"{cell.figure.value:.3f} ({low:+.3f}, {high:+.3f})"
    if changes:
        return f"{cell.figure.value:.3f}"
    is_worse = difference is not None and difference.verdict == "better"
    return f"{cell.figure} *" if is_worse else str(cell.figure)


def grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def write(folder: Path, values: Mapping[str, Any], text: str) -> None:
    """Write `values` into results.json and `text` into results.md. Replace each file atomically."""
    write_whole(folder / "results.md", text)
    write_whole(folder / "results.json", json.dumps(values, indent=1) + "\n")


def summarise(reports: Reports, ours: str, parameters: Mapping[str, int] | None = None) -> Results:
    """Compute the metrics of every row, and the paired differences from the reference row.

    Metrics over the scenes of a single group are left out, because they have no interval.

    Raises:
        ValueError: the reports lack the reference row.
    """
    members: dict[tuple[str, str, str, str], list[Metric]] = {}
    asked: list[Asked] = []
    for (row, seed), by_source in reports.items():
        for source, report in by_source.items():
            for task, outcome in report.outcomes.items():
                if outcome is None:
                    continue
                counts = outcome.scenes, outcome.skipped
                asked.append(Asked(row, seed, task, source, *counts, outcome.notes))
                for name, metric in outcome.metrics.items():
                    members.setdefault((row, source, task, name), []).append(metric)
    rows = [row for row, _ in reports]
    # A pooled metric is left out if its data sources differ between seeds. For example, the Brier
    # skill of a seed is undefined on a source where all queried relations hold.
    means = {
        key: mean_over_seeds(metrics)
        for key, metrics in sorted(members.items(), key=lambda item: rows.index(item[0][0]))
        if len(metrics[0].groups) > 1 and all(_same_groups(m, metrics[0]) for m in metrics)
    }
    if not any(key[0] == ours for key in means):
        raise ValueError(f"the reports contain no metric of the reference row {ours}")
    cells = tuple(
        Cell(row, task, source, name, mean.figure(), tuple(m.value for m in members[key]))
        for key, mean in means.items()
        for row, source, task, name in [key]
    )
    differences = tuple(
        Difference(*(row, task, source, name), paired_difference(mine, mean))
        for (row, source, task, name), mean in means.items()
        if row != ours
        and (mine := means.get((ours, source, task, name))) is not None
        # A row may lack a pooled metric on some data sources. Its scenes then cannot be paired.
        and _same_groups(mine, mean)
    )
    return Results(ours, cells, differences, parameters or {}, tuple(asked))


def _same_groups(a: Metric, b: Metric) -> bool:
    return np.array_equal(a.groups, b.groups)


def only(report: SourceReport, wanted: Mapping[str, Sequence[str]]) -> SourceReport:
    """Return the report with only the wanted metrics, because resampling all metrics is slow."""
    outcomes = {
        task: outcome
        and replace(
            outcome,
            metrics={name: outcome.metrics[name] for name in names if name in outcome.metrics},
        )
        for task, names in wanted.items()
        if task in report.outcomes
        for outcome in [report.outcomes[task]]
    }
    return replace(report, outcomes=outcomes)


def remarks(asked: Sequence[Asked]) -> list[str]:
    """Return remarks on one task: the number of skipped scenes, and a table of the notes."""
    skipped = []
    for source in dict.fromkeys(entry.source for entry in asked):
        entries = [entry for entry in asked if entry.source == source]
        if any(entry.skipped for entry in entries):
            count, scenes = (_range(getattr(e, x) for e in entries) for x in ("skipped", "scenes"))
            skipped.append(f"{source} {count} of {scenes}")
    parts = [f"Scenes that could not be scored: {', '.join(skipped)}."] if skipped else []
    with_notes = [entry for entry in asked if entry.notes]
    return [*parts, _notes(with_notes)] if with_notes else parts


def _range(counts: Iterable[int]) -> str:
    """Format one count if all rows have the same count, else the range of the counts."""
    low, *others = sorted(set(counts))
    return f"{low:,}–{others[-1]:,}" if others else f"{low:,}"


def _notes(asked: Sequence[Asked]) -> str:
    """Return a table of notes, with one line per source or row if the others have equal notes."""
    notes: dict[str, Mapping[str, float]] = {}
    for key_format in (
        "{0.source}",
        "{0.row}, seed {0.seed}",
        "{0.row}, seed {0.seed}, {0.source}",
    ):
        notes = {key_format.format(entry): entry.notes for entry in asked}
        if all(notes[key_format.format(entry)] == entry.notes for entry in asked):
            break
    names = list(dict.fromkeys(name for values in notes.values() for name in values))
    rows = (
        [key, *(_number(values[name]) if name in values else "" for name in names)]
        for key, values in notes.items()
    )
    return grid(["", *names], rows)


def _number(value: float) -> str:
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.3f}"
