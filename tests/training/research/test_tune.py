"""The tune command end to end on generated rooms: what it repeats and writes."""

from __future__ import annotations

from dataclasses import replace

import pytest
from optuna import TrialPruned
from optuna.distributions import FloatDistribution

from tests.training.commands import invoke, small_config, write_config
from training.fit.relations import RelationFit
from training.fit.trainer import Trainer
from training.research.tune import Search
from training.runs.config_files import load_config
from training.runs.pipeline import prepare

SPACE = '"machine.units" = { low = 4, high = 5 }\n'


def arguments(folder, *, space=SPACE):
    path = folder / "space.toml"
    path.write_text(space)
    config = write_config(folder / "config.toml", small_config())
    return "tune", config, "--space", path, "--folder", folder / "tuning", "--length", "0.5"


def search_in(folder):
    """A search of one learning rate. Test scenes are never looked at."""
    arguments(folder)
    config = load_config(str(folder / "config.toml"))
    data = replace(prepare(config, folder).training_data(), test=None)
    return Search(folder / "study", config, data, rate(0.03))


def rate(value):
    return {"objects.learning_rate": FloatDistribution(value, value)}


def test_the_same_command_repeats_its_trials_and_writes_the_best(tmp_path, monkeypatch):
    output = invoke(*arguments(tmp_path), "--trials", "2")
    path = tmp_path / "tuning/rooms-triway/best.toml"
    config = load_config(str(path))
    assert config.name == "rooms-triway-tuned"
    assert config.objects.steps == small_config().objects.steps
    assert config.machine.units in (3, 4, 5)
    assert path.read_text().startswith("# rooms-triway, ")
    monkeypatch.setattr(Trainer, "run", None)
    assert invoke(*arguments(tmp_path), "--trials", "2") == output


def test_an_interrupted_search_keeps_its_finished_trials(tmp_path, monkeypatch):
    epoch, epochs = RelationFit.epoch, []

    def interrupted(self, progress):
        if len(epochs) == 1:  # the relations of the first trial
            epochs.append(None)
            raise KeyboardInterrupt
        epochs.append(self.machine.spec.units)
        return epoch(self, progress)

    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    search = (*arguments(tmp_path, space='"machine.units" = [4]\n'), "--trials", "1")
    assert "to continue" in invoke(*search, code=130)
    invoke(*search)
    assert epochs == [3, None, 4]  # the unchanged machine is trained once


def test_bad_requests_are_refused_before_anything_runs(tmp_path):
    unknown = arguments(tmp_path, space='"objects.rate" = [0.1]')
    assert "no setting 'objects.rate'" in invoke(*unknown, code=1)
    assert not (tmp_path / "tuning").exists()
    _, config, *_ = arguments(tmp_path)
    assert "Pass a TOML file with --space" in invoke("tune", config, code=1)


@pytest.mark.slow
def test_diverging_trials_and_trials_below_the_median_are_given_up(tmp_path):
    search = search_in(tmp_path)
    study = search.run(5, 0)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 5
    assert set(study.trials[-1].intermediate_values) == {50, 100, 150, 200}
    for value in (1e-6, 1e30):
        trial = study.ask(rate(value))
        with pytest.raises(TrialPruned):
            search.value_of(trial)
