"""``python -m benchmarks``: run all benchmarks, or the benchmarks named on the command line."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from benchmarks.gibbs import gibbs
from benchmarks.load.servers import ServerError
from benchmarks.log_odds import log_odds
from benchmarks.recording import recording
from benchmarks.report import Result, describe_machine
from benchmarks.scaling import scaling
from benchmarks.service import service
from benchmarks.training import training_step


class Name(StrEnum):
    """The benchmarks, in the order of execution."""

    GIBBS = "gibbs"
    TRAINING = "training"
    LOG_ODDS = "log-odds"
    SCALING = "scaling"
    SERVICE = "service"
    RECORDING = "recording"


def main(
    names: Annotated[list[Name] | None, typer.Argument(help="benchmarks; default: all")] = None,
    store: Annotated[Path, typer.Option(help="the model store to serve")] = Path("model_store"),
) -> None:
    """Measure the speed of our code relative to other implementations.

    Our code and the other implementations run alternately.
    """
    console = Console()
    for key, value in describe_machine().items():
        console.print(f"{key}: {value}", highlight=False)
    for name in names or list(Name):
        console.print()
        try:
            outcome = _run(name, store)
        except ServerError as error:
            console.print(f"{name}: skipped, {error}", highlight=False)
            continue
        for result in outcome:
            console.print(result.table())


def _run(name: Name, store: Path) -> list[Result]:
    match name:
        case Name.GIBBS:
            return [gibbs()]
        case Name.TRAINING:
            return [training_step()]
        case Name.LOG_ODDS:
            return [log_odds()]
        case Name.SCALING:
            return scaling()
        case Name.SERVICE:
            return service(store=store)
        case Name.RECORDING:
            return recording(store=store)


if __name__ == "__main__":
    typer.run(main)
