"""The tune command end to end on generated rooms: what it records, resumes and writes."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from training.cli import app
from training.config import load_config
from training.pipeline import prepare
from training.trainer import Trainer
from training.tuning import Study
from training.tuning.study import Trial

CONFIG = """
name = "rooms-triway"
[data]
sources = ["rooms"]
vocabulary = "rooms"
rooms = {rooms}
[machine]
variant = "triway"
form = "local"
H1 = 6
H2 = 0
K = 2
[objective]
name = "composite"
[training]
epochs = 7
"""
SPACE = '"training.learning_rate" = [0.03, 1e30]\n"machine.H1" = { low = 3, high = 5 }\n'


def arguments(folder, *, rooms=60, space=SPACE):
    config, path = folder / "config.toml", folder / "space.toml"
    config.write_text(CONFIG.format(rooms=rooms))
    path.write_text(space)
    where = ("--space", str(path), "--folder", str(folder / "tuning"))
    return "tune", str(config), *where, "--epochs", "2", "--no-prune"


def run(*arguments):
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, " ".join(result.output.split())


def quiet(*_):
    """Progress that nobody hears of."""


def recorded(folder):
    lines = (folder / "tuning/rooms-triway/trials.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished search over all six points of the space."""
    folder = tmp_path_factory.mktemp("tune")
    code, output = run(*arguments(folder), "--trials", "6")
    assert code == 0, output
    return folder


def test_every_trial_is_recorded(finished):
    first, *others = recorded(finished)
    assert first["settings"] == {}
    assert len(others) == 6
    for trial in (first, *others):
        diverges = trial["settings"].get("training.learning_rate") == 1e30
        assert trial["state"] == ("failed" if diverges else "finished")
        assert bool(trial["reason"]) == diverges
        assert trial["seconds"] >= 0
        assert trial["seed"] == 0
        if diverges:
            assert not trial["figures"]
            continue
        assert set(trial["figures"]) == {"rooms", "pooled"}
        for figure in trial["figures"]["pooled"].values():
            assert figure["low"] <= figure["value"] <= figure["high"]
            assert figure["n"] > 0
        assert len(trial["curve"]) == 2
    assert len({trial["digest"] for trial in (first, *others)}) == 7


def test_a_figure_is_that_of_all_validation_scenes(finished):
    config = load_config(str(finished / "config.toml"))
    scenes = prepare(config, finished).training_data()
    removable = (scenes.validation.v > 0) & ~scenes.structure
    objects = int(removable[removable.sum(1) >= 2].sum())
    assert recorded(finished)[0]["figures"]["pooled"]["MRR"]["n"] == objects


def test_the_best_configuration_loads_and_keeps_its_own_epochs(finished):
    trials = recorded(finished)
    best = max(
        (trial for trial in trials if trial["state"] == "finished"),
        key=lambda trial: sum(f["value"] for f in trial["figures"]["pooled"].values()),
    )
    path = finished / "tuning/rooms-triway/best.toml"
    config = load_config(str(path))
    assert config.name == "rooms-triway-tuned"
    assert config.training.epochs == 7
    assert best["settings"].get("machine.H1", 6) == config.machine.H1
    assert path.read_text().startswith("# rooms-triway, ")


def test_the_same_command_runs_nothing_again(finished, monkeypatch):
    def trained(*_):
        raise AssertionError("a finished trial was run again")

    before = recorded(finished)
    monkeypatch.setattr(Trainer, "run", trained)
    code, output = run(*arguments(finished), "--trials", "6", "--by", "mrr")
    assert code == 0, output
    assert recorded(finished) == before


def test_an_interrupted_search_goes_on_within_its_trial(tmp_path, finished, monkeypatch):
    whole, epochs = Trainer._epoch, []

    def interrupted(self, progress):
        if len(epochs) == 3:  # the second epoch of the second trial
            epochs.append(None)
            raise KeyboardInterrupt
        epochs.append((self.config.machine.H1, len(self.epochs)))
        whole(self, progress)

    space = '"machine.H1" = [4]\n'
    monkeypatch.setattr(Trainer, "_epoch", interrupted)
    code, output = run(*arguments(tmp_path, space=space), "--trials", "1")
    assert code == 130
    assert "goes on from there" in output
    assert len(recorded(tmp_path)) == 1
    # A line that a power cut left behind half-written is not a trial.
    with (tmp_path / "tuning/rooms-triway/trials.jsonl").open("a") as file:
        file.write('{"digest": "12')
    code, output = run(*arguments(tmp_path, space=space), "--trials", "1")
    assert code == 0, output
    assert epochs == [(6, 0), (6, 1), (4, 0), None, (4, 1)]
    assert [trial["settings"] for trial in recorded(tmp_path)] == [{}, {"machine.H1": 4}]
    assert not list(tmp_path.rglob("checkpoint.pt"))
    same = {"figures", "curve", "digest", "settings"}
    first, *_ = recorded(finished)
    assert {key: recorded(tmp_path)[0][key] for key in same} == {key: first[key] for key in same}


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ('"training.rate" = [0.1]', "no setting 'training.rate'"),
        ('"training.seed" = [1]', "is no setting to search"),
        ('"machine.H1" = 3', "space.toml: machine.H1"),
    ],
)
def test_bad_spaces_are_refused_before_anything_runs(tmp_path, space, message):
    code, output = run(*arguments(tmp_path, space=space))
    assert code == 1
    assert message in output
    assert not (tmp_path / "tuning").exists()


def test_other_scenes_are_another_search(finished, tmp_path):
    other = arguments(tmp_path, rooms=70)
    code, output = run(*other, "--folder", str(finished / "tuning"))
    assert code == 1
    assert "another configuration or other scenes" in output


def test_a_configuration_without_a_space_says_so(tmp_path):
    _, config, *_ = arguments(tmp_path)
    code, output = run("tune", config)
    assert code == 1
    assert "name a TOML file with --space" in output


def test_a_trial_below_the_median_is_given_up(tmp_path):
    arguments(tmp_path)
    config = load_config(str(tmp_path / "config.toml"))
    data = prepare(config, tmp_path).training_data()
    study = Study(tmp_path / "study", config, data, {}, "both")
    good = [{"training.learning_rate": 0.03, "machine.H1": size} for size in (3, 4, 5, 6)]
    for settings in good:
        assert study.run(settings, quiet, prune=False).state == "finished"
    given_up = study.run({"training.learning_rate": 1e-6}, quiet)
    assert (given_up.state, dict(given_up.figures)) == ("pruned", {})
    assert "the median of 4 trials" in given_up.reason
    assert 3 <= len(given_up.curve) < 7
    assert given_up.score("both") == -math.inf
    assert study.best is not None
    assert study.best.settings in good
    again = Study(tmp_path / "study", config, data, {}, "both")
    assert again.trials == study.trials
    assert isinstance(again.known(good[0]), Trial)


def test_test_scenes_are_never_looked_at(tmp_path):
    """Training and judging a trial go as well without any."""
    arguments(tmp_path)
    config = load_config(str(tmp_path / "config.toml"))
    data = replace(prepare(config, tmp_path).training_data(), test=None)
    study = Study(tmp_path / "study", config, data, {}, "both")
    assert study.run({"training.epochs": 1}, quiet, prune=False).state == "finished"


def test_a_difference_is_paired_and_that_of_the_pooled_figures(finished):
    config = load_config(str(finished / "config.toml"))
    short = config.model_copy(update={"training": config.training.model_copy(update={"epochs": 2})})
    scenes = prepare(config, finished)
    folder = finished / "tuning/rooms-triway"
    study = Study(folder, short, scenes.training_data(), scenes.digests, "both")
    base, best = study.known({}), study.best
    for name in ("MRR", "R-precision"):
        gap = best.figures["pooled"][name].value - base.figures["pooled"][name].value
        difference = study.difference(best, base, name)
        assert difference.value == pytest.approx(gap, abs=1e-4)
        assert difference.low <= difference.value <= difference.high
        assert study.difference(base, base, name).low == 0.0
