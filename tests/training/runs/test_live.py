"""The displays of a training run."""

from __future__ import annotations

import io
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.training.commands import invoke, small_config, write_config
from training.fit.checkpoint import save_checkpoint
from training.fit.configuration import Config
from training.fit.trainer import Trainer
from training.runs.config_files import with_settings
from training.runs.live import Display, next_steps, sparkline, summarise
from training.runs.pipeline import prepare

ROOT = Path(__file__).parents[3]


def small(epochs: int) -> Config:
    return with_settings(small_config("live", "rbm"), {"relations.epochs": epochs})


def test_a_sparkline_rises_with_its_values() -> None:
    assert sparkline([0, 1, 2, 3, 4, 5, 6, 7]) == "▁▂▃▄▅▆▇█"
    assert sparkline([5.0]) == sparkline([math.nan, 3.0]) == "▁"
    assert sparkline([]) == sparkline([math.nan]) == ""
    assert len(sparkline(range(1000), width=30)) <= 30
    assert sparkline(list(range(100)), width=10) == sparkline(list(range(10)), width=10)


def test_a_run_shows_its_scores_and_the_next_commands(tmp_path) -> None:
    config = small(4)
    trainer = Trainer(config, prepare(config, tmp_path).training_data(), tmp_path)
    console = Console(file=io.StringIO(), width=200, force_terminal=True)
    with Display(trainer, console, tmp_path / "logs") as display:
        result = trainer.run(display.progress, display.passed)
    summarise(result, trainer, tmp_path, console)
    next_steps(tmp_path, console)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", console.file.getvalue())
    objects = [point for point in result.curve if point.phase == "objects"]
    assert [point.done for point in objects] == [0.5, 1.0]
    last = result.curve[-1]
    assert f"relations 100%, R-precision {result.curve[-2].score:.3f}" in shown
    assert re.search(rf"relations, R-precision.* {last.score:.3f} ", shown)
    assert f"trained in {result.seconds:.0f} s" in shown
    assert f"compare {tmp_path}" in shown
    assert f"publish {tmp_path}" in shown

    events = EventAccumulator(str(tmp_path / "logs" / "live" / "seed-0"))
    events.Reload()
    logged = events.Scalars("objects/score")
    assert [point.step for point in logged] == [500, 1000]
    assert [point.value for point in logged] == pytest.approx(
        [point.score for point in objects], abs=1e-6
    )
    assert len(events.Scalars("relations/loss")) == 4


@pytest.mark.slow
def test_tensorboard_is_imported_only_for_logs() -> None:
    code = "import sys; import training.cli; assert 'torch.utils.tensorboard' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize(
    ("kept", "position"), [(0, "0% of the objects"), (3, "25% of the relations")]
)
def test_ctrl_c_during_a_checkpoint_names_the_last_complete_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int, position: str
) -> None:
    config = write_config(tmp_path / "live.toml", small(4))
    saved: list[Path] = []

    def save(path: Path, state: dict[str, Any]) -> None:
        if len(saved) == kept:
            raise KeyboardInterrupt
        saved.append(path)
        save_checkpoint(path, state)

    monkeypatch.setattr("training.fit.trainer.save_checkpoint", save)
    output = invoke("train", config, "--runs", tmp_path, code=130)
    assert f"stopped after {position};" in output
