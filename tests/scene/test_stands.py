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


def lamp(x: float, bottom: float) -> Box:
    return "lamp", (0.3, 0.3, 0.4), (x, 0, bottom)


@pytest.mark.parametrize(
    ("box", "other", "expected"),
    [
        *((lamp(3, bottom), DESK, FLOOR) for bottom in (0.0, 0.09, -0.4)),
        *((lamp(3, bottom), DESK, HANGS) for bottom in (0.11, 1.6)),
        (lamp(0, 0.75), DESK, SUPPORTED),
        # The relation is on-top of the desk to the bin.
        (("bin", (0.3, 0.3, 0.4), (0.3, 0, 0)), DESK, FLOOR),
        # The bottom of the milk is near the floor, but the milk is inside.
        (
            ("milk", (0.1, 0.1, 0.2), (0, 0, 0.05)),
            ("fridge", (0.6, 0.6, 0.4), (0, 0, 0)),
            SUPPORTED,
        ),
        # A chair on a rug.
        (("chair", (0.5, 0.5, 0.9), (0, 0, 0.01)), ("towel", (2.0, 1.5, 0.01), (0, 0, 0)), FLOOR),
        (lamp(0, 0.75 + 0.13), DESK, UNKNOWN),
        (lamp(0, 0.75 + 0.17), DESK, HANGS),
    ],
)
def test_what_holds_a_box_beside_another_on_the_floor(box: Box, other: Box, expected: int) -> None:
    assert stands(box, other) == [expected, FLOOR]


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
