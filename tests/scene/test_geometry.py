from __future__ import annotations

import math
from contextlib import suppress
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from app.scene.geometry import PoseRelations, Viewpoint, derive_relations, to_viewer_frame
from app.scene.relations import CANONICAL
from tests.scene.pose_rules import Box, UndecidedError, relate

NAN = math.nan
Thing = tuple[tuple[float, ...], tuple[float, ...]]
TABLE: Thing = ((2.0, 0.0, 0.4), (1.0, 1.6, 0.8))


@st.composite
def rooms(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A few boxes, close together, some of them without a size."""
    n = draw(st.integers(0, 6))
    # Steps of a tenth (a few of them halves) make ties and exact contacts common.
    steps = st.integers(-15, 15).map(lambda k: k / 10)
    positions = draw(hnp.arrays(float, (n, 3), elements=steps))
    sizes = draw(hnp.arrays(float, (n, 3), elements=st.integers(1, 12).map(lambda k: k / 10)))
    sizes[draw(hnp.arrays(bool, n, elements=st.sampled_from([False, False, True])))] = NAN
    turns = st.sampled_from([0.0, 0.4, math.pi / 2, -2.5]) | st.floats(-7, 7, width=32)
    yaws = draw(hnp.arrays(float, n, elements=turns))
    return positions, sizes, yaws


def names(found: PoseRelations, i: int = 0, j: int = 1) -> tuple[set[str], set[str]]:
    """What holds of (i, j), and what was observed."""
    return (
        {name for a, name in enumerate(CANONICAL) if found.holds[a, i, j]},
        {name for a, name in enumerate(CANONICAL) if found.observed[a, i, j]},
    )


def boxes_of(positions: np.ndarray, sizes: np.ndarray, yaws: np.ndarray) -> list[Box]:
    return [
        Box(*(None if np.isnan(part).any() else part.tolist() for part in rows), yaw)
        for *rows, yaw in zip(positions, sizes, yaws.tolist(), strict=True)
    ]


@given(rooms(), st.booleans())
def test_every_pair_obeys_the_rules(
    room: tuple[np.ndarray, np.ndarray, np.ndarray], horizontal: bool
) -> None:
    """Pairs where rounding decides are left out."""
    derived, boxes = derive_relations(*room, horizontal=horizontal), boxes_of(*room)
    for i, j in permutations(range(len(boxes)), 2):
        with suppress(UndecidedError):
            assert names(derived, i, j) == relate(boxes[i], boxes[j], horizontal=horizontal)


def test_a_quarter_turn_exchanges_left_and_front() -> None:
    cup, plate = ((2.0, 0.5, 1.0), (0.1, 0.1, 0.1)), ((2.1, -0.2, 1.0), (0.2, 0.2, 0.02))
    positions, sizes = zip(cup, plate, strict=True)
    assert names(derive_relations(positions, sizes))[0] == {"left"}
    for viewpoint, expected in (
        (Viewpoint(0.0, 0.0, 0.0), {"left"}),
        (Viewpoint(2.0, 3.0, -math.pi / 2), {"front"}),  # from the left, looking right
        (Viewpoint(2.0, -3.0, math.pi / 2), set()),  # from the right: the cup is behind
        (Viewpoint(5.0, 0.0, math.pi), set()),  # from the far side: the cup is right
    ):
        seen, yaws = to_viewer_frame(positions, viewpoint)
        found = derive_relations(seen, sizes, yaws)
        assert names(found)[0] == expected
    assert names(found, 1, 0)[0] == {"left"}


@given(
    hnp.arrays(float, (3, 3), elements=st.floats(-5, 5)),
    st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-7, 7)),
)
def test_the_viewer_frame_is_a_rigid_motion(
    positions: np.ndarray, viewpoint: tuple[float, float, float]
) -> None:
    moved, yaws = to_viewer_frame(positions, Viewpoint(*viewpoint), [0.0, 1.0, 2.0])
    assert moved[:, 2] == pytest.approx(positions[:, 2])
    assert yaws == pytest.approx(np.array([0.0, 1.0, 2.0]) - viewpoint[2])
    for i in range(3):
        assert moved[i] - moved[0] == pytest.approx(
            _turn(positions[i] - positions[0], -viewpoint[2]), abs=1e-9
        )
    ahead = [viewpoint[0] + math.cos(viewpoint[2]), viewpoint[1] + math.sin(viewpoint[2]), 0.0]
    assert to_viewer_frame([ahead], Viewpoint(*viewpoint))[0][0] == pytest.approx(
        [1.0, 0.0, 0.0], abs=1e-9
    )


def _turn(point: np.ndarray, yaw: float) -> np.ndarray:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1], point[2]])


def cup(bottom: float) -> Thing:
    """Near the middle of the table, a little nearer to the viewer."""
    return (1.7, 0.1, bottom + 0.05), (0.1, 0.1, 0.1)


def box(x: float, y: float, z: float, *size: float) -> Thing:
    return (x, y, z), size or (0.05, 0.05, 0.5)


UNSIZED = (NAN, NAN, NAN)
CUBE = (1.0, 1.0, 1.0)
SHEET = (0.2, 0.3, 0.01)
ALL, HORIZONTAL, NOTHING = set(CANONICAL), {"left", "front"}, set[str]()


@pytest.mark.parametrize(
    ("subject", "anchor", "holds", "observed"),
    [
        # By the gap: 6 cm into the table there is no support, and the cup is nearer.
        (cup(0.74), TABLE, {"front"}, ALL),
        (cup(0.76), TABLE, {"on-top"}, ALL),
        (cup(0.84), TABLE, {"on-top"}, ALL),
        (cup(0.86), TABLE, {"above"}, ALL),
        (cup(3.00), TABLE, {"above"}, ALL),
        (TABLE, cup(0.76), NOTHING, ALL),
        # 30 % of a box 20 cm wide stand on a table whose edge is at 80 cm, at y = 84 cm.
        (box(2.0, 0.84, 0.9, 0.2, 0.2, 0.2), TABLE, {"on-top"}, ALL),
        (box(2.0, 0.86, 0.9, 0.2, 0.2, 0.2), TABLE, {"left"}, ALL),
        # By the larger offset; equal ones count as sideways, and those under 10 cm not at all.
        (box(2.0, 0.3, 0.5), box(2.0, 0.0, 0.5), {"left"}, ALL),
        (box(1.7, 0.0, 0.5), box(2.0, 0.0, 0.5), {"front"}, ALL),
        (box(1.8, 0.2, 0.5), box(2.0, 0.0, 0.5), {"left"}, ALL),
        (box(2.09, 0.09, 0.5), box(2.0, 0.0, 0.5), NOTHING, ALL),
        (box(2.09, 0.11, 0.5), box(2.0, 0.0, 0.5), {"left"}, ALL),
        (box(2.3, 0.0, 0.5), box(2.0, 0.0, 0.5), NOTHING, ALL),
        (box(2.0, -0.3, 0.5), box(2.0, 0.0, 0.5), NOTHING, ALL),
        # Neighbours by the gap between footprints.
        (box(0.0, 0.0, 0.5, *CUBE), box(1.99, 0.0, 0.5, *CUBE), {"front"}, ALL),
        (box(0.0, 0.0, 0.5, *CUBE), box(2.01, 0.0, 0.5, *CUBE), NOTHING, NOTHING),
        # Without sizes by centres, however much the heights differ, and nothing vertical.
        (box(0.0, 1.49, 3.0, *UNSIZED), box(0.0, 0.0, 0.0, *CUBE), {"left"}, HORIZONTAL),
        (box(0.0, 1.49, 3.0, 1.0, NAN, 1.0), box(0.0, 0.0, 0.0, *CUBE), {"left"}, HORIZONTAL),
        (box(0.0, 1.51, 3.0, *UNSIZED), box(0.0, 0.0, 0.0, *CUBE), NOTHING, NOTHING),
        # Thin things lie on each other one way.
        (box(0.0, 0.0, 0.82, *SHEET), box(0.0, 0.0, 0.81, *SHEET), {"on-top"}, ALL),
        (box(0.0, 0.0, 0.81, *SHEET), box(0.0, 0.0, 0.82, *SHEET), NOTHING, ALL),
        (box(0.0, 0.0, 0.8, *SHEET), box(0.0, 0.05, 0.8, *SHEET), NOTHING, ALL),
    ],
)
def test_relations_of_a_pair(
    subject: Thing, anchor: Thing, holds: set[str], observed: set[str]
) -> None:
    positions, sizes = zip(subject, anchor, strict=True)
    assert names(derive_relations(positions, sizes)) == (holds, observed)


def test_a_scene_of_none_and_of_one() -> None:
    assert derive_relations([], []).holds.shape == (4, 0, 0)
    assert not derive_relations([[0, 0, 0]], [[1, 1, 1]]).observed.any()


@pytest.mark.parametrize(
    ("positions", "sizes", "yaws", "message"),
    [
        ([[0, 0]], [[1, 1, 1]], None, r"positions must have the shape \(1, 3\), not \(1, 2\)"),
        ([[0, 0, 0]], [[1, 1, 1]] * 2, None, r"sizes must have the shape \(1, 3\), not \(2, 3\)"),
        ([[0, 0, 0]], [[1, 1, 1]], [0, 0], r"yaws must have the shape \(1,\), not \(2,\)"),
        ([[0, 0, math.inf]], [[1, 1, 1]], None, "infinite"),
        ([[0, 0, 0]], [[1, 1, math.inf]], None, "infinite"),
        ([[0, 0, 0]], [[1, 1, 1]], [NAN], "infinite"),
        ([[0, 0, 0]], [[1, -1, 1]], None, "negative"),
    ],
)
def test_bad_poses_are_refused(positions: list, sizes: list, yaws: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        derive_relations(positions, sizes, yaws)


def test_a_viewpoint_must_be_finite() -> None:
    with pytest.raises(ValueError, match="viewpoint must be finite"):
        to_viewer_frame([[0, 0, 0]], Viewpoint(0.0, NAN, 0.0))
