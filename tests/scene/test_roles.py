from __future__ import annotations

import numpy as np
import pytest

from app.scene.roles import IN, ON, UNDER, is_smaller, likely_role, possible_roles
from tests.scene.role_counts import DESK, LAMP, ROLES, SHELF, role_counts

ALL = np.ones(3, np.bool_)


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
