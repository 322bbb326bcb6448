"""Results of an experiment: means over training seeds, paired differences, JSON and Markdown.

A row of a result table is a model: a machine, a baseline or a reference.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from training.evaluation.metrics import Figure, Metric, Resampled, paired_difference
from training.evaluation.report import SourceReport
from training.evaluation.setting import Outcome
from training.evaluation.tasks import TASKS

Reports = Mapping[tuple[str, int], Mapping[str, SourceReport]]
Shown = Mapping[str, tuple[str, ...]]

SHOWN: Shown = {name: task.shown for name, task in TASKS.items()}
"""Names of the metrics in tables, by task."""

_RELATION_TASKS = ("T1a", "T1b", "T1 with")

_LOWER_IS_BETTER = (  # starts of names of metrics
    *("MMD²", "marginal error", "copies", "mirrored", "on-top cycles", "alarms", "ECE", "error"),
    *("log-loss", "outliers: plain scenes with an alarm"),
    *("generate: the scene has what never belongs", "generate: scenes of fewer"),
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
class Results:
    """The results of an experiment, sorted by row, data source and task."""

    ours: str  # reference row of all comparisons
    cells: tuple[Cell, ...]
    differences: tuple[Difference, ...]  # from the reference row
    parameters: Mapping[str, int] = field(default_factory=dict)  # number of trained weights by row
    asked: tuple[dict[str, Any], ...] = ()  # scenes, skipped, notes by row, seed, source and task

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-serialisable dictionary."""
        differences = [asdict(row) | {"verdict": row.verdict} for row in self.differences]
        return asdict(self) | {"differences": differences}

    def markdown(self, shown: Shown = SHOWN) -> str:
        """Return one Markdown table per metric, and the number of skipped scenes of each task.

        A star marks a row that is worse than the reference row: the whole interval of the paired
        difference agrees.
        """
        parts: list[str] = []
        for task, metrics in shown.items():
            tables = [table for name in metrics if (table := self._table(task, name))]
            if tables:
                parts += [*tables, *self._skipped(task)]
        return "\n\n".join(parts) + "\n"

    def _table(self, task: str, metric: str) -> str:
        """Return the Markdown table of a metric by row and data source, or "" without values."""
        worse = {
            (difference.row, difference.source)
            for difference in self.differences
            if (difference.task, difference.metric, difference.verdict) == (task, metric, "better")
        }
        texts: dict[str, dict[str, str]] = {}
        for cell in self.cells:
            if (cell.task, cell.metric) == (task, metric):
                star = " *" if (cell.row, cell.source) in worse else ""
                texts.setdefault(cell.row, {})[cell.source] = f"{cell.figure}{star}"
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
            # Annotators list only a part of the true relations.
            parts.append("An unlisted relation counts as wrong.")
        return "\n\n".join([*parts, grid(["", "weights", *sources], lines)])

    def _skipped(self, task: str) -> Iterator[str]:
        """Generate a sentence on skipped scenes, with the highest number of each source."""
        skipped: dict[str, int] = {}
        for entry in self.asked:
            if entry["task"] == task and entry["skipped"]:
                source = entry["source"]
                skipped[source] = max(entry["skipped"], skipped.get(source, 0))
        if skipped:
            counts = ", ".join(f"{count:,} of {source}" for source, count in skipped.items())
            yield f"Scenes that could not be scored: {counts}."


def grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def summarise(reports: Reports, ours: str) -> Results:
    """Compute the metrics of every row, and the paired differences from the reference row.

    Metrics over the scenes of a single group are left out, because they have no interval.

    Raises:
        ValueError: the reports lack the reference row.
    """
    members: dict[tuple[str, str, str, str], list[Metric]] = {}
    asked: list[dict[str, Any]] = []
    parameters: dict[str, int] = {}
    for (row, seed), by_source in reports.items():
        for source, report in by_source.items():
            if report.parameters is not None:
                parameters[row] = report.parameters
            for task, outcome in report.outcomes.items():
                if outcome is None:
                    continue
                entry = {"row": row, "seed": seed, "task": task, "source": source}
                numbers = {name: getattr(outcome, name) for name in ("scenes", "skipped", "notes")}
                asked.append(entry | numbers)
                for name, metric in outcome.metrics.items():
                    members.setdefault((row, task, source, name), []).append(metric)
    rows = [row for row, _ in reports]
    # A pooled metric is left out if its data sources differ between seeds. For example, the Brier
    # skill of a seed is undefined on a source where all queried relations hold.
    means = {
        key: mean_over_seeds(metrics)
        for key, metrics in sorted(members.items(), key=lambda item: rows.index(item[0][0]))
        if len(metrics[0].groups) > 1 and all(_same_groups(m, metrics[0]) for m in metrics)
    }
    if not any(row == ours for row, *_ in means):
        raise ValueError(f"the reports contain no metric of the reference row {ours}")
    cells = tuple(
        Cell(row, task, source, name, mean.figure(), tuple(m.value for m in seeds))
        for (row, task, source, name), mean in means.items()
        for seeds in [members[row, task, source, name]]
    )
    differences = tuple(
        Difference(row, task, source, name, paired_difference(mine, mean))
        for (row, task, source, name), mean in means.items()
        if row != ours
        and (mine := means.get((ours, task, source, name))) is not None
        # A row may lack a pooled metric on some data sources. Its scenes then cannot be paired.
        and _same_groups(mine, mean)
    )
    return Results(ours, cells, differences, parameters, tuple(asked))


def _same_groups(a: Metric, b: Metric) -> bool:
    return np.array_equal(a.groups, b.groups)


def mean_over_seeds(members: Sequence[Metric]) -> Resampled:
    """Return the mean of a metric over training seeds; all seeds use the same resamples."""
    shortest = min(len(member.draws) for member in members)
    drawn = np.mean([member.draws[:shortest] for member in members], axis=0)
    value = float(np.mean([member.value for member in members]))
    return Resampled(value, drawn, members[0].groups, members[0].n)


def only(report: SourceReport, wanted: Mapping[str, Sequence[str]]) -> SourceReport:
    """Return the report with only the wanted metrics, because resampling all metrics is slow."""
    outcomes: dict[str, Outcome | None] = {}
    for task, names in wanted.items():
        if task in report.outcomes:
            outcome = outcomes[task] = report.outcomes[task]
            if outcome is not None:
                metrics = {x: outcome.metrics[x] for x in names if x in outcome.metrics}
                outcomes[task] = replace(outcome, metrics=metrics)
    return replace(report, outcomes=outcomes)
