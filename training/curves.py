"""The training curve as CSV, and as a plot of reconstruction error of objects and of relations."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Epoch:
    """One row of the curve; errors are those of `evaluation.reconstruction`."""

    epoch: int
    loss: float
    object_error_train: float
    relation_error_train: float
    object_error_validation: float
    relation_error_validation: float
    mrr_validation: float
    r_precision_validation: float
    seconds: float


def write_csv(path: Path, epochs: list[Epoch]) -> None:
    """One line per epoch."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Epoch)])
        writer.writeheader()
        writer.writerows(asdict(epoch) for epoch in epochs)


def write_plot(path: Path, epochs: list[Epoch], title: str) -> None:
    """Reconstruction error per epoch, objects and relations side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.2), constrained_layout=True)
    x = [epoch.epoch for epoch in epochs]
    for axis, unit in zip(axes, ("object", "relation"), strict=True):
        for part in ("train", "validation"):
            axis.plot(x, [getattr(e, f"{unit}_error_{part}") for e in epochs], label=part)
        axis.set(xlabel="epoch", ylabel="mean absolute error", title=f"{unit}s")
        axis.legend()
    figure.suptitle(f"Reconstruction error, {title}")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
