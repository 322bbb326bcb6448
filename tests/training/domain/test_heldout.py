"""Two models are compared on scenes that neither has learnt from."""

from __future__ import annotations

import pytest

from training.datasets import generate_rooms, split
from training.datasets.records import digest_of
from training.datasets.splits import stable_part
from training.domain.candidates import BASELINES, Candidate, held_out
from training.fit.configuration import Config, ConfigError

SCENES = {"rooms": generate_rooms(500, 0)}
REFERENCE = Candidate(BASELINES, None, {}, None)
LEARNT = {"rooms": digest_of(SCENES["rooms"])}


def config(**data) -> Config:
    return Config.model_validate(
        {
            "name": "rooms",
            "data": {"sources": ["rooms"], "vocabulary": "rooms", "rooms": 500, **data},
            "machine": {"variant": "rbm"},
        }
    )


def candidate(title: str, learnt=LEARNT, **data) -> Candidate:
    # Any artifact except None stands for a model, because only its split matters.
    return Candidate(title, config(**data), learnt, artifact="a model")  # type: ignore[arg-type]


def learnt_groups(seed: int, protocol) -> set[str]:
    parts = split(SCENES["rooms"], seed=seed, protocol=protocol)
    return {scene.group for part in ("train", "validation") for scene in parts[part]}


@pytest.mark.parametrize("protocol", ["group", "stable"])
def test_of_equal_splits_all_test_scenes_are_held_out(tmp_path, protocol) -> None:
    a, b = candidate("a", split=protocol), candidate("b", split=protocol)
    found = held_out(a, b, SCENES, tmp_path)
    assert found.scenes == split(SCENES["rooms"], seed=0, protocol=protocol)["test"]
    assert found.certain
    assert not found.notes


@pytest.mark.parametrize(
    "protocols", [("stable", "stable"), ("stable", "group"), ("group", "group")]
)
def test_of_two_splits_scenes_that_either_model_learnt_are_left_out(tmp_path, protocols) -> None:
    a, b = candidate("a", split=protocols[0]), candidate("b", split=protocols[1], split_seed=1)
    found = held_out(a, b, SCENES, tmp_path)
    groups = {scene.group for scene in found.scenes}
    assert groups
    assert not groups & (learnt_groups(0, protocols[0]) | learnt_groups(1, protocols[1]))
    assert found.certain
    assert any("left out" in note for note in found.notes)


@pytest.mark.parametrize("protocol", ["stable", "group"])
def test_after_a_change_of_the_data_only_a_stable_split_is_certain(tmp_path, protocol) -> None:
    before = candidate("before", {"rooms": "0" * 64}, split=protocol)
    found = held_out(candidate("now", split="stable"), before, SCENES, tmp_path)
    assert found.certain == (protocol == "stable")
    assert {stable_part(scene.group, 0) for scene in found.scenes} == {"test"}
    uncertain = any("may have learnt from these" in note for note in found.notes)
    assert uncertain == (protocol == "group")


def test_a_model_of_other_sources_learnt_none_of_the_scenes(tmp_path) -> None:
    other = candidate("b", {"kitchens": "1" * 64}, split="group")
    found = held_out(candidate("a", split="stable"), other, SCENES, tmp_path)
    assert found.certain
    assert any("other data sources (kitchens)" in note for note in found.notes)
    assert held_out(candidate("a"), REFERENCE, SCENES, tmp_path).certain


def test_the_first_model_must_record_its_split_and_have_test_scenes(tmp_path) -> None:
    with pytest.raises(ConfigError, match="does not record the split of its scenes"):
        held_out(REFERENCE, candidate("b"), SCENES, tmp_path)
    final = candidate("a", split="final")
    with pytest.raises(ConfigError, match="trained with --final"):
        held_out(final, final, SCENES, tmp_path)
