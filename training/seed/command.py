"""`python -m training seed`: reproduce the tables of Bozcan et al. (2018) on one data source.

<out>/<source>/<split>/<variant>-seed-<n>.json   errors of each epoch and figures of one machine
<out>/<source>/results.json, results.md          all figures, beside those of the paper

An interrupted command continues with the first machine whose file is missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from itertools import product
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Annotated, Any, Final

import torch
import typer
from rich.console import Console

from training.datasets import DatasetError
from training.datasets.files import DATA
from training.seed.learning import EPOCHS, Epoch, new_machine, train
from training.seed.machines import VARIANTS, Variant
from training.seed.protocol import (
    ANNEALED,
    ONE_PASS,
    PAPER,
    frequency_answer,
    generate,
    machine_answer,
    measure,
    nothing_answer,
)
from training.seed.scenes import SPLITS, Material, read_material

_EPOCHS_SHOWN: Final = (1, 10, 50)
_ANNEALED_SHOWN: Final = (
    "T1 on",
    "T1 precision",
    "T2 on, relations deleted",
    "T2 false objects, relations deleted",
    "T3 error / objects",
)
_TITLES: Final = {"scenes": "Split by scenes, as in the paper", "groups": "Split by groups"}

Run = dict[str, Any]
Row = dict[str, float]

console = Console()


class FolderError(ValueError):
    """A folder contains figures of other scenes or settings. The message names the file."""


def seed(
    source: Annotated[
        str, typer.Argument(help="name of a data source, or a file of scenes")
    ] = "3dssg",
    out: Annotated[Path, typer.Option(help="folder for the figures")] = Path("runs/seed"),
    seeds: Annotated[int, typer.Option(min=1, help="number of training seeds")] = 3,
    data: Annotated[Path, typer.Option(help="folder with the scene files")] = DATA,
    epochs: Annotated[int, typer.Option(min=1, help="maximum number of epochs")] = EPOCHS,
) -> None:
    """Reproduce Bozcan et al. (2018): train RBM, GBM and Triway, and measure the four tasks.

    The command writes results.json and results.md into OUT/SOURCE. After Ctrl-C, run the same
    command again: it keeps finished machines.
    """
    try:
        with console.status("reading scenes"):
            materials = read_material(source, data, tuple(SPLITS))
        folder = out / Path(source).name.split(".")[0]
        runs = _train_all(materials, folder, seeds, epochs)
    except (DatasetError, FolderError, FloatingPointError) as error:
        console.print(f"[red]error:[/red] {error}", soft_wrap=True)
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to continue")
        raise typer.Exit(130) from None
    results = {
        split: {"references": _references(materials[split], seeds), "machines": machines}
        for split, machines in runs.items()
    }
    _write(folder / "results.json", json.dumps({"paper": PAPER, "splits": results}, indent=1))
    _write(folder / "results.md", markdown(source, materials, results))
    console.print(f"results: {folder / 'results.md'}, {folder / 'results.json'}", soft_wrap=True)


def _train_all(
    materials: Mapping[str, Material], folder: Path, seeds: int, epochs: int
) -> dict[str, dict[str, list[Run]]]:
    """Train and measure each machine without a file. Return the runs by split and variant."""
    runs: dict[str, dict[str, list[Run]]] = {split: {} for split in materials}
    with console.status("") as status:
        for split, name, number in product(materials, VARIANTS, range(seeds)):
            path = folder / split / f"{name}-seed-{number}.json"
            label = f"{split}, {path.stem}"

            def show(epoch: int, errors: Epoch, label: str = label) -> None:
                values = f"E {errors.objects:.2f} / {errors.relations:.2f}"
                status.update(f"{label}: epoch {epoch + 1}, {values}")

            runs[split].setdefault(name, []).append(
                _run(path, VARIANTS[name], materials[split], number, epochs, show)
            )
            console.print(f"{label}: done")
    return runs


def _run(
    path: Path,
    variant: Variant,
    material: Material,
    number: int,
    epochs: int,
    progress: Callable[[int, Epoch], None],
) -> Run:
    """Return the run in a file, or train and measure a machine and write the file.

    Raises:
        FolderError: the file contains a run with other scenes or settings.
    """
    settings = {"scenes": material.digest, "epochs": epochs}
    if path.exists():
        run: Run = json.loads(path.read_text(encoding="utf-8"))
        if run["settings"] != settings:
            raise FolderError(f"{path} has other scenes or settings: use another --out")
        return run
    generator = torch.Generator().manual_seed(number)
    machine = new_machine(variant, material, generator)
    history = train(machine, material, generator, progress, epochs)
    figures, annealed = (
        measure(machine_answer(machine, schedule), material.triples, material.test, number)
        for schedule in (ONE_PASS, ANNEALED)
    )
    drawn, classes = generate(machine, material.train, material.vocabulary, number)
    run = {
        "settings": settings,
        "weights": sum(weight.numel() for weight in machine.parameters()),
        "figures": figures | drawn,
        "annealed": annealed,
        "classes": classes,
        "history": [asdict(epoch) for epoch in history],
    }
    _write(path, json.dumps(run, indent=1))
    return run


def _references(material: Material, seeds: int) -> dict[str, list[Row]]:
    answers = {
        "frequency": frequency_answer(material.triples, material.train),
        "nothing": nothing_answer,
    }
    return {
        name: [measure(answer, material.triples, material.test, k) for k in range(seeds)]
        for name, answer in answers.items()
    }


def _write(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def markdown(source: str, materials: Mapping[str, Material], results: Mapping[str, Any]) -> str:
    """Return the page with a table for each split. Cells are means ± standard deviations."""
    parts = [f"# Bozcan et al. (2018) on {source}\n"]
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
    for kind in ("objects", "relations"):
        shown = {f"epoch {k}": history[k - 1] for k in _EPOCHS_SHOWN if k <= len(history)}
        for when, epoch in (shown | {"last epoch": history[-1]}).items():
            row[f"E {kind}, {when}"] = epoch[kind]
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
