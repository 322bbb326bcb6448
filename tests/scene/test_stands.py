"""What holds an object: the floor, a wall, or another object."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.scene.geometry import derive_relations
from app.scene.relations import INSIDE, ON_TOP
from app.scene.stands import FLOOR, HANGS, SUPPORTED, UNKNOWN, Heights, floor_level, stands_of
from tests.scene.role_counts import LABELS, role_counts

NAN = math.nan
WORDS = {("bin", "desk"): (0, 9, 0), ("milk", "fridge"): (0, 0, 5), ("pillow", "bed"): (9, 0, 0)}
ROLES = role_counts({tuple(map(LABELS.index, pair)): n for pair, n in WORDS.items()})

Box = tuple[str, tuple[float, float, float], tuple[float, float, float]]
"""Label, extents, and position of the bottom."""

DESK: Box = ("desk", (1.6, 0.8, 0.75), (0, 0, 0))


def stands(*boxes: Box, floor: float = 0.0) -> list[int]:
    """The stands of boxes, with the relations that their poses show."""
    sizes = np.array([size for _, size, _ in boxes])
    centres = np.array([bottom for _, _, bottom in boxes], float)
    centres[:, 2] += sizes[:, 2] / 2
    classes = np.array([LABELS.index(label) for label, _, _ in boxes])
    poses = derive_relations(centres, sizes, np.zeros(len(boxes)), classes=classes, roles=ROLES)
    heights = Heights.of(centres, sizes)
    return stands_of(poses.holds, poses.observed, heights, floor).tolist()


def test_the_floor_is_where_most_objects_on_the_floor_stand() -> None:
    """One object far below, such as an error of the camera, does not move the floor."""
    bottoms = np.array([0.02, -3.0, 0.0, 0.75, 0.01, 1.8])
    weights = np.array([0.9, 0.9, 0.9, 0.1, 0.8, 0.0])
    assert floor_level(bottoms, weights) == pytest.approx(0.0, abs=0.03)
    assert floor_level(bottoms + 7, weights) == pytest.approx(7.0, abs=0.03)


def test_the_floor_is_unknown_without_objects_that_stand_on_it() -> None:
    assert math.isnan(floor_level(np.array([NAN, 0.5]), np.array([1.0, 0.0])))
    assert math.isnan(floor_level(np.zeros(0), np.zeros(0)))
    # A cup tells nothing about the floor.
    assert math.isnan(floor_level(np.array([NAN, 0.5]), np.array([1.0, 0.2])))
    assert floor_level(np.array([NAN, 0.5]), np.array([1.0, 0.6])) == 0.5


@pytest.mark.parametrize(
    ("bottom", "expected"),
    [(0.0, FLOOR), (0.09, FLOOR), (-0.4, FLOOR), (0.11, HANGS), (1.6, HANGS)],
)
def test_a_free_object_stands_on_the_floor_or_hangs(bottom: float, expected: int) -> None:
    assert stands(("lamp", (0.3, 0.3, 0.4), (3, 0, bottom)), DESK) == [expected, FLOOR]


def test_an_object_on_another_is_supported() -> None:
    assert stands(("lamp", (0.3, 0.3, 0.4), (0, 0, 0.75)), DESK) == [SUPPORTED, FLOOR]


def test_a_desk_over_a_bin_stands_on_the_floor() -> None:
    """The relation is on-top of the desk to the bin."""
    bin_: Box = ("bin", (0.3, 0.3, 0.4), (0.3, 0, 0))
    assert stands(bin_, DESK) == [FLOOR, FLOOR]


def test_an_object_in_a_low_box_is_supported() -> None:
    """Its bottom is near the floor, but it is inside."""
    milk: Box = ("milk", (0.1, 0.1, 0.2), (0, 0, 0.05))
    fridge: Box = ("fridge", (0.6, 0.6, 0.4), (0, 0, 0))
    assert stands(milk, fridge) == [SUPPORTED, FLOOR]


def test_a_chair_on_a_rug_stands_on_the_floor() -> None:
    chair: Box = ("chair", (0.5, 0.5, 0.9), (0, 0, 0.01))
    rug: Box = ("towel", (2.0, 1.5, 0.01), (0, 0, 0))
    assert stands(chair, rug) == [FLOOR, FLOOR]


@pytest.mark.parametrize(("gap", "expected"), [(0.13, UNKNOWN), (0.17, HANGS)])
def test_an_object_closely_above_another_has_an_unknown_stand(gap: float, expected: int) -> None:
    assert stands(("monitor", (0.6, 0.2, 0.4), (0, 0, 0.75 + gap)), DESK) == [expected, FLOOR]


def test_an_open_relation_leaves_the_stand_unknown() -> None:
    """The counts do not tell whether a book that reaches into a sofa is on or in it."""
    n = 2
    holds, observed = np.zeros((5, n, n), np.bool_), np.ones((5, n, n), np.bool_)
    heights = Heights(np.array([0.3, 0.0]), np.array([0.5, 0.8]), np.array([0.1, 2.0]))
    assert stands_of(holds, observed, heights, 0.0).tolist() == [HANGS, FLOOR]
    observed[[ON_TOP, INSIDE], 0, 1] = False
    assert stands_of(holds, observed, heights, 0.0).tolist() == [UNKNOWN, FLOOR]
    holds[INSIDE, 0, 1] = True
    assert stands_of(holds, observed, heights, 0.0).tolist() == [SUPPORTED, FLOOR]
