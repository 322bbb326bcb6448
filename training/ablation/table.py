"""An ablation as Markdown: every row's figures, and how far it stands from the full model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from training.benchmark.summary import UNLISTED, Results
from training.config import Config
from training.evaluation.intervals import Figure

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("T1a", "T1a relations", "R-precision, instance counts"),
    ("T1 pairs", "T1 pairs", "accuracy"),
    ("unseen pairs", "T1 pairs", "accuracy, unseen pairs"),
    ("rare classes", "T1 pairs", "accuracy, rare classes"),
    ("T1b", "T1b completion", "R-precision"),
    ("T2", "T2 missing", "MRR"),
    ("T2-at", "T2-at missing at a place", "MRR"),
    ("T3 hit@1", "T3 outliers, uniform", "hit@1"),
    ("T3 AUROC", "T3 outliers, uniform", "AUROC"),
)
"""Heading, task and metric; the reports hold every metric of these tasks."""

TASKS = tuple(dict.fromkeys(task for _, task, _ in COLUMNS))


@dataclass(frozen=True)
class Cost:
    """What a row took.

    Attributes:
        weights: how many are trained.
        seconds: of training, mean over seeds.
    """

    weights: int
    seconds: float


def markdown(
    results: Results,
    rows: Sequence[Config],
    costs: Mapping[str, Cost],
    failures: Mapping[str, str],
) -> str:
    """One table a source, then what could not be measured.

    Args:
        rows: in their order, the full model among them.
        failures: by row, why it has no figures.
    """
    sources = dict.fromkeys(cell.source for cell in results.cells)
    parts = [_what(rows, costs)]
    parts += [_table(results, rows, source) for source in sources]
    if failures:
        parts.append("\n".join(f"- {row} was not measured: {why}" for row, why in failures.items()))
    return "\n\n".join(parts) + "\n"


def _what(rows: Sequence[Config], costs: Mapping[str, Cost]) -> str:
    lines = ["| | | weights | training, s |", "|---|---|---|---|"]
    for row in rows:
        cost = costs.get(row.name)
        shown = f"{cost.weights:,} | {cost.seconds:.0f}" if cost else "|"
        lines.append(f"| {row.name} | {row.description} | {shown} |")
    return "\n".join(lines)


def _table(results: Results, rows: Sequence[Config], source: str) -> str:
    figures = {
        (cell.row, cell.task, cell.metric): cell.figure
        for cell in results.cells
        if cell.source == source
    }
    gaps = {
        (gap.row, gap.task, gap.metric): gap.figure
        for gap in results.differences
        if gap.source == source
    }
    columns = [column for column in COLUMNS if (results.ours, *column[1:]) in figures]
    precision = {"T1a", "T1b"} & {heading for heading, *_ in columns}
    lines = [
        f"### {source}",
        "",
        f"In brackets: the row minus {results.ours}, 95 % interval over the same scenes.",
        *([f"{UNLISTED} in T1a and T1b."] if precision else []),
        "",
        "| | " + " | ".join(heading for heading, *_ in columns) + " |",
        "|---" * (len(columns) + 1) + "|",
    ]
    for row in rows:
        cells = [
            _cell(figures.get((row.name, task, metric)), gaps.get((row.name, task, metric)))
            for _, task, metric in columns
        ]
        if any(cells):
            name = f"**{row.name}**" if row.name == results.ours else row.name
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(figure: Figure | None, gap: Figure | None) -> str:
    if figure is None:
        return ""
    if gap is None:
        return f"{figure.value:.3f}"
    # The summary has ours minus the row; here a part is read by what goes when it goes.
    low, high = (0.0 - round(bound, 3) for bound in (gap.high, gap.low))
    return f"{figure.value:.3f} ({low:+.3f}, {high:+.3f})"
