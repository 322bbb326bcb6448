"""Nobody is asked about scenes that he has learnt from."""

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
    # Whatever is not None stands for a model here: only its split is looked at.
    return Candidate(title, config(**data), learnt, artifact="a model")  # type: ignore[arg-type]


def ids(scenes) -> set[str]:
    return {scene.scene_id for scene in scenes}


def learnt_groups(seed: int, protocol) -> set[str]:
    parts = split(SCENES["rooms"], seed=seed, protocol=protocol)
    return {scene.group for part in ("train", "validation") for scene in parts[part]}


@pytest.mark.parametrize("protocol", ["group", "stable"])
def test_of_one_split_all_test_scenes_are_asked_about(tmp_path, protocol) -> None:
    a, b = candidate("a", split=protocol), candidate("b", split=protocol)
    found = held_out(a, b, SCENES, tmp_path)
    test = split(SCENES["rooms"], seed=0, protocol=protocol)["test"]
    assert ids(found.scenes) == ids(test)
    assert found.certain
    assert not found.notes


@pytest.mark.parametrize(
    "protocols", [("stable", "stable"), ("stable", "group"), ("group", "group")]
)
def test_of_two_splits_what_either_learnt_is_left_out(tmp_path, protocols) -> None:
    a, b = candidate("a", split=protocols[0]), candidate("b", split=protocols[1], split_seed=1)
    found = held_out(a, b, SCENES, tmp_path)
    groups = {scene.group for scene in found.scenes}
    assert groups
    assert not groups & learnt_groups(0, protocols[0])
    assert not groups & learnt_groups(1, protocols[1])
    assert found.certain
    assert any("left out" in note for note in found.notes)


def test_an_earlier_version_of_the_data_is_no_matter_where_the_split_is_stable(tmp_path) -> None:
    before = candidate("before", {"rooms": "0" * 64}, split="stable")
    found = held_out(candidate("now", split="stable"), before, SCENES, tmp_path)
    assert found.certain
    assert {stable_part(scene.group, 0) for scene in found.scenes} == {"test"}


def test_another_version_of_the_data_without_a_stable_split_is_uncertain(tmp_path) -> None:
    before = candidate("before", {"rooms": "0" * 64}, split="group")
    found = held_out(candidate("now", split="stable"), before, SCENES, tmp_path)
    assert not found.certain
    assert any("may have learnt from these" in note for note in found.notes)


def test_a_model_of_other_sources_has_seen_nothing(tmp_path) -> None:
    found = held_out(
        candidate("a", split="stable"),
        candidate("b", {"kitchens": "1" * 64}, split="group"),
        SCENES,
        tmp_path,
    )
    assert found.certain
    assert any("other data sources (kitchens)" in note for note in found.notes)
    assert held_out(candidate("a"), REFERENCE, SCENES, tmp_path).certain


def test_the_first_side_must_record_its_split(tmp_path) -> None:
    with pytest.raises(ConfigError, match="does not record the split of its scenes"):
        held_out(REFERENCE, candidate("b"), SCENES, tmp_path)
