"""Reliability plots of `benchmark`: predicted probability against observed frequency."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from training.evaluation.calibration_task import NAMES
from training.evaluation.metrics import Scored
from training.evaluation.results import Reports
from training.evaluation.setting import Outcome
from training.research.measure import POOLED, slug

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_plots(folder: Path, machines: Sequence[str], reports: Reports) -> None:
    """Write reliability-<machine>.png for each machine with measured calibration, of seed 0."""
    for name in machines:
        report = reports.get((name, 0), {}).get(POOLED)
        outcome = None if report is None else report.outcomes.get("Calibration")
        if outcome is not None:
            figure = reliability_diagrams(outcome, f"{name}, {POOLED}")
            figure.savefig(folder / f"reliability-{slug(name)}.png", dpi=110)


def reliability_diagrams(outcome: Outcome, title: str) -> Figure:
    """Plot reliability diagrams, one per question, with and without calibration."""
    from matplotlib.figure import Figure  # slow to import

    questions = [name for name in NAMES if f"ECE, {name}" in outcome.metrics]
    figure = Figure(figsize=(3.2 * len(questions), 3.6), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(1, len(questions), squeeze=False).flat
    for axis, name in zip(axes, questions, strict=True):
        axis.plot([1e-5, 1], [1e-5, 1], color="0.7", linewidth=1)
        for suffix, marker in ((", uncalibrated", "x"), ("", "o")):
            metric = outcome.metrics[f"ECE, {name}{suffix}"]
            if not isinstance(metric, Scored):
                raise TypeError(f"the metric ECE of {name} does not store its answers")
            probability, frequency = metric.reliability()
            label = f"{suffix[2:] or 'as published'}, ECE {metric.value:.3f}"
            axis.plot(probability, frequency, marker=marker, linewidth=1, label=label)
        axis.set_xscale("symlog", linthresh=1e-3)  # most probabilities are small
        axis.set_yscale("symlog", linthresh=1e-3)
        axis.set(xlim=(0, 1.1), ylim=(0, 1.1), xlabel="probability", title=name)
        axis.legend(fontsize=7)
    return figure
