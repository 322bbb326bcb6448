"""The page and the plot of the results: tables beside the figures of the paper, error curves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any, Final

from training.seed.learning import KINDS
from training.seed.machines import VARIANTS
from training.seed.protocol import PAPER
from training.seed.scenes import Material

Run = dict[str, Any]
Row = dict[str, float]

_EPOCHS_SHOWN: Final = (1, 10, 50)
_ANNEALED_SHOWN: Final = (
    "T1 on",
    "T1 precision",
    "T2 on, relations deleted",
    "T2 false objects, relations deleted",
    "T3 error / objects",
)
_TITLES: Final = {"scenes": "Split by scenes, as in the paper", "groups": "Split by groups"}


def markdown(source: str, materials: Mapping[str, Material], results: Mapping[str, Any]) -> str:
    """Return the page with a table for each split. Cells are means ± standard deviations."""
    parts = [f"# Bozcan et al. (2018) on {source}\n", "![errors E by epoch](errors.png)\n"]
    for split, result in results.items():
        m = materials[split]
        parts.append(
            f"## {_TITLES[split]}\n\nScenes: {len(m.train)} for training, {len(m.validation)} for "
            f"validation, {len(m.test)} for tests. {len(m.vocabulary)} classes, {len(m.triples)} "
            "triples.\n"
        )
        parts.append(_table(result))
        for name, runs in result["machines"].items():
            parts += [f"T4, {VARIANTS[name].title}, seed 0:\n"]
            parts += [f"- {unit}: {', '.join(own)}" for unit, own in runs[0]["classes"].items()]
            parts.append("")
    return "\n".join(parts)


def _table(result: Mapping[str, Any]) -> str:
    columns: dict[str, list[Row]] = dict(result["references"])
    columns |= {name: [_row(run) for run in runs] for name, runs in result["machines"].items()}
    metrics = dict.fromkeys(metric for rows in columns.values() for row in rows for metric in row)
    titles = [VARIANTS[name].title if name in VARIANTS else name for name in columns]
    lines = [
        ["", *titles, "paper: RBM / GBM / Triway"],
        ["---"] * (len(columns) + 2),
        *([metric, *_cells(metric, columns.values()), _paper(metric)] for metric in metrics),
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _row(run: Run) -> Row:
    """Return all figures of a run by metric, in the order of the table."""
    history, row = run["history"], dict(run["figures"])
    row |= {f"annealed: {name}": run["annealed"][name] for name in _ANNEALED_SHOWN if name in row}
    for kind in KINDS:
        shown = {f"epoch {k}": history[k - 1] for k in _EPOCHS_SHOWN if k <= len(history)}
        for when, epoch in (shown | {"last epoch": history[-1]}).items():
            row[f"E {kind}, {when}"] = epoch[kind]
        left = history[min(50, len(history)) - 1][kind]
        row[f"share of E {kind} left at epoch 50"] = left / max(history[0][kind], 1e-9)
    row["epochs"], row["weights"] = len(history), run["weights"]
    row["seconds an epoch"] = median(epoch["seconds"] for epoch in history)
    return row


def _cells(metric: str, columns: Iterable[list[Row]]) -> Iterator[str]:
    for rows in columns:
        values = [row[metric] for row in rows if metric in row]
        digits = 0 if metric in ("epochs", "weights") else 1 if metric.startswith("E ") else 3
        spread = f" ± {stdev(values):.{digits}f}" if len(values) > 1 and any(values) else ""
        yield f"{fmean(values):,.{digits}f}{spread}" if values else ""


def _paper(metric: str) -> str:
    return " / ".join(f"{value:.4f}" for value in PAPER.get(metric, {}).values())


def plot(path: Path, results: Mapping[str, Any]) -> None:
    """Draw E of objects and relations by epoch, one line for each machine and training seed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4 * len(results)), layout="constrained")
    axes = figure.subplots(len(results), len(KINDS), squeeze=False)
    for row, (split, result) in zip(axes, results.items(), strict=True):
        for axis, kind in zip(row, KINDS, strict=True):
            for number, (name, runs) in enumerate(result["machines"].items()):
                for seed, run in enumerate(runs):
                    values = [epoch[kind] for epoch in run["history"]]
                    label = None if seed else VARIANTS[name].title
                    axis.plot(
                        range(1, len(values) + 1), values, f"C{number}", linewidth=1, label=label
                    )
            axis.set(xlabel="epoch", ylabel="E", title=f"{_TITLES[split]}: {kind}", ylim=(0, None))
            axis.legend()
    figure.savefig(path, dpi=110)
