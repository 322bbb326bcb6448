"""``python -m benchmarks.processes``: time of a training epoch in one and in several processes.

Runs of one process and of several processes alternate. Each run trains the relations of generated
rooms for two epochs, and the second epoch counts. An epoch includes the validation.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

AIM = 0.65
"""Maximum time of an epoch in two processes, as a fraction of the time in one process."""

_CONFIG = """
name = "processes"
[data]
sources = ["rooms"]
vocabulary = "rooms"
rooms = {scenes}
[machine]
variant = "triway"
form = "local"
H1 = 200
H2 = 0
K = 32
G = 8
[objects]
epochs = 1
[objective]
name = "relations"
[training]
epochs = 2
batch_size = 64
threads = 1
"""


def main(
    processes: Annotated[int, typer.Option(min=2, help="number of processes")] = 2,
    scenes: Annotated[int, typer.Option(min=100, help="number of generated rooms")] = 4000,
    rounds: Annotated[int, typer.Option(min=1, help="number of rounds")] = 3,
) -> None:
    """Measure the time of an epoch."""
    ratios = []
    for _ in range(rounds):
        one, several = _epoch(1, scenes), _epoch(processes, scenes)
        ratios.append(several / one)
        print(
            f"1 process {one:.2f} s, {processes} processes {several:.2f} s, ratio {ratios[-1]:.2f}"
        )
    verdict = "met" if median(ratios) <= AIM else "MISSED"
    print(f"median ratio {median(ratios):.2f}; aim for two processes {AIM}: {verdict}")


def _epoch(processes: int, scenes: int) -> float:
    """Return the seconds of the second epoch."""
    start = ["-m"]
    if processes > 1:
        start += ["torch.distributed.run", f"--nproc-per-node={processes}", "-m"]
    with TemporaryDirectory() as folder:
        config = Path(folder) / "processes.toml"
        config.write_text(_CONFIG.format(scenes=scenes), "utf-8")
        runs = Path(folder) / "runs"
        subprocess.run(
            [sys.executable, *start, "training", "train", str(config), "--runs", str(runs)],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=True,
        )
        (curve,) = runs.rglob("curve.csv")
        with curve.open(encoding="utf-8") as file:
            return float([*csv.DictReader(file)][-1]["seconds"])


if __name__ == "__main__":
    typer.run(main)
