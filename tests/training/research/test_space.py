"""Search spaces: what is read from TOML, and what is refused."""

from __future__ import annotations

import pytest

from tests.training.commands import small_config
from training.fit.configuration import ConfigError
from training.research.tune import load_space
from training.runs.config_files import load_config, shipped_files

CONFIG = small_config()


def read(folder, text):
    path = folder / "space.toml"
    path.write_text(text)
    return load_space(path, CONFIG)


@pytest.mark.parametrize("name", shipped_files("spaces"))
def test_shipped_spaces_fit_their_configurations(name):
    assert load_space(shipped_files("spaces")[name], load_config(name))


def test_choices_and_intervals_are_read(tmp_path):
    space = read(
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
def test_bad_spaces_say_what_is_wrong(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, text)
