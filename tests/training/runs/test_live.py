"""The displays of a training run."""

from __future__ import annotations

import io
import re

from rich.console import Console

from tests.training.commands import small_config
from training.fit.trainer import Trainer
from training.runs.config_files import with_settings
from training.runs.live import Display, summarise
from training.runs.pipeline import prepare

CONFIG = with_settings(small_config("live", "rbm"), {"relations.epochs": 4})


def test_a_run_shows_its_scores(tmp_path) -> None:
    trainer = Trainer(CONFIG, prepare(CONFIG, tmp_path).training_data())
    console = Console(file=io.StringIO(), width=200, force_terminal=True)
    with Display(trainer, console) as display:
        result = trainer.run(display.progress)
    summarise(result, tmp_path, console)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", console.file.getvalue())
    before, last = (point.score for point in result.curve[-2:])
    assert f"relations 100%, R-precision {before:.3f}" in shown
    assert f"relations: R-precision {last:.3f}" in shown
    assert f"trained in {result.seconds:.0f} s" in shown
