"""The command `evaluate`: figures of stored models, on test scenes or on a file of the user."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich import box
from rich.table import Table
from rich.text import Text

from app.registry import DEFAULT_STORE, Artifact, Metric, RegistryError, Store
from training.datasets import DatasetError
from training.datasets.batches import subset
from training.datasets.console import console, print_lines
from training.datasets.files import DATA
from training.domain.terminal import StorePath, fail
from training.evaluation.everyday_task import EVERYDAY
from training.evaluation.metrics import Figure
from training.evaluation.report import Progress, RoomList, evaluate, read_test
from training.evaluation.tasks import in_words
from training.fit.configuration import ConfigError, source_name
from training.runs.config_files import stored_config
from training.runs.pipeline import prepare

Figures = dict[str, list[Metric]]  # metrics by model


def evaluate_command(
    models: Annotated[list[str], typer.Argument(help="model: an alias, name or name@version")],
    files: Annotated[
        list[Path] | None,
        typer.Option(
            "--file",
            help="your own test: a file of scenes (*.jsonl). It replaces the scenes of the "
            "training split (--data, --source)",
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            help="folder with the scene files. For a stored model of your own scenes, pass the "
            f"folder of its configuration file; default: {DATA}",
        ),
    ] = None,
    store: StorePath = DEFAULT_STORE,
    source: Annotated[list[str] | None, typer.Option(help="use only these data sources")] = None,
    output: Annotated[Path | None, typer.Option("--json", help="write figures to a file")] = None,
) -> None:
    """Evaluate stored models on scenes of the same split as in training, or on your own file.

    The figures are those of the model card. The command `benchmark` evaluates the baselines.
    """
    try:
        stored = Store(store)
        artifacts = {name: stored.load(*stored.resolve(name)) for name in models}
        if files and (data is not None or source):
            raise ConfigError("--file replaces the scenes of --data and --source; leave these out")
        rows: dict[str, list[dict[str, Any]]] = {name: [] for name in models}
        for path, test in [(path, read_test(path)) for path in files or ()]:
            figures = _ask(test, artifacts)
            _show(figures, title=path.name)
            for name, table in figures.items():
                learnt = test.trained(artifacts[name])
                for row in table:
                    origin = {"file": str(path), "in_training": row.source in learnt}
                    rows[name].append(row.model_dump() | origin)
        if not files:
            figures = {
                name: _measure(name, artifact, data or DATA, source)
                for name, artifact in artifacts.items()
            }
            _show(figures)
            rows = {name: [row.model_dump() for row in table] for name, table in figures.items()}
    except (ConfigError, DatasetError, RegistryError) as error:
        fail(error)
    if output is not None:
        output.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _ask(test: RoomList, artifacts: dict[str, Artifact]) -> Figures:
    """Ask all models the questions of a file, and print the remarks on the figures."""
    figures: Figures = {}
    for name, artifact in artifacts.items():
        with console.status(name) as status:
            say: Progress = status.update
            figures[name] = test.measure(artifact.model, say)
        learnt = test.trained(artifact)
        remarks = [f"{source} is training data of this model, not new data" for source in learnt]
        for remark in filter(None, [test.remark(artifact.model), *remarks]):
            print_lines(f"{name}: {remark}")
    return figures


def _measure(
    reference: str, artifact: Artifact, data: Path, sources: list[str] | None
) -> list[Metric]:
    """Return the figures of a model on the test scenes of its configuration."""
    config = stored_config(artifact)
    names = sources or list(map(source_name, config.data.sources))
    with console.status("reading scenes"):
        # The split must include all data sources, as in training. Otherwise the test part
        # could contain training scenes.
        scenes = prepare(config, data, artifact.model.vocabulary)
    tensors = scenes.training_data()
    index = [k for k, scene in enumerate(tensors.test.scenes) if scene.source in names]
    if not index:
        raise ConfigError(
            f"{reference}: the test part has no scenes of the sources {', '.join(names)}"
        )
    test = subset(tensors.test, torch.tensor(index, dtype=torch.int64))
    with console.status(reference) as status:
        return evaluate(
            artifact.model, test, tensors.structure, tensors.train,
            everyday=EVERYDAY, progress=status.update,
        )  # fmt: skip


def _show(tables: Figures, title: str | None = None) -> None:
    """Print a table of the metrics of all models."""
    figures: dict[tuple[str, str, str], dict[str, str]] = {}
    for name, rows in tables.items():
        for row in rows:
            line = figures.setdefault((row.task, row.metric, row.source), {})
            line[name] = str(Figure(row.value, row.low, row.high, row.n))
    table, heading = Table("task, metric", "source", *tables, box=box.SIMPLE_HEAD, title=title), ""
    for (task, metric, source), values in sorted(figures.items(), key=lambda item: item[0][0]):
        if task != heading:
            heading = task
            table.add_row(Text(in_words(task), "bold"))
        table.add_row(f"  {metric}", source, *(values.get(name, "") for name in tables))
    console.print(table)
