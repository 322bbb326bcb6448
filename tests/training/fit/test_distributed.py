"""Training in several processes: they follow one process, and resume each other's checkpoints."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from training.fit.checkpoint import Epoch
from training.fit.configuration import Config
from training.fit.trainer import Trainer
from training.machines.bernoulli import categorical, integers, uniform
from training.machines.distributed import new_generator
from training.runs.config_files import config_toml, load_config, with_settings
from training.runs.pipeline import prepare

ROOT = Path(__file__).resolve().parents[3]
ROWS, WIDTH = 7, 5

BASE = Config.model_validate(
    {
        "name": "small",
        "data": {"sources": ["rooms"], "vocabulary": "rooms", "rooms": 40},
        "machine": {"variant": "triway", "form": "local", "H1": 8, "H2": 4, "K": 3},
        "objective": {"name": "composite", "chains": 9, "k": 2},
        # 26 training scenes: three updates of 8 scenes and one of 2 in each epoch.
        "training": {"epochs": 5, "batch_size": 8, "averaging": 0.9, "device": "cpu"},
    }
)
SEED = {
    "machine.form": "seed",
    "training.optimiser": "sgd",
    "training.schedule": "constant",
    "training.learning_rate": 0.001,
}
CASES = {
    "composite": {"objective.object_dropout": 0.1, "objective.count_dropout": 0.2},
    "composite with chains": {"objective.generative_weight": 0.3},
    "relations": {"objective.name": "relations", "objects.epochs": 1, "machine.G": 2},
    "contrastive divergence, seed": {"objective.name": "contrastive_divergence", **SEED},
    "persistent chains, GBM": {"objective.name": "persistent_cd", "machine.variant": "gbm", **SEED},
}
# Trains each configuration up to an epoch, then stops as Ctrl-C does.
PART = """
import sys
from pathlib import Path
from tests.training.fit.test_distributed import train
from training.machines.distributed import process_group

with process_group():
    for config in sys.argv[4:]:
        train(config, Path(sys.argv[1]), int(sys.argv[2]), resumes=sys.argv[3] == "resume")
"""


def train(path: str, runs: Path, epochs: int, *, resumes: bool = False) -> None:
    """Train a configuration up to an epoch, in the folder `runs` / name of the file."""

    def stop(epoch: Epoch) -> None:
        if epoch.epoch + 1 == epochs:
            raise KeyboardInterrupt

    config = load_config(path)
    folder = runs / Path(path).stem
    trainer = Trainer(config, prepare(config, Path()).training_data(), folder)
    assert trainer.resume() == resumes
    with suppress(KeyboardInterrupt):
        trainer.run(ended=stop)


def torchrun(processes: int, *arguments: str) -> str:
    command = (sys.executable, "-m", "torch.distributed.run", "--standalone")
    result = subprocess.run(
        [*command, "--nproc-per-node", str(processes), *arguments],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def written(folder: Path, name: str, settings: dict[str, object]) -> str:
    path = folder / f"{name}.toml"
    path.write_text(config_toml(with_settings(BASE, settings)))
    return str(path)


def losses(folder: Path) -> list[float]:
    with (folder / "curve.csv").open() as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


@pytest.mark.slow
@pytest.mark.system
def test_two_processes_follow_one_for_20_updates(tmp_path):
    script = tmp_path / "part.py"
    script.write_text(PART)
    configs = [written(tmp_path, name, settings) for name, settings in CASES.items()]
    torchrun(2, str(script), str(tmp_path / "two"), "5", "start", *configs)
    for config, name in zip(configs, CASES, strict=True):
        train(config, tmp_path / "one", 5)
        single, split = tmp_path / "one" / name, tmp_path / "two" / name
        assert len(losses(single)) == 5
        assert losses(split) == pytest.approx(losses(single), rel=1e-4), name
        first, second = (
            torch.load(folder / "checkpoint.pt", weights_only=True)["machine"]
            for folder in (single, split)
        )
        for weight, value in first.items():
            torch.testing.assert_close(second[weight], value, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.system
def test_a_checkpoint_resumes_with_other_numbers_of_processes(tmp_path):
    """One process, then three; the last batch has fewer scenes than processes."""
    config = written(tmp_path, "chains", CASES["composite with chains"] | {"training.epochs": 4})
    script = tmp_path / "part.py"
    script.write_text(PART)
    mixed, whole = tmp_path / "mixed", tmp_path / "whole"
    train(config, whole, 4)
    train(config, mixed, 2)
    torchrun(3, str(script), str(mixed), "4", "resume", config)
    assert losses(mixed / "chains") == pytest.approx(losses(whole / "chains"), rel=1e-4)


@pytest.mark.slow
@pytest.mark.system
def test_an_error_of_the_first_process_ends_all(tmp_path):
    config = written(tmp_path, "small", CASES["relations"])
    place = tmp_path / "runs/small/seed-0"
    place.mkdir(parents=True)
    (place / "checkpoint.pt").write_bytes(b"no checkpoint")
    with pytest.raises(AssertionError, match=r"checkpoint\.pt cannot be read"):
        torchrun(2, "-m", "training", "train", config, "--runs", str(tmp_path / "runs"))


def test_one_process_draws_as_torch_does():
    weight = torch.rand(ROWS, WIDTH)
    first, second = new_generator(3), torch.Generator().manual_seed(3)
    assert torch.equal(uniform((ROWS, WIDTH), first), torch.rand(ROWS, WIDTH, generator=second))
    drawn = torch.randint(WIDTH, (ROWS,), generator=second)
    assert torch.equal(integers(WIDTH, (ROWS,), first), drawn)
    drawn = torch.multinomial(weight, 1, generator=second).squeeze(1)
    assert torch.equal(categorical(weight, first), drawn)
