"""``python -m benchmarks.patrol``: the alarms of a `Home` on patrols through flats.

Printed are, summed over the seeds: the share of alarm seconds that are right (the object is an
intruder); wrong onsets a minute of real objects, of ghosts (tracks without a true object) and of
places (`misplaced`); changes of alarms a minute, without the first right one of each intruder; the
number of found intruders of each patrol; the seconds in which an intruder could be seen until it
was found (longest, median); the share of seconds with the right room type, and its changes.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, get_args

import typer

from benchmarks.patrol.judge import Counts, Situation, count, drive
from benchmarks.patrol.robot import Noise, folder_world, own_world
from scene_client import Client, Settings

ALONE = {
    "30 % missed": Noise(0.3, 0.0, 0.0),
    "15 % ghosts": Noise(0.0, 0.15, 0.0),
    "20 % swaps": Noise(0.0, 0.0, 0.2),
}


def main(
    folder: Annotated[Path | None, typer.Option(help="a folder with flat.py")] = None,
    url: Annotated[str, typer.Option(help="address of the service")] = "http://127.0.0.1:8000",
    seeds: Annotated[str, typer.Option(help="numbers of the patrols")] = "0,1,2,3",
    situation: Annotated[str, typer.Option(help="full, poses or labels")] = "full",
    laps: int = 2,
    missed: float = 0.2,
    ghosts: float = 0.05,
    swaps: float = 0.1,
    alternatives: Annotated[bool, typer.Option("--alternatives")] = False,
    alone: Annotated[bool, typer.Option("--alone", help="each disturbance alone")] = False,
    setting: Annotated[list[str] | None, typer.Option(help="NAME=VALUE of Settings")] = None,
    worst: Annotated[int, typer.Option(help="number of printed wrong alarms")] = 8,
) -> None:
    """Drive through flats, and print right and wrong alarms."""
    runs: list[tuple[str, str, Noise]] = [
        (situation, situation, Noise(missed, ghosts, swaps, alternatives))
    ]
    if alone:
        runs = [(name, situation, noise) for name, noise in ALONE.items()]
        runs.append(("labels only", "labels", Noise(missed, ghosts, swaps)))
    settings = Settings(timeout=30.0, **dict(map(_setting, setting or ())))  # type: ignore[arg-type]
    with Client(url, timeout=30) as client:
        for name, kind, noise in runs:
            sums, start = Counts(), time.perf_counter()
            for seed in map(int, seeds.split(",")):
                if folder is None:
                    world = own_world(seed, noise, laps)
                else:
                    world = folder_world(folder, seed, noise, laps)
                count(drive(client, world, _situation(kind), settings), world, sums)
            print(f"{name} ({time.perf_counter() - start:.0f} s)")
            print("  " + ", ".join(f"{key} {value}" for key, value in sums.figures().items()))
            print(f"  events {dict(sums.events)}")
            for text, times in sums.worst.most_common(worst):
                print(f"  {times:3} {text}")


def _setting(text: str) -> tuple[str, float | int | str]:
    name, _, value = text.partition("=")
    if name == "sensitivity":
        return name, value
    return name, int(value) if name == "answers" else float(value)


def _situation(name: str) -> Situation:
    for one in get_args(Situation):
        if one == name:
            found: Situation = one
            return found
    raise typer.BadParameter("the situation must be full, poses or labels")


if __name__ == "__main__":
    typer.run(main)
