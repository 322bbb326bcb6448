from __future__ import annotations

import math
from collections import Counter
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
TABLE = ((2.0, 0.0, 0.4), (1.0, 1.6, 0.8))


@st.composite
def rooms(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A few boxes, close together, some of them without a size."""
    n = draw(st.integers(0, 6))
    # Steps of a tenth (a few of them halves) make ties and exact contacts common.
    steps = st.integers(-15, 15).map(lambda k: k / 10)
    positions = draw(hnp.arrays(float, (n, 3), elements=steps))
    sizes = draw(hnp.arrays(float, (n, 3), elements=st.integers(1, 12).map(lambda k: k / 10)))
    sizes[draw(hnp.arrays(bool, n, elements=st.sampled_from([False, False, True])))] = NAN
    yaws = draw(hnp.arrays(float, n, elements=st.sampled_from([0.0, 0.4, math.pi / 2, -2.5])))
    return positions, sizes, yaws


def names(found: PoseRelations, i: int = 0, j: int = 1) -> tuple[set[str], set[str]]:
    """What holds of (i, j), and what was observed."""
    return (
        {name for a, name in enumerate(CANONICAL) if found.holds[a, i, j]},
        {name for a, name in enumerate(CANONICAL) if found.observed[a, i, j]},
    )


def pair(first: tuple, second: tuple, **options: bool) -> PoseRelations:
    positions, sizes = zip(first, second, strict=True)
    return derive_relations(positions, sizes, **options)


def compare(found: PoseRelations, boxes: list[Box], *, horizontal: bool = True) -> Counter[str]:
    """Compare every pair with the plain rules; returns what held and how often none could tell."""
    seen: Counter[str] = Counter()
    for i, j in permutations(range(len(boxes)), 2):
        try:
            holds, observed = relate(boxes[i], boxes[j], horizontal=horizontal)
        except UndecidedError:
            seen["undecided"] += 1
            continue
        assert names(found, i, j) == (holds, observed)
        seen.update(holds or ["none" if observed else "unobserved"])
    return seen


def boxes_of(positions: np.ndarray, sizes: np.ndarray, yaws: np.ndarray) -> list[Box]:
    return [
        Box(*(None if np.isnan(part).any() else part.tolist() for part in rows), yaw)
        for *rows, yaw in zip(positions, sizes, yaws.tolist(), strict=True)
    ]


@given(rooms(), st.booleans())
def test_every_pair_obeys_the_rules(
    room: tuple[np.ndarray, np.ndarray, np.ndarray], horizontal: bool
) -> None:
    found = derive_relations(*room, horizontal=horizontal)
    compare(found, boxes_of(*room), horizontal=horizontal)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("n", [12, 30])
def test_every_pair_of_a_drawn_room_obeys_the_rules(n: int, turned: bool) -> None:
    rng = np.random.default_rng(n)
    seen: Counter[str] = Counter()
    for _ in range(900 // n):
        positions = rng.uniform(-2, 2, (n, 3)) * [1, 1, 0.3]
        sizes, yaws = rng.uniform(0.05, 1.5, (n, 3)), np.zeros(n)
        if turned:
            yaws = rng.uniform(-7, 7, n)
        else:  # a grid of eighths: every sum is exact, equal offsets are common
            positions, sizes = np.round(positions * 8) / 8, np.ceil(sizes * 8) / 8
        positions[rng.random(n) < 0.1, rng.integers(3)] = NAN
        sizes[rng.random(n) < 0.2, rng.integers(3)] = NAN
        seen += compare(derive_relations(positions, sizes, yaws), boxes_of(positions, sizes, yaws))
    assert set(CANONICAL) | {"none", "unobserved"} <= set(seen)
    # On the grid a gap of exactly one metre is common.
    assert seen["undecided"] < (0.001 if turned else 0.05) * seen.total()


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


@pytest.mark.parametrize(
    ("bottom", "holds"),
    [
        (0.74, {"front"}),  # 6 cm into the table: no support, the cup is nearer
        (0.76, {"on-top"}),
        (0.80, {"on-top"}),
        (0.84, {"on-top"}),
        (0.86, {"above"}),
        (3.00, {"above"}),
    ],
)
def test_vertical_relations_by_the_gap(bottom: float, holds: set[str]) -> None:
    cup = ((1.7, 0.1, bottom + 0.05), (0.1, 0.1, 0.1))
    found = pair(cup, TABLE)
    assert names(found) == (holds, set(CANONICAL))
    assert names(found, 1, 0)[0] == set()


@pytest.mark.parametrize(("y", "holds"), [(0.84, {"on-top"}), (0.86, {"left"})])
def test_footprints_must_overlap_by_30_percent_of_the_smaller(y: float, holds: set[str]) -> None:
    # A box 20 cm wide on a table whose edge is at 80 cm: 30 % stand on it at y = 84 cm.
    assert names(pair(((2.0, y, 0.9), (0.2, 0.2, 0.2)), TABLE))[0] == holds


@pytest.mark.parametrize(
    ("x", "y", "holds"),
    [
        (2.0, 0.3, {"left"}),
        (1.7, 0.0, {"front"}),
        (1.8, 0.2, {"left"}),  # equal offsets count as sideways
        (2.09, 0.09, set()),
        (2.09, 0.11, {"left"}),
        (2.3, 0.0, set()),
        (2.0, -0.3, set()),
    ],
)
def test_horizontal_relations_by_the_larger_offset(x: float, y: float, holds: set[str]) -> None:
    small = (0.05, 0.05, 0.5)
    found = pair(((x, y, 0.5), small), ((2.0, 0.0, 0.5), small))
    assert names(found) == (holds, set(CANONICAL))


@pytest.mark.parametrize(("x", "observed"), [(1.99, True), (2.01, False)])
def test_neighbours_by_the_gap_between_footprints(x: float, observed: bool) -> None:
    cube = (1.0, 1.0, 1.0)
    found = pair(((x, 0.0, 0.5), cube), ((0.0, 0.0, 0.5), cube))
    assert names(found, 1, 0) == (({"front"}, set(CANONICAL)) if observed else (set(), set()))


@pytest.mark.parametrize("sizes", [(NAN, NAN, NAN), (1.0, NAN, 1.0)])
@pytest.mark.parametrize(("y", "observed"), [(1.49, True), (1.51, False)])
def test_without_sizes_neighbours_by_centres_and_nothing_vertical(
    sizes: tuple[float, float, float], y: float, observed: bool
) -> None:
    # The heights differ by far more than 1.5 m: only the horizontal distance counts.
    found = pair(((0.0, y, 3.0), sizes), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    assert names(found) == (({"left"}, {"left", "front"}) if observed else (set(), set()))


def test_things_without_a_position_are_not_observed() -> None:
    found = derive_relations([[0, 0, 0], [NAN] * 3, [0, 0.5, 0]], np.full((3, 3), NAN))
    assert not found.observed[:, 1].any()
    assert not found.observed[:, :, 1].any()
    assert names(found, 2, 0)[0] == {"left"}


def test_thin_things_lie_on_each_other_one_way() -> None:
    sheet = (0.2, 0.3, 0.01)
    found = pair(((0.0, 0.0, 0.82), sheet), ((0.0, 0.0, 0.81), sheet))
    assert names(found)[0] == {"on-top"}
    assert names(found, 1, 0)[0] == set()
    level = pair(((0.0, 0.0, 0.8), sheet), ((0.0, 0.05, 0.8), sheet))
    assert not level.holds.any()
    assert level.observed[:, 0, 1].all()


def test_a_scene_of_none_and_of_one() -> None:
    assert derive_relations([], []).holds.shape == (4, 0, 0)
    assert not derive_relations([[0, 0, 0]], [[1, 1, 1]]).observed.any()


@pytest.mark.parametrize(
    ("positions", "sizes", "yaws", "message"),
    [
        ([[0, 0]], [[1, 1, 1]], None, r"positions has shape \(1, 2\), must be \(1, 3\)"),
        ([[0, 0, 0]], [[1, 1, 1]] * 2, None, r"sizes has shape \(2, 3\), must be \(1, 3\)"),
        ([[0, 0, 0]], [[1, 1, 1]], [0, 0], r"yaws has shape \(2,\), must be \(1,\)"),
        ([[0, 0, math.inf]], [[1, 1, 1]], None, "infinite"),
        ([[0, 0, 0]], [[1, 1, math.inf]], None, "infinite"),
        ([[0, 0, 0]], [[1, 1, 1]], [NAN], "infinite"),
        ([[0, 0, 0]], [[1, 0, 1]], None, "positive"),
    ],
)
def test_bad_poses_are_refused(positions: list, sizes: list, yaws: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        derive_relations(positions, sizes, yaws)


def test_a_viewpoint_must_be_finite() -> None:
    with pytest.raises(ValueError, match="viewpoint must be finite"):
        to_viewer_frame([[0, 0, 0]], Viewpoint(0.0, NAN, 0.0))
