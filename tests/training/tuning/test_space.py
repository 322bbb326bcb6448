"""Search spaces: what is read from TOML, what is drawn, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from training.config import Config, ConfigError, load_config, with_settings
from training.tuning import Interval, load_space, proposals, shipped_spaces

CONFIG = Config.model_validate(
    {
        "name": "rooms-triway",
        "data": {"sources": ["rooms"], "vocabulary": "rooms", "rooms": 60},
        "machine": {"variant": "triway", "form": "local", "H1": 8, "H2": 0, "K": 4},
        "objective": {"name": "composite"},
    }
)
SPACE = {
    "machine.H1": Interval(low=4, high=6),
    "objective.presence_weight": Interval(low=0.01, high=1.0, log=True),
    "training.averaging": [0.0, 0.9],
}


@pytest.mark.parametrize("name", shipped_spaces())
def test_shipped_spaces_fit_their_configurations(name):
    config, space = load_config(name), load_space(shipped_spaces()[name])
    assert len(proposals(config, space, seed=0, count=50)) == 50


def test_draws_stay_within_the_space():
    drawn = proposals(CONFIG, SPACE, seed=0, count=400)
    sizes = [settings["machine.H1"] for settings in drawn]
    assert {4, 5, 6} == set(sizes)
    assert min(sizes.count(size) for size in (4, 5, 6)) > 90
    weights = np.array([settings["objective.presence_weight"] for settings in drawn])
    assert weights.min() >= 0.01
    assert weights.max() <= 1.0
    # By its logarithm: half of them below the geometric mean of the bounds.
    assert 0.4 < (weights < math.sqrt(0.01 * 1.0)).mean() < 0.6
    assert {settings["training.averaging"] for settings in drawn} == {0.0, 0.9}


def test_more_draws_begin_with_the_same_ones_and_another_seed_draws_others():
    few, many = (proposals(CONFIG, SPACE, seed=0, count=count) for count in (5, 12))
    assert many[:5] == few
    assert proposals(CONFIG, SPACE, seed=1, count=5) != few


def test_a_small_space_is_drawn_to_its_end_without_repeating():
    space = {"machine.K": [2, 3], "machine.H1": Interval(low=1, high=3)}
    drawn = proposals(CONFIG, space, seed=0, count=100)
    assert len({tuple(settings.values()) for settings in drawn}) == len(drawn) == 6


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"training.rate": [0.1]}, "no setting 'training.rate': training has optimiser"),
        ({"epochs": [3]}, "no setting 'epochs': name it section.entry"),
        ({"name.x": [3]}, "name it section.entry"),
        ({"training.epochs": [0]}, "training.epochs: Input should be greater"),
        ({"training.seed": [0, 1]}, "'training.seed' is no setting to search"),
        ({"data.limit": [20]}, "'data.limit' is no setting to search"),
        ({"machine.form": ["seed"], "objective.generative_weight": [0.1]}, "local form only"),
    ],
)
def test_settings_that_cannot_be_tried_are_named(space, message):
    with pytest.raises(ConfigError, match=message):
        proposals(CONFIG, space, seed=0, count=2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('"machine.H1" = [', "is not TOML"),
        ('"machine.H1" = 3', "write a list of choices, or"),
        ('"machine.H1" = []', "write a list of choices, or"),
        ('"machine.H1" = { low = 3 }', "machine.H1.high: Field required"),
        ('"machine.H1" = { low = 3, high = 2 }', "low must be below high"),
        ('"machine.H1" = { low = 0, high = 2, log = true }', "must be positive"),
        ('"machine.H1" = { low = "a", high = 2 }', "machine.H1.low"),
        ("", "names no setting"),
    ],
)
def test_bad_spaces_say_what_is_wrong(tmp_path, text, message):
    path = tmp_path / "space.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_space(path)


def test_a_missing_space_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"no search space .*nowhere.toml"):
        load_space(tmp_path / "nowhere.toml")


def test_changed_settings_leave_the_rest_alone():
    changed = with_settings(CONFIG, {"machine.H1": 5, "training.patience": 2})
    assert (changed.machine.H1, changed.training.patience) == (5, 2)
    assert with_settings(changed, {"machine.H1": 8, "training.patience": None}) == CONFIG
