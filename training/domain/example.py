"""`python -m training example`: scenes to try things on, in the product's own format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from training.datasets import generate_rooms
from training.datasets.furniture import DOMAINS
from training.datasets.jsonl import write_jsonl

console = Console()


def example(
    file: Annotated[Path, typer.Argument(help="to write, such as scenes.jsonl")],
    domain: Annotated[
        Literal["homes", "workplaces"],
        typer.Option(help="furnished rooms, or laboratories, workshops and storerooms"),
    ] = "workplaces",
    scenes: Annotated[int, typer.Option(min=1, help="how many")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="draws others")] = 0,
) -> None:
    """Write scenes that a small generator makes up: an example of the format, and of a domain.

    One seed begins alike whatever the number: with more scenes the earlier ones stay.
    """
    if file.exists():
        console.print(f"[red]error:[/red] {file} is there already", soft_wrap=True)
        raise typer.Exit(1)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_jsonl(generate_rooms(scenes, seed, DOMAINS[domain]), file)
    console.print(f"{scenes} generated scenes of {domain}: {file}", soft_wrap=True)
