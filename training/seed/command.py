"""`python -m training seed`: reproduce the tables of Bozcan et al. (2018) on one data source.

<out>/<source>/<split>/<variant>-seed-<n>.json   errors of each epoch and figures of one machine
<out>/<source>/results.json, results.md          all figures, beside those of the paper
<out>/<source>/errors.png                        error curves of all machines

An interrupted command continues with the machines whose files are missing.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cache, partial
from itertools import product
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Annotated, Any, Final

import torch
import typer

from training.datasets import DatasetError
from training.datasets.console import console, print_marked
from training.datasets.files import DATA, write_whole
from training.seed.machines import EPOCHS, KINDS, LEARNING_RATE, VARIANTS, train
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
from training.seed.scenes import Material, read_material

Job = tuple[str, str, int]  # split, variant and training seed of a machine
Run = dict[str, Any]  # figures of a machine, and the errors of each epoch
Row = dict[str, float]  # figures by metric


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
    learning_rate: Annotated[
        float, typer.Option(min=1e-6, help="learning rate; .5 in the paper")
    ] = LEARNING_RATE,
    workers: Annotated[int, typer.Option(min=1, help="processes that train at once")] = 2,
) -> None:
    """Reproduce Bozcan et al. (2018): train RBM, GBM and Triway, and measure the four tasks.

    The command prints the results, and writes results.json, results.md and errors.png into
    OUT/SOURCE. After an interruption, run the same command again: it keeps finished machines.
    """
    try:
        with console.status("reading scenes"):
            materials = _materials(source, data)
        folder = out / Path(source).name.split(".")[0]
        settings = {"epochs": epochs, "learning_rate": learning_rate}
        run_job = partial(_run, source=source, data=data, folder=folder, settings=settings)
        runs = _train_all(run_job, list(product(materials, VARIANTS, range(seeds))), workers)
    except (DatasetError, FolderError, FloatingPointError) as error:
        print_marked("error:", "red", str(error))
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to continue")
        raise typer.Exit(130) from None
    results: dict[str, Any] = {}
    for split, machines in runs.items():
        material = materials[split]
        triples, test = material.triples, material.test
        frequency = frequency_answer(triples, material.train)
        answers = {"frequency": frequency, "nothing": nothing_answer}
        references = {
            name: [measure(answer, triples, test, number) for number in range(seeds)]
            for name, answer in answers.items()
        }
        results[split] = {"references": references, "machines": machines}
    page = markdown(source, materials, results)
    write_whole(folder / "results.json", json.dumps({"paper": PAPER, "splits": results}, indent=1))
    write_whole(folder / "results.md", page)
    plot(folder / "errors.png", results)
    console.print(page, highlight=False, soft_wrap=True)
    console.print(f"results: {folder}/results.md, results.json, errors.png", soft_wrap=True)


_materials = cache(read_material)  # the scenes are read once in each process


def _train_all(
    run_job: Callable[[Job], Run], jobs: Sequence[Job], workers: int
) -> dict[str, dict[str, list[Run]]]:
    """Return the runs by split and variant, from files or worker processes of one thread."""
    runs: dict[str, dict[str, list[Run]]] = {split: {} for split, _, _ in jobs}
    pool = multiprocessing.get_context("spawn").Pool(workers, _start_worker)
    with console.status(f"training {len(jobs)} machines"), pool:
        for done, run in enumerate(pool.imap(run_job, jobs), 1):
            split, name, number = jobs[done - 1]
            runs[split].setdefault(name, []).append(run)
            last = run["history"][-1]
            console.print(
                f"{done} of {len(jobs)}: {split}, {name}, seed {number}: {len(run['history'])} "
                f"epochs, E {last['objects']:.2f} / {last['relations']:.2f}, {run['cpu']:.0f} s",
                highlight=False,
            )
    return runs


def _start_worker() -> None:
    """Use one thread, and leave Ctrl-C to the parent process."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(job: Job, source: str, data: Path, folder: Path, settings: Mapping[str, Any]) -> Run:
    """Return the run of a job in its file. Without a file, train, measure and write it."""
    split, name, number = job
    path = folder / split / f"{name}-seed-{number}.json"
    material = _materials(source, data)[split]
    settings = {"scenes": material.digest, **settings}
    if path.exists():
        run: Run = json.loads(path.read_text(encoding="utf-8"))
        if run["settings"] != settings:
            raise FolderError(f"{path} has other scenes or settings: use another --out")
        return run
    start, generator = time.process_time(), torch.Generator().manual_seed(number)
    variant, V = VARIANTS[name], len(material.vocabulary)
    machine = variant.kind(material.triples, V, variant.H1, variant.H2, generator)
    try:
        history = train(machine, material, generator, settings["epochs"], settings["learning_rate"])
    except FloatingPointError as error:
        raise FloatingPointError(f"{split}, {name}, seed {number}: {error}") from None
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
        "cpu": time.process_time() - start,
    }
    write_whole(path, json.dumps(run, indent=1))
    return run


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
        material = materials[split]
        parts.append(
            f"## {_TITLES[split]}\n\nScenes: {len(material.train)} for training, "
            f"{len(material.validation)} for validation, {len(material.test)} for tests. "
            f"{len(material.vocabulary)} classes, {len(material.triples)} triples.\n"
        )
        parts.append(_table(result))
        for name, runs in result["machines"].items():
            parts += [f"T4, {VARIANTS[name].title}, seed 0:\n"]
            parts += [f"- {unit}: {', '.join(own)}" for unit, own in runs[0]["classes"].items()]
            parts.append("")
    return "\n".join(parts)


def _table(result: Mapping[str, Any]) -> str:
    """Return the Markdown table of a split: a row for each metric, a column for each machine."""
    columns: dict[str, list[Row]] = dict(result["references"])
    columns |= {name: [_row(run) for run in runs] for name, runs in result["machines"].items()}
    metrics = dict.fromkeys(metric for rows in columns.values() for row in rows for metric in row)
    titles = [VARIANTS[name].title if name in VARIANTS else name for name in columns]
    lines = [["", *titles, "paper: RBM / GBM / Triway"], ["---"] * (len(columns) + 2)]
    for metric in metrics:
        paper = " / ".join(f"{value:.4f}" for value in PAPER.get(metric, {}).values())
        lines.append([metric, *_cells(metric, columns.values()), paper])
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
    """Yield mean ± standard deviation over the seeds of each column; "" without the metric."""
    for rows in columns:
        values = [row[metric] for row in rows if metric in row]
        digits = 0 if metric in ("epochs", "weights") else 1 if metric.startswith("E ") else 3
        spread = f" ± {stdev(values):.{digits}f}" if len(values) > 1 and any(values) else ""
        yield f"{fmean(values):,.{digits}f}{spread}" if values else ""


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
