from dataclasses import replace

import pytest
from optuna import TrialPruned
from optuna.distributions import FloatDistribution

from tests.training.commands import invoke, small_config, write_config
from training.fit.configuration import ConfigError
from training.fit.trainer import Trainer
from training.research.tune import Search, load_space
from training.runs.config_files import load_config, shipped_files
from training.runs.pipeline import prepare

SPACE = '"machine.units" = { low = 4, high = 5 }\n'


def arguments(folder, *, space=SPACE):
    path = folder / "space.toml"
    path.write_text(space)
    config = write_config(folder / "config.toml", small_config())
    return "tune", config, "--space", path, "--folder", folder / "tuning", "--length", "0.5"


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


def test_bad_requests_are_refused_before_anything_runs(tmp_path):
    unknown = arguments(tmp_path, space='"objects.rate" = [0.1]')
    assert "no setting 'objects.rate'" in invoke(*unknown, code=1)
    assert not (tmp_path / "tuning").exists()
    _, config, *_ = arguments(tmp_path)
    assert "Pass a TOML file with --space" in invoke("tune", config, code=1)


@pytest.mark.slow
def test_diverging_trials_and_trials_below_the_median_are_given_up(tmp_path):
    """A search of one learning rate. Test scenes are never looked at."""
    config = small_config()
    data = replace(prepare(config, tmp_path).training_data(), test=None)
    search = Search(tmp_path / "study", config, data, rate(0.03))
    study = search.run(5, 0)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 5
    assert set(study.trials[-1].intermediate_values) == {50, 100, 150, 200}
    for value in (1e-6, 1e30):
        trial = study.ask(rate(value))
        with pytest.raises(TrialPruned):
            search.value_of(trial)


def read_space(folder, text):
    path = folder / "space.toml"
    path.write_text(text)
    return load_space(path, small_config())


@pytest.mark.parametrize("name", shipped_files("spaces"))
def test_shipped_spaces_fit_their_configurations(name):
    assert load_space(shipped_files("spaces")[name], load_config(name))


def test_choices_and_intervals_are_read(tmp_path):
    space = read_space(
        tmp_path,
        '"machine.units" = { low = 4, high = 6 }\n"relations.averaging" = [0.0, 0.9]\n'
        '"objects.weight_prior" = { low = 0.01, high = 1.0, log = true }\n',
    )
    sizes, averages, weights = space.values()
    assert (sizes.low, sizes.high) == (4, 6)
    assert averages.choices == (0.0, 0.9)
    assert (weights.low, weights.high, weights.log) == (0.01, 1.0, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('"objects.rate" = [0.1]', "no setting 'objects.rate': objects has steps"),
        ('"epochs" = [3]', "no setting 'epochs': name it section.entry"),
        ('"objects.steps" = [0]', "objects.steps: Input should be greater"),
        ('"training.seed" = [0, 1]', "'training.seed' must be equal in all trials"),
        ('"data.limit" = [20]', "'data.limit' must be equal in all trials"),
        ('"machine.units" = [', "is not TOML"),
        ('"machine.units" = 3', "write a list of choices, or"),
        ('"machine.units" = { low = 3 }', "machine.units: high: Field required"),
        ('"machine.units" = { low = 3, high = 2 }', "low must be below high"),
        ('"machine.units" = { low = 0, high = 2, log = true }', "low"),
        ("", "contains no settings"),
    ],
)
def test_invalid_spaces_are_refused_with_the_reason(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        read_space(tmp_path, text)
