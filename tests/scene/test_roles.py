from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.roles import IN, ON, UNDER, is_smaller, likely_role, possible_roles
from tests.scene.role_counts import DESK, LAMP, ROLES, SHELF, Counts, V, role_counts

ALL = np.ones(3, np.bool_)
counts = st.dictionaries(
    st.tuples(st.integers(0, V - 1), st.integers(0, V - 1)),
    st.tuples(*[st.integers(0, 9)] * 3),
    max_size=6,
)


@given(counts, st.integers(-1, V - 1), st.integers(-1, V - 1), st.tuples(*[st.booleans()] * 3))
def test_a_role_needs_four_fifths_of_the_smoothed_counts(
    table: Counts, i: int, j: int, possible: tuple[bool, ...]
) -> None:
    role = likely_role(role_counts(table), i, j, np.array(possible))
    if i < 0 or j < 0:
        assert role == -1
        return
    at = [sum(row[k] for (_, anchor), row in table.items() if anchor == j) for k in range(3)]
    weight = [
        possible[k] * (table.get((i, j), (0, 0, 0))[k] + 2 * at[k] / max(sum(at), 1))
        for k in range(3)
    ]
    share = max(weight) / (sum(weight) or 1)
    if abs(share - 0.8) > 1e-6:
        assert role == (int(np.argmax(weight)) if share > 0.8 else -1)


@pytest.mark.parametrize(
    ("i", "j", "expected"),
    [
        (LAMP, DESK, -1),  # four on it, two under it
        (SHELF, DESK, UNDER),  # a pair with counts of its own
        (DESK, SHELF, IN),  # a pair without counts: the roles of other classes at the shelf
        (DESK, LAMP, -1),  # an anchor without counts
    ],
)
def test_counts_of_the_pair_come_before_counts_of_the_anchor(i: int, j: int, expected: int) -> None:
    table = {(LAMP, DESK): (4, 2, 0), (SHELF, DESK): (0, 20, 0), (LAMP, SHELF): (0, 0, 3)}
    assert likely_role(role_counts(table), i, j, ALL) == expected


@pytest.mark.parametrize(
    ("rise", "height", "expected"),
    [
        (0.0, 0.4, {UNDER, IN}),
        (-0.5, 0.4, {UNDER, IN}),
        (0.15, 0.4, {UNDER, IN}),
        (0.17, 0.4, {ON, IN}),
        (0.0, 0.95, {UNDER, IN}),
        (0.0, 0.97, {UNDER}),
        (0.5, 0.97, {ON}),
    ],
)
def test_heights_exclude_roles(rise: float, height: float, expected: set[int]) -> None:
    """At a table of 80 cm."""
    possible = possible_roles(rise, height, 0.8)
    assert {role for role in range(len(ROLES)) if possible[role]} == expected


def test_the_floor_under_a_low_thing_reaches_ten_centimetres() -> None:
    assert possible_roles(0.09, 0.1, 0.3).tolist() == [True, True, True]
    assert possible_roles(0.11, 0.1, 0.3).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("i", "j", "expected"),
    [
        ((1.0, 1.0, 9.0), (1.0, 1.1, 1.0), True),
        ((1.0, 1.1, 1.0), (1.0, 1.0, 9.0), False),
        ((1.0, 1.0, 1.0), (1.0, 1.009, 2.0), True),
        ((1.0, 1.009, 1.0), (1.0, 1.0, 2.0), True),
        ((1.0, 1.0, 1.0), (1.0, 1.0, 1.009), False),
        ((0.0, 1.0, 1.0), (0.0, 2.0, 1.0), False),
    ],
)
def test_the_footprint_and_then_the_volume_tell_the_smaller(
    i: tuple[float, ...], j: tuple[float, ...], expected: bool
) -> None:
    assert is_smaller(np.array(i), np.array(j)) is expected
