import math
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.footprints import overlap_and_gap
from app.scene.roles import IN, ON, UNDER, RoleCounts, is_smaller, likely_role, possible_roles
from app.scene.scene import PoseRelations, derive_relations
from app.scene.spatial_relations import CANONICAL, canonicalise

LABELS = (
    *("bed", "bin", "book", "chair", "cushion", "desk", "fridge", "lamp", "milk", "monitor"),
    *("pillow", "shelf", "slippers", "sofa", "table", "towel", "bathtub"),
)
V = len(LABELS)
DESK, LAMP, SHELF = (LABELS.index(label) for label in ("desk", "lamp", "shelf"))


def role_counts(table: Mapping[tuple[int, int], tuple[int, ...]]) -> RoleCounts:
    """How often the first class is on, under and in the second. At a class: those of all pairs."""
    pairs = sorted(table)
    anchor, rows = np.zeros((V, 3), np.float32), np.array([table[pair] for pair in pairs], "f4")
    np.add.at(anchor, [j for _, j in pairs], rows)
    return RoleCounts(np.array([i * V + j for i, j in pairs], np.int64), rows, anchor)


NAN = math.nan
Thing = tuple[tuple[float, ...], tuple[float, ...]]
TABLE: Thing = ((2.0, 0.0, 0.4), (1.0, 1.6, 0.8))

# How often the first class is on, under and in the second.
SEEN = {
    ("bin", "desk"): (1, 20, 0),
    ("monitor", "desk"): (200, 1, 0),
    ("chair", "table"): (0, 15, 0),
    ("pillow", "bed"): (90, 0, 0),
    ("milk", "fridge"): (2, 0, 30),
    ("lamp", "shelf"): (9, 0, 6),
}
COUNTS = role_counts({tuple(map(LABELS.index, pair)): row for pair, row in SEEN.items()})


def names(found: PoseRelations, i: int = 0, j: int = 1) -> tuple[set[str], set[str]]:
    """What holds of (i, j), and what was observed."""
    return (
        {name for a, name in enumerate(CANONICAL) if found.holds[a, i, j]},
        {name for a, name in enumerate(CANONICAL) if found.observed[a, i, j]},
    )


def cup(bottom: float) -> Thing:
    """Near the middle of the table, a little nearer to the viewer."""
    return (1.7, 0.1, bottom + 0.05), (0.1, 0.1, 0.1)


def box(x: float, y: float, z: float, *size: float) -> Thing:
    return (x, y, z), size or (0.05, 0.05, 0.5)


BOOK, SHELVES = box(0.0, 0.0, 0.025, 0.2, 0.3, 0.03), box(0.0, 0.0, 0.95, 0.4, 0.8, 1.9)
UNSIZED = (NAN, NAN, NAN)
CUBE = (1.0, 1.0, 1.0)
SHEET = (0.2, 0.3, 0.01)
ALL, HORIZONTAL, NOTHING = set(CANONICAL), {"left", "front"}, set[str]()
STACKS = ALL - HORIZONTAL


@pytest.mark.parametrize(
    ("subject", "anchor", "holds", "observed"),
    [
        # By the gap: 6 cm into the table the cup may also be in it, but not under it.
        (cup(0.74), TABLE, NOTHING, ALL - {"on-top", "inside"}),
        (TABLE, cup(0.74), NOTHING, ALL),
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
        (box(1.75, 0.25, 0.5), box(2.0, 0.0, 0.5), {"left"}, ALL),
        (box(2.09, 0.09, 0.5), box(2.0, 0.0, 0.5), NOTHING, ALL),
        (box(2.09, 0.11, 0.5), box(2.0, 0.0, 0.5), {"left"}, ALL),
        (box(2.3, 0.0, 0.5), box(2.0, 0.0, 0.5), NOTHING, ALL),
        (box(2.0, -0.3, 0.5), box(2.0, 0.0, 0.5), NOTHING, ALL),
        # Neighbours by the gap between footprints.
        (box(0.0, 0.0, 0.5, *CUBE), box(1.99, 0.0, 0.5, *CUBE), {"front"}, ALL),
        (box(0.0, 0.0, 0.5, *CUBE), box(2.01, 0.0, 0.5, *CUBE), NOTHING, STACKS),
        (box(0.0, 0.0, 0.5, *CUBE), box(9.0, 9.0, 4.0, *CUBE), NOTHING, STACKS),
        # Two boxes of one size: neither is the smaller.
        (box(0.0, 0.0, 0.5, *CUBE), box(0.4, 0.0, 0.5, *CUBE), NOTHING, {"above", *HORIZONTAL}),
        # Without sizes by centres, however much the heights differ, and nothing vertical.
        (box(0.0, 1.49, 3.0, *UNSIZED), box(0.0, 0.0, 0.0, *CUBE), {"left"}, HORIZONTAL),
        (box(0.0, 1.49, 3.0, 1.0, NAN, 1.0), box(0.0, 0.0, 0.0, *CUBE), {"left"}, HORIZONTAL),
        (box(0.0, 1.51, 3.0, *UNSIZED), box(0.0, 0.0, 0.0, *CUBE), NOTHING, NOTHING),
        # Thin things lie on each other one way.
        (box(0.0, 0.0, 0.82, *SHEET), box(0.0, 0.0, 0.81, *SHEET), {"on-top"}, ALL),
        (box(0.0, 0.0, 0.81, *SHEET), box(0.0, 0.0, 0.82, *SHEET), NOTHING, ALL),
        (box(0.0, 0.0, 0.8, *SHEET), box(0.0, 0.05, 0.8, *SHEET), NOTHING, ALL),
        # A tall box is around a smaller one, and no box is around a wider one.
        (BOOK, SHELVES, NOTHING, ALL - {"inside"}),
        (SHELVES, BOOK, NOTHING, ALL - {"above"}),
        (box(0.0, 0.0, 0.04, 0.3, 0.4, 0.08), BOOK, {"on-top"}, ALL),
        (box(0.0, 0.0, 0.95, 0.1, 0.1, 1.9), BOOK, {"on-top"}, ALL),
        # A rug of no height carries a table.
        (TABLE, box(2.0, 0.0, 0.0, 2.0, 3.0, 0.0), {"on-top"}, ALL),
        (box(2.0, 0.0, 0.0, 2.0, 3.0, 0.0), TABLE, NOTHING, ALL),
    ],
)
def test_relations_of_a_pair(subject, anchor, holds, observed):
    positions, sizes = zip(subject, anchor, strict=True)
    assert names(derive_relations(positions, sizes)) == (holds, observed)


def test_yaws_turn_footprints_and_a_map_shows_no_sides() -> None:
    """Two boards reach each other's neighbourhood if one is turned, and overlap if both are."""
    positions, sizes = [[0.0, 2.0, 0.5], [0.0, 0.0, 0.5]], [[3.0, 0.2, 1.0]] * 2
    turn = math.pi / 2
    for yaws, holds in (([0, 0], set()), ([turn, 0], {"left"}), ([0, turn], {"left"})):
        assert names(derive_relations(positions, sizes, yaws))[0] == holds
    both = derive_relations(positions, sizes, [turn, turn])
    assert names(both) == (NOTHING, ALL - {"on-top", "inside"})
    yaws = [0, turn]
    in_map = derive_relations(positions, sizes, yaws, horizontal=False)
    assert names(in_map) == (NOTHING, STACKS)


def standing(x: float, y: float, bottom: float, *size: float) -> Thing:
    return (x, y, bottom + size[2] / 2), size


BED = standing(2.0, 0.0, 0.0, 2.1, 1.6, 1.1)  # with its headboard
DESK_BOX = standing(2.0, 0.0, 0.0, 0.7, 1.4, 0.75)
DINING_TABLE = standing(2.0, 0.0, 0.0, 0.9, 1.6, 0.75)
FRIDGE = standing(2.0, 0.0, 0.0, 0.65, 0.7, 1.8)


@pytest.mark.parametrize(
    ("smaller", "larger", "labels", "relation"),
    [
        (standing(2.1, 0.4, 0.0, 0.3, 0.3, 0.35), DESK_BOX, ("bin", "desk"), "below"),
        # With its back against the edge, higher than the table.
        (standing(1.5, 0.3, 0.0, 0.5, 0.45, 0.92), DINING_TABLE, ("chair", "table"), "below"),
        (standing(2.7, 0.4, 0.5, 0.4, 0.6, 0.15), BED, ("pillow", "bed"), "on-top"),
        (standing(2.0, 0.1, 0.9, 0.09, 0.09, 0.25), FRIDGE, ("milk", "fridge"), "inside"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value[0], str) else "",
)
def test_counts_decide_the_role_of_boxes_that_reach_into_each_other(
    smaller, larger, labels, relation
):
    positions, sizes = zip(smaller, larger, strict=True)
    classes = np.array([LABELS.index(label) for label in labels])
    found = derive_relations(positions, sizes, classes=classes, roles=COUNTS)
    index, i, j = canonicalise(0, relation, 1)
    assert np.argwhere(found.holds).tolist() == [[index, i, j]]
    assert names(found)[1] == names(found, 1, 0)[1] == ALL
    # Without counts, the boxes alone leave the role open.
    found = derive_relations(positions, sizes, classes=classes)
    assert not found.holds.any()
    assert not found.observed[index, i, j]


def test_scenes_of_no_and_of_one_box() -> None:
    assert derive_relations([], []).holds.shape == (len(CANONICAL), 0, 0)
    nobody = np.empty(0, np.int64)
    assert derive_relations([], [], classes=nobody, roles=COUNTS).holds.size == 0
    assert not derive_relations([[0, 0, 0]], [[1, 1, 1]]).observed.any()


EVERY_ROLE = np.ones(3, np.bool_)


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
    assert likely_role(role_counts(table), i, j, EVERY_ROLE) == expected


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
    assert {*np.flatnonzero(possible).tolist()} == expected


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
def test_the_footprint_and_then_the_volume_tell_the_smaller(i, j, expected):
    assert is_smaller(np.array(i), np.array(j)) is expected


Point = tuple[float, float]
Rectangle = tuple[float, float, float, float, float]

coordinates = st.floats(-2, 2, width=32)
sides = st.floats(0.0625, 3, width=32)
turns = st.one_of(
    st.floats(-7, 7, width=32), st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi])
)
rectangles = st.tuples(coordinates, coordinates, sides, sides, turns)


def corners(rectangle: Rectangle) -> list[Point]:
    x, y, length, width, yaw = rectangle
    cos, sin = math.cos(yaw) / 2, math.sin(yaw) / 2
    return [
        (x + cos * u * length - sin * v * width, y + sin * u * length + cos * v * width)
        for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]


def common_area(subject: list[Point], clip: list[Point]) -> float:
    """Area of the intersection of two convex polygons (Sutherland & Hodgman 1974)."""
    for (ax, ay), (bx, by) in zip(clip, clip[1:] + clip[:1], strict=True):

        def side(p: Point, ax: float = ax, ay: float = ay, bx: float = bx, by: float = by) -> float:
            return (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax)

        kept: list[Point] = []
        for p, q in zip(subject, subject[1:] + subject[:1], strict=True):
            if side(p) >= 0:
                kept.append(p)
            if side(p) * side(q) < 0:
                t = side(p) / (side(p) - side(q))
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        subject = kept
    turns = zip(subject, subject[1:] + subject[:1], strict=True)
    return abs(sum(p[0] * q[1] - p[1] * q[0] for p, q in turns)) / 2


def distance_of(a: list[Point], b: list[Point]) -> float:
    """Least distance of two convex polygons, 0 where they overlap."""
    if common_area(a, b) > 1e-9:
        return 0.0
    return min(border_distance(a, b), border_distance(b, a))


def border_distance(points: list[Point], polygon: list[Point]) -> float:
    starts = np.array(polygon)
    edges, offsets = np.roll(starts, -1, axis=0) - starts, np.array(points)[:, None] - starts
    t = ((offsets * edges).sum(2) / (edges**2).sum(1)).clip(0, 1)
    return float(np.linalg.norm(offsets - t[..., None] * edges, axis=2).min())


def measure(a: Rectangle, b: Rectangle) -> tuple[float, float]:
    share, gap = overlap_and_gap(
        *(np.array([part], dtype=float) for r in (a, b) for part in (r[:2], r[2:4], r[4]))
    )
    return float(share[0]), float(gap[0])


@given(rectangles, rectangles)
def test_overlap_and_gap_agree_with_polygon_clipping(a: Rectangle, b: Rectangle) -> None:
    share, gap = measure(a, b)
    area = common_area(corners(a), corners(b))
    assert share * min(a[2] * a[3], b[2] * b[3]) == pytest.approx(area, abs=1e-5)
    assert gap == pytest.approx(distance_of(corners(a), corners(b)), abs=1e-5)


def test_a_footprint_too_small_for_its_area_is_a_point() -> None:
    """1e-300 m squared underflows to 0. The overlap is 1 with what it touches, and otherwise 0."""
    tiny, table = np.full((2, 2), 1e-300), np.ones((2, 2))
    centres = np.array([[0.0, 0.0], [3.0, 0.0]])
    yaws = np.zeros(2), np.array([0.0, 0.3])
    share, gap = overlap_and_gap(centres, tiny, yaws[0], np.zeros((2, 2)), table, yaws[1])
    assert share.tolist() == [1.0, 0.0]
    assert gap[0] == 0
    assert gap[1] > 2
