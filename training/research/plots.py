"""Plots of the results of `benchmark`.

reliability-*.png   predicted probability against observed frequency, one file per machine
recall.png          recall among the first k predictions, for relations and for removed objects
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from matplotlib.figure import Figure

from training.evaluation.calibration_task import NAMES
from training.evaluation.metrics import Scored
from training.evaluation.results import Reports, Results
from training.evaluation.setting import Outcome
from training.research.entries import Entry
from training.research.measure import POOLED, Plan, slug

_RECALL = {
    "T1a relations": ("R@", "annotated relations among the first k of a scene"),
    "T2 missing": ("top-", "removed objects in the first k places"),
}


def write_plots(plan: Plan, machines: Sequence[Entry], reports: Reports, results: Results) -> None:
    """Write all plots that have data.

    The reliability plots use the calibrated machines with the training seed of the first.
    """
    figures = {"recall": recall_curves(results, POOLED)}
    for entry in machines:
        outcome = reports[entry.name, entry.seed][POOLED].outcomes.get("Calibration")
        if outcome is not None and entry.seed == machines[0].seed:
            title = f"{entry.name}, {POOLED}"
            figures[f"reliability-{slug(entry.name)}"] = reliability_diagrams(outcome, title)
    for name, figure in figures.items():
        figure.savefig(plan.folder / f"{name}.png", dpi=110)


def reliability_diagrams(outcome: Outcome, title: str) -> Figure:
    """Plot reliability diagrams, one per question, with and without calibration.

    The axes are logarithmic because most probabilities are small.
    """
    questions = [name for name in NAMES if f"ECE, {name}" in outcome.metrics]
    figure = Figure(figsize=(3.2 * max(len(questions), 1), 3.6), layout="constrained")
    figure.suptitle(title)
    for axis, name in zip(_axes(figure, len(questions)), questions, strict=True):
        axis.plot([1e-5, 1], [1e-5, 1], color="0.7", linewidth=1)
        for suffix, marker in ((", uncalibrated", "x"), ("", "o")):
            metric = outcome.metrics[f"ECE, {name}{suffix}"]
            if not isinstance(metric, Scored):
                raise TypeError(f"the metric ECE of {name} does not store its answers")
            probability, frequency = metric.reliability()
            label = f"{suffix[2:] or 'as published'}, ECE {metric.value:.3f}"
            axis.plot(probability, frequency, marker=marker, linewidth=1, label=label)
        axis.set_xscale("symlog", linthresh=1e-3)
        axis.set_yscale("symlog", linthresh=1e-3)
        axis.set(xlim=(0, 1.1), ylim=(0, 1.1), xlabel="probability", title=name)
        axis.legend(fontsize=7)
    return figure


def recall_curves(results: Results, source: str) -> Figure:
    """Plot recall by number of predictions, one line per model, for one data source."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    axes = _axes(figure, len(_RECALL))
    for axis, (task, (prefix, title)) in zip(axes, _RECALL.items(), strict=True):
        for row, points in recall_points(results, task, prefix, source).items():
            k, values = zip(*points, strict=True)
            is_ours = row == results.ours
            axis.plot(
                k, values, label=row, linewidth=2.5 if is_ours else 1, marker="." if is_ours else ""
            )
        axis.set(xscale="log", xlabel="k", title=f"{title}, {source}", ylim=(0, 1))
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=7)
    return figure


def recall_points(
    results: Results, task: str, prefix: str, source: str
) -> dict[str, list[tuple[int, float]]]:
    """Return the points (k, recall at k) of the metrics "<prefix>k", by model name."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for cell in results.cells:
        k = cell.metric.removeprefix(prefix)
        if (cell.task, cell.source) == (task, source) and k != cell.metric and k.isdigit():
            curves.setdefault(cell.row, []).append((int(k), cell.figure.value))
    return {row: sorted(points) for row, points in curves.items()}


def _axes(figure: Figure, columns: int) -> Iterator[Any]:
    return iter(figure.subplots(1, columns, squeeze=False).flat) if columns else iter(())
