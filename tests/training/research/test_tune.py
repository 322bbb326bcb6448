"""The tune command end to end on generated rooms: what it records, resumes and writes."""

from __future__ import annotations

from dataclasses import replace

import optuna
import pytest
from optuna.distributions import FloatDistribution
from optuna.storages.journal import JournalFileBackend

from tests.training.commands import invoke, small_config, write_config
from training.fit.relations import RelationFit
from training.fit.trainer import Trainer
from training.research.tune import Search
from training.runs.config_files import load_config
from training.runs.pipeline import prepare

SPACE = '"objects.learning_rate" = [0.03, 1e30]\n"machine.units" = { low = 4, high = 5 }\n'


def arguments(folder, *, rooms=60, space=SPACE):
    path = folder / "space.toml"
    path.write_text(space)
    config = write_config(folder / "config.toml", small_config(rooms=rooms))
    return "tune", config, "--space", path, "--folder", folder / "tuning", *("--length", "0.5")


def recorded(folder):
    backend = JournalFileBackend(str(folder / "tuning/rooms-triway/study.log"))
    storage = optuna.storages.JournalStorage(backend)
    return optuna.load_study(study_name="rooms-triway", storage=storage).trials


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished search of three trials beside the configuration as it is."""
    folder = tmp_path_factory.mktemp("tune")
    invoke(*arguments(folder), "--trials", "3")
    return folder


def test_every_trial_is_recorded(finished):
    trials = recorded(finished)
    diverges = [trial.params["objects.learning_rate"] == 1e30 for trial in trials]
    assert len(trials) == 3
    assert len({*diverges}) == 2
    for trial, is_diverging in zip(trials, diverges, strict=True):
        assert trial.state.name == ("PRUNED" if is_diverging else "COMPLETE")
        if not is_diverging:
            assert set(trial.intermediate_values) == {100, 200}


def test_the_best_configuration_loads_and_keeps_its_own_steps(finished):
    path = finished / "tuning/rooms-triway/best.toml"
    config = load_config(str(path))
    assert config.name == "rooms-triway-tuned"
    assert config.objects.steps == small_config().objects.steps
    assert config.machine.units in (3, *(t.params["machine.units"] for t in recorded(finished)))
    assert path.read_text().startswith("# rooms-triway, ")


def test_the_same_command_runs_nothing_again(finished, monkeypatch):
    before = [trial.params for trial in recorded(finished)]
    monkeypatch.setattr(Trainer, "run", None)
    invoke(*arguments(finished), "--trials", "3")
    assert [trial.params for trial in recorded(finished)] == before


def test_an_interrupted_search_goes_on_within_its_trial(tmp_path, monkeypatch):
    epoch, epochs = RelationFit.epoch, []

    def interrupted(self, progress):
        if len(epochs) == 1:  # the relations of the first trial
            epochs.append(None)
            raise KeyboardInterrupt
        epochs.append(self.machine.spec.units)
        return epoch(self, progress)

    space = '"machine.units" = [4]\n'
    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    search = (*arguments(tmp_path, space=space), "--trials", "1")
    assert "to continue" in invoke(*search, code=130)
    invoke(*search)
    assert epochs == [3, None, 4]
    finished = recorded(tmp_path)[-1]
    assert (finished.params, finished.state.name) == ({"machine.units": 4}, "COMPLETE")
    assert set(finished.intermediate_values) == {100, 200}
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
    assert "another configuration or other scenes" in output


@pytest.mark.slow
def test_a_trial_below_the_median_is_given_up(tmp_path):
    """Test scenes are never looked at: training and judging go as well without any."""
    arguments(tmp_path)
    config = load_config(str(tmp_path / "config.toml"))
    data = replace(prepare(config, tmp_path).training_data(), test=None)
    space = {"objects.learning_rate": FloatDistribution(0.03, 0.03)}
    search = Search(tmp_path / "study", config, data, space)
    study = search.open("scenes")
    search.run(study, 5, 0)
    search.space["objects.learning_rate"] = FloatDistribution(1e-6, 1e-6)
    with pytest.raises(optuna.TrialPruned):
        search.value_of(study.ask(search.space))
