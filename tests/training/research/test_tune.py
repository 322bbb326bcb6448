"""The tune command end to end on generated rooms: what it records, resumes and writes."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import optuna
import pytest
from optuna.distributions import CategoricalDistribution
from optuna.storages.journal import JournalFileBackend

from tests.training.commands import invoke, small_config, write_config
from training.fit.relations import RelationFit
from training.fit.trainer import Trainer
from training.research.tune import Search
from training.runs.config_files import load_config
from training.runs.pipeline import prepare

ROOT = Path(__file__).resolve().parents[3]
SHORT = ("--length", "0.5", "--no-prune")
SPACE = '"objects.learning_rate" = [0.03, 1e30]\n"machine.units" = { low = 4, high = 5 }\n'


def arguments(folder, *, rooms=60, space=SPACE):
    path = folder / "space.toml"
    path.write_text(space)
    config = write_config(folder / "config.toml", small_config(rooms=rooms))
    return "tune", config, "--space", path, "--folder", folder / "tuning", *SHORT


def recorded(place):
    journal = place / "tuning/rooms-triway/study.log" if place.is_dir() else place
    backend = JournalFileBackend(str(journal))
    storage = optuna.storages.JournalStorage(backend)
    trials = optuna.load_study(study_name="rooms-triway", storage=storage).trials
    return [trial for trial in trials if "settings" in trial.user_attrs]


def settings_of(folder):
    return [trial.user_attrs["settings"] for trial in recorded(folder)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished search of three trials beside the configuration as it is."""
    folder = tmp_path_factory.mktemp("tune")
    invoke(*arguments(folder), "--trials", "3")
    return folder


def test_every_trial_is_recorded(finished):
    first, *others = recorded(finished)
    assert first.user_attrs["settings"] == {}
    assert len(others) == 3
    fails = [t.user_attrs["settings"].get("objects.learning_rate") == 1e30 for t in others]
    assert len({*fails}) == 2
    for trial, diverges in zip((first, *others), (False, *fails), strict=True):
        assert trial.state.name == ("FAIL" if diverges else "COMPLETE")
        assert bool(trial.user_attrs["reason"]) == diverges
        if not diverges:
            assert set(trial.user_attrs["figures"]) == {"MRR", "R-precision"}
            assert set(trial.intermediate_values) == {100, 200}


def test_the_best_configuration_loads_and_keeps_its_own_steps(finished):
    best = max(
        (trial for trial in recorded(finished) if trial.value is not None),
        key=lambda trial: trial.value,
    )
    path = finished / "tuning/rooms-triway/best.toml"
    config = load_config(str(path))
    assert config.name == "rooms-triway-tuned"
    assert config.objects.steps == small_config().objects.steps
    assert best.user_attrs["settings"].get("machine.units", 3) == config.machine.units
    assert path.read_text().startswith("# rooms-triway, ")


def test_the_same_command_runs_nothing_again(finished, monkeypatch):
    before = settings_of(finished)
    monkeypatch.setattr(Trainer, "run", None)
    invoke(*arguments(finished), "--trials", "3")
    assert settings_of(finished) == before


def test_an_interrupted_search_goes_on_within_its_trial(tmp_path, monkeypatch):
    epoch, epochs = RelationFit.epoch, []

    def interrupted(self, progress):
        if len(epochs) == 1:  # the relations of the second trial
            epochs.append(None)
            raise KeyboardInterrupt
        epochs.append(self.machine.spec.units)
        return epoch(self, progress)

    space = '"machine.units" = [4]\n'
    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    search = (*arguments(tmp_path, space=space), "--trials", "1")
    assert "to continue" in invoke(*search, code=130)
    assert settings_of(tmp_path) == [{}]
    invoke(*search)
    assert epochs == [3, None, 4]
    assert settings_of(tmp_path) == [{}, {"machine.units": 4}]
    assert not list(tmp_path.rglob("checkpoint.pt"))


def test_bad_requests_are_refused_before_anything_runs(tmp_path):
    unknown = arguments(tmp_path, space='"objects.rate" = [0.1]')
    assert "no setting 'objects.rate'" in invoke(*unknown, code=1)
    assert not (tmp_path / "tuning").exists()
    _, config, *_ = arguments(tmp_path)
    assert "Pass a TOML file with --space" in invoke("tune", config, code=1)


def test_other_scenes_are_another_search(finished, tmp_path):
    other = arguments(tmp_path, rooms=70)
    output = invoke(*other, "--folder", finished / "tuning", code=1)
    assert "another configuration, scenes or metric" in output


@pytest.mark.slow
@pytest.mark.system
def test_two_processes_share_a_study(tmp_path):
    """Together they run as many trials as asked, each trial once."""
    space = '"objects.learning_rate" = { low = 0.001, high = 0.1, log = true }\n'
    command = (sys.executable, "-m", "training", *map(str, arguments(tmp_path, space=space)))
    journal = tmp_path / "shared.log"
    both = [
        subprocess.Popen([*command, "--trials", "5", "--study", str(journal)], cwd=ROOT)
        for _ in range(2)
    ]
    assert [process.wait(timeout=300) for process in both] == [0, 0]
    trials = recorded(journal)
    assert [trial.user_attrs["settings"] == {} for trial in trials] == [True, *[False] * 5]
    rates = [trial.user_attrs["settings"].get("objects.learning_rate") for trial in trials]
    assert len(set(rates)) == 6
    assert len({trial.user_attrs["process"] for trial in trials}) == 2
    assert (tmp_path / "tuning/rooms-triway/best.toml").exists()


@pytest.mark.slow
def test_a_trial_below_the_median_is_given_up(tmp_path):
    """Test scenes are never looked at: training and judging go as well without any."""
    arguments(tmp_path)
    config = load_config(str(tmp_path / "config.toml"))
    data = replace(prepare(config, tmp_path).training_data(), test=None)
    space = {"objects.learning_rate": CategoricalDistribution([0.03])}
    search = Search(tmp_path / "study", config, data, space, "both", tmp_path / "study.log")
    study = search.open("scenes", 0, prune=True)
    search.run(study, 5)
    search.space = {"objects.learning_rate": CategoricalDistribution([1e-6])}
    again = search.open("scenes", 0, prune=True)
    again.sampler = optuna.samplers.RandomSampler(0)
    trial = again.ask()
    with pytest.raises(optuna.TrialPruned):
        search.value_of(trial, {"objects.learning_rate": 1e-6})
    assert 1 <= len(again.trials[-1].intermediate_values) < 4
