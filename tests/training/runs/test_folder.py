import csv
import re
from pathlib import Path

import pytest
import torch

from tests.training.commands import invoke, small_config, write_config
from training.fit.relation_weights import RelationFit
from training.fit.trainer import CurvePoint, TrainingResult
from training.machines import MachineSpec, Triway, build
from training.runs import folder as folders
from training.runs.folder import RunError, load_run, save_run

CONFIG = small_config()
CURVE = [CurvePoint("objects", 1.0, 2.0, 0.5, 1.0), CurvePoint("relations", 1.0, 9.0, 0.25, 1.0)]


def result(weight: float = 1.0) -> TrainingResult:
    machine = build(MachineSpec("triway", V=3, A=4, units=2, K=2, N=0))
    torch.nn.init.constant_(machine.W, weight)
    return TrainingResult(machine, CURVE, 2.0)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_finished_run_is_read_back_and_replaced(tmp_path):
    folder = tmp_path / "runs/seed-0"
    with pytest.raises(RunError, match="no finished run"):
        load_run(folder)
    for weight in (1.0, 2.0):
        expected = result(weight)
        save_run(folder, CONFIG, expected)
        run = load_run(folder)
        assert run.config == CONFIG
        assert isinstance(run.machine, Triway)
        torch.testing.assert_close(run.machine.state_dict(), expected.machine.state_dict())
    with (folder / "curve.csv").open() as file:
        assert [row["phase"] for row in csv.DictReader(file)] == ["objects", "relations"]
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert list(folder.parent.iterdir()) == [folder]


@pytest.mark.parametrize("moves", [None, 0, 1], ids=["writing", "before", "between"])
def test_an_interrupted_save_keeps_the_run(tmp_path, monkeypatch, moves):
    """Ctrl-C while the files are written, or before one of the two moves of folders."""
    folder = tmp_path / "seed-0"
    save_run(folder, CONFIG, result())
    before = contents(folder)
    rename, left = Path.rename, iter(range(moves or 0))

    def interrupted(*_):
        raise KeyboardInterrupt

    def move(path: Path, target: Path) -> None:
        if path.name != "old" and next(left, None) is None:
            interrupted()
        rename(path, target)

    with monkeypatch.context() as patch:
        if moves is None:
            patch.setattr(folders, "write_plot", interrupted)
        patch.setattr(Path, "rename", move)
        with pytest.raises(KeyboardInterrupt):
            save_run(folder, CONFIG, result(2.0))
    assert contents(folder) == before
    assert list(tmp_path.iterdir()) == [folder]


def test_ctrl_c_keeps_the_last_finished_run(tmp_path, monkeypatch):
    config = write_config(tmp_path / "rooms.toml", CONFIG)
    runs = tmp_path / "runs"
    command = "train", config, "--runs", runs
    epoch = RelationFit.epoch

    def interrupted(self, progress):
        if self.epochs == 1:
            raise KeyboardInterrupt
        return epoch(self, progress)

    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    message = "stopped; finished runs and published versions stay as they were"
    assert message in invoke(*command, code=130)
    assert not runs.exists()
    monkeypatch.setattr(RelationFit, "epoch", epoch)
    shown = invoke(*command)
    scores = r"objects: MRR 0\.\d{3}, relations: R-precision 0\.\d{3}"
    assert re.search(rf"trained in \d+ s; {scores}", shown)
    folder = runs / "rooms-triway/seed-0"
    before = contents(folder)
    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    output = invoke(*command, "--publish", "1.0.0", "--store", tmp_path / "store", code=130)
    assert message in output
    assert "Traceback" not in output
    assert contents(folder) == before
    assert list(folder.parent.iterdir()) == [folder]
    assert not (tmp_path / "store").exists()
