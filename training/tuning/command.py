"""`python -m training tune`: random search on validation scenes, resumed where it stopped."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from training.config import (
    Config,
    ConfigError,
    config_toml,
    data_folder,
    load_config,
    with_settings,
)
from training.datasets import DatasetError
from training.pipeline import prepare
from training.tuning.space import load_space, proposals, shipped_spaces
from training.tuning.study import FIGURES, POOLED, By, Study, Trial, TuningError

console = Console()


def tune(
    configuration: Annotated[str, typer.Argument(help="a TOML file, or a shipped configuration")],
    space: Annotated[
        Path | None, typer.Option(help="what may vary; by default the shipped one of its name")
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="draws, earlier ones among them")] = 20,
    by: Annotated[By, typer.Option(help="the figure to maximise")] = "both",
    seed: Annotated[int, typer.Option(help="of the draws")] = 0,
    epochs: Annotated[int | None, typer.Option(min=1, help="for shorter cycles")] = None,
    prune: Annotated[bool, typer.Option(help="give up on trials below the median")] = True,
    data: Annotated[Path | None, typer.Option("--data", help="folder with the scene files")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="for trials and results")] = Path(
        "runs/tuning"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="forget earlier trials")] = False,
) -> None:
    """Search for better settings by validation scenes alone.

    The configuration as it is comes first, then random draws. Every trial is written to
    <folder>/<configuration>/trials.jsonl as it ends, and the best one to best.toml beside it.
    Ctrl-C keeps what is finished; the same command goes on from there.
    """
    try:
        original = load_config(configuration)
        draws = proposals(original, load_space(_space(original, space)), seed, trials)
        place = folder / original.name
        if fresh:
            shutil.rmtree(place, ignore_errors=True)
        shortened = {"training.epochs": epochs} if epochs else {}
        config = with_settings(original, shortened)
        with console.status("reading and encoding scenes"):
            scenes = prepare(config, data_folder(configuration, config, data))
        study = Study(place, config, scenes.training_data(), scenes.digests, by)
        _search(study, [{}, *draws], prune)
    except (ConfigError, DatasetError, TuningError) as error:
        console.print(f"[red]error:[/red] {error}")
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        console.print("stopped; the same command goes on from there")
        raise typer.Exit(130) from None
    console.print(_table(study))
    console.print(f"every trial: {place / 'trials.jsonl'}")
    if study.best is None:
        console.print("[red]error:[/red] no trial finished")
        raise typer.Exit(1)
    _conclude(study, study.best, original)


def _space(config: Config, path: Path | None) -> Path:
    if path is not None:
        return path
    shipped = shipped_spaces()
    if config.name not in shipped:
        raise ConfigError(
            f"no search space comes with {config.name}, only with {', '.join(shipped)}: name a "
            "TOML file with --space"
        )
    return shipped[config.name]


def _search(study: Study, draws: list[dict[str, Any]], prune: bool) -> None:
    columns = (
        "[progress.description]{task.description}",
        BarColumn(),
        "{task.completed:.1f}/{task.total}",
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("trials", total=len(draws), note="")
        for number, settings in enumerate(draws):
            shown = _shown(settings)

            def show(epochs: float, note: str, number: int = number, shown: str = shown) -> None:
                share = min(epochs / study.config.training.epochs, 1.0)
                bar.update(task, completed=number + share, note=f"{shown}: {note}")

            if study.known(settings) is None:
                trial = study.run(settings, show, prune=prune)
                bar.print(f"{shown}: {trial.reason or _figures(trial)}", markup=False)
            bar.update(task, completed=number + 1)


def _shown(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.partition('.')[2]} {v}" for name, v in settings.items()) or "as it is"


def _figures(trial: Trial) -> str:
    return ", ".join(f"{name} {figure}" for name, figure in trial.figures[POOLED].items())


def _table(study: Study) -> Table:
    """Trials from best to worst, those without figures last."""
    table = Table(*FIGURES, "seconds", "state", "settings", title=study.config.name)
    for trial in sorted(study.trials, key=lambda trial: -trial.score(study.by)):
        pool = trial.figures.get(POOLED, {})
        figures = [f"{pool[name].value:.4f}" if name in pool else "" for name in FIGURES]
        table.add_row(*figures, f"{trial.seconds:.0f}", trial.state, _shown(trial.settings))
    return table


def _conclude(study: Study, best: Trial, original: Config) -> None:
    """Write the best configuration, with the original's own number of epochs."""
    changed = with_settings(original, best.settings)
    tuned = changed.model_copy(update={"name": f"{original.name}-tuned"})
    path = study.folder / "best.toml"
    comment = [
        f"{original.name}, {_shown(best.settings)}.",
        f"On validation scenes, {study.config.training.epochs} epochs: {_figures(best)}.",
    ]
    base = study.known({})
    if base is not None and base.state == "finished" and base is not best:
        differences = ((name, study.difference(best, base, name)) for name in FIGURES)
        shown = ", ".join(f"{name} {figure}" for name, figure in differences if figure)
        comment.append(f"Minus {original.name} as it is, paired by scenes: {shown}.")
        comment.append(
            f"The best of {len(study.trials)} flatters itself: train both with more seeds."
        )
    text = "".join(f"# {line}\n" for line in comment) + "\n" + config_toml(tuned)
    path.write_text(text, encoding="utf-8")
    console.print("\n".join(comment), markup=False)
    console.print(f"best configuration: {path}")
