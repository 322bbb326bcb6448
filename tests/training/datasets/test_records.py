from __future__ import annotations

from typing import Any

import pytest

from training.datasets import AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.predicates import relation_of

BED, LAMP = AnnotatedObject("0", "bed"), AnnotatedObject("1", "lamp", supported_by="0")


def scene(**fields: Any) -> AnnotatedScene:
    return AnnotatedScene(
        **{"scene_id": "s", "source": "t", "group": "g", "room_type": None, "objects": (BED, LAMP)}
        | fields
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"objects": (BED, BED)}, "two objects with one id"),
        ({"objects": (LAMP,)}, "supported by '0': no such id"),
        ({"relations": ((0, "near", 1),)}, "unknown relation 'near'"),
        ({"relations": ((0, "left", 2),)}, "a relation names object 2 of 2"),
        ({"relations": ((-1, "left", 0),)}, "a relation names object -1 of 2"),
    ],
)
def test_scenes_that_cannot_be(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scene(**fields)


def test_errors_name_file_place_and_problem(tmp_path: Any) -> None:
    error = DatasetError(tmp_path / "a.json", "line 3", "is odd")
    assert str(error) == f"{tmp_path / 'a.json'}, line 3: is odd"
    assert str(DatasetError(tmp_path / "a.json", "", "is odd")) == f"{tmp_path / 'a.json'}: is odd"


@pytest.mark.parametrize(
    ("source", "predicate", "relation"),
    [
        ("3dssg", "standing on", "on-top"),
        ("3dssg", "supported by", "on-top"),
        ("3dssg", "lower than", "below"),
        ("3dssg", "front", "front"),
        ("3dssg", "close by", None),
        ("3dssg", "hanging on", None),
        ("vrd", "on", "on-top"),
        ("vrd", "on the top of", "on-top"),
        ("vrd", "above", "above"),
        ("vrd", "over", "above"),
        ("vrd", "under", "under"),
        ("vrd", "beneath", "under"),
        ("vrd", "below", "below"),
        ("vrd", "behind", "behind"),
        ("vrd", "in the front of", "front"),
        ("vrd", "on the left of", "left"),
        ("vrd", "on the right of", "right"),
        ("vrd", "sit on", None),
        ("vrd", "wear", None),
        ("vrd", "next to", None),
        ("robot", "under", "under"),
    ],
)
def test_predicates(source: str, predicate: str, relation: str | None) -> None:
    assert relation_of(source, predicate) == relation


def test_an_unknown_predicate_of_ones_own_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="unknown relation 'left of'"):
        relation_of("robot", "left of")
