from dataclasses import replace
from pathlib import Path

import pytest

from app.registry import DataSource
from app.scene import Vocabulary
from tests.training.commands import small_config
from training.datasets import generate_rooms, split
from training.datasets.records import digest_of
from training.datasets.splits import stable_part
from training.domain.candidates import BASELINES, Candidate, held_out
from training.domain.compare import COMPARED, compare
from training.fit.configuration import ConfigError
from training.fit.draft import as_stored, draft_artifact
from training.fit.objects import ObjectScenes
from training.fit.trainer import new_machine
from training.runs.pipeline import prepare
from training.runs.publish import data_sources

CONFIG = small_config("small", "rbm", rooms=120, split="stable")


@pytest.mark.parametrize("lacking", [0, 1])
def test_a_comparison_covers_all_tasks_and_notes_lacking_classes_alone(lacking) -> None:
    """The second model has the classes in another order, all of them or all but one."""
    scenes = prepare(CONFIG, Path())
    classes = list(reversed(scenes.vocabulary.objects))
    if lacking:
        classes[0] = replace(classes[0], label="unheard of", aliases=())
    data = scenes.training_data()
    objects = ObjectScenes.of(data.train, data.structure, CONFIG.objects)
    machine = new_machine(CONFIG, data, objects)
    other = Vocabulary(classes, scenes.vocabulary.room_types)
    a, b = (
        Candidate(
            title,
            CONFIG,
            data_sources(scenes),
            draft_artifact(as_stored(machine), vocabulary),
            terms="Ours.",
        )
        for title, vocabulary in (("new", scenes.vocabulary), ("old", other))
    )
    found = compare(a, b, Path(), say=lambda _: None)
    assert ["old lacks 1 of these classes" in note for note in found.notes] == [True] * lacking
    assert {row.task for row in found.results.differences} == set(COMPARED)
    summary = found.summary()
    assert summary[0] == "A learnt from 120 scenes of 1 source (rooms), all seen."
    assert summary[1].startswith(f"A knows {(~scenes.vocabulary.structure).sum()} kinds of things")
    assert summary[2].startswith(
        "With the default sensitivity, A raises a wrong alarm in 0.0 % (B:"
    )
    assert summary[3].startswith("A judges no object")
    assert summary[4].endswith("A commercial robot may use the weights under their terms: Ours.")


SCENES = {"rooms": generate_rooms(500, 0)}
REFERENCE = Candidate(BASELINES, None, (), None)
LEARNT = {"rooms": digest_of(SCENES["rooms"])}


def candidate(title: str, learnt=LEARNT, **data) -> Candidate:
    # Any artifact except None stands for a model, because only its split matters.
    config = small_config("rooms", "rbm", rooms=500, **data)
    sources = tuple(
        DataSource(source=name, scenes=1, digest=digest, terms="ours", research_only=False)
        for name, digest in learnt.items()
    )
    return Candidate(title, config, sources, scene_model="a model")  # type: ignore[arg-type]


def learnt_groups(seed: int, protocol) -> set[str]:
    parts = split(SCENES["rooms"], seed=seed, protocol=protocol)
    return {scene.group for part in ("train", "validation") for scene in parts[part]}


@pytest.mark.parametrize("protocol", ["group", "stable"])
def test_of_equal_splits_all_test_scenes_are_held_out(protocol) -> None:
    a, b = candidate("a", split=protocol), candidate("b", split=protocol)
    scenes, notes = held_out(a, b, SCENES)
    assert scenes == split(SCENES["rooms"], seed=0, protocol=protocol)["test"]
    assert not notes


@pytest.mark.parametrize(
    "protocols", [("stable", "stable"), ("stable", "group"), ("group", "group")]
)
def test_of_two_splits_scenes_that_either_model_learnt_are_left_out(protocols) -> None:
    a, b = candidate("a", split=protocols[0]), candidate("b", split=protocols[1], split_seed=1)
    scenes, (note,) = held_out(a, b, SCENES)
    groups = {scene.group for scene in scenes}
    assert groups
    assert not groups & (learnt_groups(0, protocols[0]) | learnt_groups(1, protocols[1]))
    assert "left out" in note


@pytest.mark.parametrize("protocol", ["stable", "group"])
@pytest.mark.parametrize("sources", [["rooms"], ["rooms", "3dssg"]])
def test_after_a_change_of_the_data_only_a_stable_split_is_certain(protocol, sources) -> None:
    """The scenes have changed since, or the older model has one more source."""
    learnt = LEARNT if len(sources) > 1 else {"rooms": "0" * 64}
    before = candidate("before", learnt, split=protocol, sources=sources)
    scenes, notes = held_out(candidate("now", split="stable"), before, SCENES)
    assert {stable_part(scene, 0) for scene in scenes} == {"test"}
    assert any("may have learnt from these" in note for note in notes) == (protocol == "group")


def test_a_model_of_other_sources_learnt_none_of_the_scenes() -> None:
    other = candidate("b", {"kitchens": "1" * 64}, split="group")
    _, (note,) = held_out(candidate("a", split="stable"), other, SCENES)
    assert "other data sources (kitchens)" in note
    assert held_out(candidate("a"), REFERENCE, SCENES)[1] == ()


def test_the_first_model_must_record_its_split_and_have_test_scenes() -> None:
    with pytest.raises(ConfigError, match="does not record the split of its scenes"):
        held_out(REFERENCE, candidate("b"), SCENES)
    final = candidate("a", split="final")
    with pytest.raises(ConfigError, match="trained with --final"):
        held_out(final, final, SCENES)
