import json
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from app.registry import Example
from app.scene import ObjectClass, Vocabulary
from scene_client.schemas import SceneRequest
from training.datasets import generate_rooms, source_vocabulary
from training.datasets.rooms import DOMAINS
from training.fit.configuration import ConfigError
from training.runs import example_scenes

SCENES = generate_rooms(60, 0, DOMAINS["workplaces"])
WORDS = source_vocabulary(SCENES, minimum=2)
BOTH_LEFT = [
    {"subject": "bed", "relation": "left", "object": "cup"},
    {"subject": "bed", "relation": "right", "object": "cup"},
]


def test_chosen_scenes_are_requests_with_labels_of_the_vocabulary(tmp_path) -> None:
    chosen = example_scenes.choose_examples(SCENES, WORDS)
    assert len(chosen) == len({example.scene.room_type for example in chosen}) == 3
    for example in chosen:
        request = SceneRequest.model_validate(example.request())
        assert request.viewpoint is not None
        assert len({thing.label for thing in request.objects}) >= 3
        assert all(thing.label in WORDS.labels and thing.position for thing in request.objects)
    (tmp_path / "examples.json").write_text(example_scenes.examples_json(chosen))
    assert example_scenes.read_examples("examples.json", tmp_path) == chosen


def test_a_chosen_scene_has_as_many_classes_as_the_median_of_its_room_type() -> None:
    sizes: dict[str | None, dict[str, int]] = defaultdict(dict)
    for scene in SCENES:
        classes = {WORDS.index(thing.label) for thing in scene.objects} - {None}
        size = sum(not WORDS.structure[index] for index in classes)
        sizes[scene.room_type][scene.scene_id] = size
    for example in example_scenes.choose_examples(SCENES, WORDS):
        (room,) = (x for x in sizes.values() if example.name.split(", ")[1] in x)
        assert abs(room[example.name.split(", ")[1]] - np.median([*room.values()])) <= 1


def test_without_positions_supports_become_relations() -> None:
    bare = {"position": None, "size": None}
    flat = [
        replace(scene, objects=tuple(replace(thing, **bare) for thing in scene.objects))
        for scene in SCENES
    ]
    chosen = example_scenes.choose_examples(flat, WORDS)
    assert any(relation.relation == "on-top" for one in chosen for relation in one.scene.relations)


def test_research_only_scenes_are_never_chosen() -> None:
    copied = [replace(scene, source="sunrgbd") for scene in SCENES]
    assert example_scenes.choose_examples(copied, WORDS) == ()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, r": no such file\. Remove the entry"),
        ("{", "Invalid JSON"),
        ([{"name": "a", "scene": {"objects": [{"id": "bed"}]}}], "label: Field required"),
        ([{"name": "a", "scene": {"objects": ["bed"]}}] * 9, "at most 8 items"),
    ],
)
def test_an_invalid_file_is_named_with_the_reason(tmp_path, content, reason) -> None:
    if content is not None:
        text = content if isinstance(content, str) else json.dumps(content)
        (tmp_path / "mine.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"mine\.json.*{reason}"):
        example_scenes.read_examples("mine.json", tmp_path)


def test_examples_that_the_model_would_refuse_are_left_out_with_the_reason() -> None:
    scenes = (
        {"objects": ["bed"], "room_type": "bedroom"},
        {"objects": ["bed", "unicorn"]},
        {"objects": ["bed"], "room_type": "cave"},
        {"objects": ["bed", "cup"], "relations": BOTH_LEFT},
        {"objects": ["bed"], "relations": BOTH_LEFT[:1]},
    )
    examples = [Example.model_validate({"name": "a", "scene": scene}) for scene in scenes]
    words = Vocabulary([ObjectClass("bed"), ObjectClass("cup")], ["bedroom"])
    kept, reasons = example_scenes.accepted_examples(examples, words)
    assert kept == (examples[0],)
    places = ("#/objects/1", "#/room_type", "#/relations/1", "#/relations/0/object")
    for reason, place in zip(reasons, places, strict=True):
        assert reason.startswith(f"a: {place}"), reason
