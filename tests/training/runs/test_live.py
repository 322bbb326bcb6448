"""The displays of a training run."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.training.commands import invoke, small_config, write_config
from training.fit.checkpoint import save_checkpoint
from training.fit.trainer import Trainer
from training.runs.config_files import with_settings
from training.runs.live import Display, summarise
from training.runs.pipeline import prepare

CONFIG = with_settings(small_config("live", "rbm"), {"relations.epochs": 4})


def test_a_run_shows_its_scores(tmp_path) -> None:
    trainer = Trainer(CONFIG, prepare(CONFIG, tmp_path).training_data(), tmp_path)
    console = Console(file=io.StringIO(), width=200, force_terminal=True)
    with Display(trainer, console) as display:
        result = trainer.run(display.progress)
    summarise(result, tmp_path, console)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", console.file.getvalue())
    before, last = (point.score for point in result.curve[-2:])
    assert f"relations 100%, R-precision {before:.3f}" in shown
    assert f"relations: R-precision {last:.3f}" in shown
    assert f"trained in {result.seconds:.0f} s" in shown


@pytest.mark.parametrize(
    ("kept", "position"), [(0, "0% of the objects"), (3, "25% of the relations")]
)
def test_ctrl_c_during_a_checkpoint_names_the_last_complete_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int, position: str
) -> None:
    config = write_config(tmp_path / "live.toml", CONFIG)
    saved: list[Path] = []

    def save(path: Path, state: dict[str, Any]) -> None:
        if len(saved) == kept:
            raise KeyboardInterrupt
        saved.append(path)
        save_checkpoint(path, state)

    monkeypatch.setattr("training.fit.trainer.save_checkpoint", save)
    output = invoke("train", config, "--runs", tmp_path, code=130)
    assert f"stopped after {position};" in output
