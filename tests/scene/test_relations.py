from __future__ import annotations

from itertools import pairwise
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.relations import (
    CANONICAL,
    RELATIONS,
    canonicalise,
    contradiction,
    opposite,
    support_cycle,
)
from scene_client.schemas import RelationName

relations = st.sampled_from(RELATIONS)


def test_the_schema_has_the_same_relations() -> None:
    assert {*get_args(RelationName)} == {*RELATIONS}


@given(relations, st.integers(0, 9), st.integers(0, 9))
def test_a_relation_and_its_opposite_are_one_statement(relation: str, i: int, j: int) -> None:
    assert canonicalise(i, relation, j) == canonicalise(j, opposite(relation), i)
    index, subject, anchor = canonicalise(i, relation, j)
    assert {subject, anchor} == {i, j}
    assert CANONICAL[index] in (relation, opposite(relation))


@pytest.mark.parametrize("name", ["", "Left", "on top", "near", "on_top"])
def test_unknown_relations_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"unknown relation '{name}'.*on-top"):
        canonicalise(0, name, 1)
    with pytest.raises(ValueError, match=rf"unknown relation '{name}'"):
        opposite(name)


def test_contradictions() -> None:
    assert contradiction([(0, 1, 2), (1, 2, 1), (0, 1, 2)]) is None
    assert contradiction([(0, 1, 2), (3, 0, 1), (0, 2, 1)]) == ((0, 1, 2), (0, 2, 1))


def test_supports_in_a_circle_are_found() -> None:
    """Only on-top (2) and inside (4) hold an object."""
    tower = [(2, "box", "book"), (4, "book", "bag"), (2, "bag", "desk")]
    assert support_cycle(tower) is None
    assert support_cycle([*tower, (3, "desk", "box"), (0, "desk", "box")]) is None
    circle = support_cycle([*tower, (2, "desk", "book")])
    assert circle is not None
    assert circle[0] == circle[-1]
    assert {*pairwise(circle)} == {
        ("book", "bag"), ("bag", "desk"), ("desk", "book"),
    }  # fmt: skip
