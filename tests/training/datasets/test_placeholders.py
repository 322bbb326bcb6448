from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.training.scenes import scene
from training.datasets import AnnotatedObject, AnnotatedScene
from training.datasets.inventories import shipped_things
from training.datasets.vocabulary import (
    curated_names,
    is_placeholder,
    left_out_line,
    plain_label,
    plain_scenes,
)

PLACEHOLDERS = (
    *("REMOVE", "SPLIT", "unknown", "Undefined", "BACKGROUND", "ground_plane", "N/A", "none"),
    *("object", "objects", "object_7", "Object-12", "obj.001", "item_3", "unknown object", "misc"),
    *("other furniture", "otherfurniture", "don't care", "track_7", "label_12", "cluster 4"),
    *("n03001627", "/m/01mzpv", "/g/11b6", "1a6f615e8b1b5ae4dbbc9440457e303e", "b045e42b"),
    *("550e8400-e29b-41d4-a716-446655440000", "123", "???", "", "world::object_3::link"),
)
NAMES = (
    *("sofa", "remote", "remote control", "vase", "track", "label", "body", "type", "facade"),
    *("decade", "cafe", "mp3 player", "3d printer", "screw m4", "chair_12", "sofa.n.01"),
    *("couch_v2", "objects/bed_a1b2", "kitchen::table_1::link", "no smoking sign", "naïve art"),
    *("椅子", "椅子_3", "split keyboard", "object storage box", "banana", "glasses", "tv"),
)
PLAIN = {
    "sofa.n.01": "sofa",
    "mug.n.04_1": "mug",
    "couch_v2": "couch",
    "chair_12": "chair",
    "objects/bed_a1b2": "bed",
    "kitchen::table_1::link": "table",
    "screw_m4": "screw_m4",  # may be another kind than screw_m5
    "sofa": "sofa",
}


@pytest.mark.parametrize("label", PLACEHOLDERS)
def test_placeholders_name_no_kind(label: str) -> None:
    assert is_placeholder(label)


@pytest.mark.parametrize("label", NAMES)
def test_names_are_no_placeholders(label: str) -> None:
    assert not is_placeholder(label)


@pytest.mark.parametrize(("label", "name"), PLAIN.items())
def test_a_known_name_is_read(label: str, name: str) -> None:
    assert plain_label(label) == name


def test_only_vague_names_of_the_repository_are_placeholders() -> None:
    names = curated_names()
    known = {*names.base, *names.household, *names.aliases, *shipped_things()}
    vague = {"background", "object", "item", "otherfurniture", "clutter"}
    assert {name for name in known if is_placeholder(name)} <= vague


@given(st.sampled_from(("object", "unknown", "REMOVE")), st.integers(0, 10**9))
def test_a_number_makes_no_name(word: str, number: int) -> None:
    assert is_placeholder(f"{word}_{number}")
    assert not is_placeholder(f"chair_{number}")


@given(st.text())
def test_every_text_is_read(label: str) -> None:
    assert plain_label(plain_label(label)) == plain_label(label)
    assert is_placeholder(label) in (False, True)


def test_placeholders_leave_a_scene_with_their_relations() -> None:
    things = [AnnotatedObject("a", "object_7"), AnnotatedObject("b", "cup_3", supported_by="a")]
    things += [AnnotatedObject("c", "table"), AnnotatedObject("d", "REMOVE")]
    relations = ((1, "on-top", 0), (1, "left", 2), (3, "left", 2))
    whole = AnnotatedScene(
        *("s", "jsonl", "g", None, tuple(things), relations),
        false_relations=((0, "left", 2), (2, "left", 1)),
        supported=(0, 1),
    )
    untouched = scene("t", "cup", "plate")
    (part, same), left_out = plain_scenes([whole, untouched])
    assert same == untouched
    kept = [(x.id, x.label, x.supported_by) for x in part.objects]
    assert kept == [("b", "cup", None), ("c", "table", None)]
    assert part.relations == ((0, "left", 1),)
    assert part.false_relations == ((1, "left", 0),)
    assert part.supported == (0,)
    assert left_out == {"object_7": 1, "REMOVE": 1}


def test_one_line_names_the_labels() -> None:
    assert left_out_line(Counter(), 2) == ""
    line = left_out_line(Counter(REMOVE=2, object_7=5, unknown=1), 2)
    assert line.endswith("no kind of object: object_7 (5), REMOVE (2) and 1 more")
