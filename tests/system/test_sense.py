"""The measurements of physical sense count the faults that they define."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scripts.sense.patrol import Frame, count_onsets
from scripts.sense.placements import Box, Placement
from scripts.sense.statements import read_statements


def box(label: str, at: tuple[float, float], bottom: float, size: tuple[float, ...]) -> Box:
    low = np.array([*at, bottom]) - [size[0] / 2, size[1] / 2, 0]
    return Box(label, low, low + size)


TABLE = box("table", (0, 0), 0, (1.2, 0.8, 0.75))
BED = box("bed", (0, 0), 0, (2, 1.6, 1))
CUP = box("cup", (0.4, 0), 0.75, (0.1, 0.1, 0.1))
CHAIR = (0.5, 0.5, 0.9)


def faults(thing: Box, relation: str, anchor: Box, *others: Box, **options: Any) -> set[str]:
    placement = Placement(thing, relation, anchor, list(others), floor=0, hangs=False)
    return replace(placement, **options).faults()


@pytest.mark.parametrize(
    ("at", "bottom", "expected"),
    [
        ((0, 0), 0.75, set()),
        ((0, 0), 0.79, set()),
        ((0, 0), 0.81, {"in the air"}),
        ((0, 0), 0.6, {"inside a solid"}),
        ((0.7, 0), 0.75, {"in the air"}),
        ((0.4, 0), 0.75, {"on an occupied spot", "inside a solid"}),
    ],
)
def test_a_cup_on_a_table(at: tuple[float, float], bottom: float, expected: set[str]) -> None:
    assert faults(box("cup", at, bottom, (0.1, 0.1, 0.12)), "on-top", TABLE, CUP) == expected


def test_things_lie_on_the_seat_of_a_bed_and_not_in_its_base() -> None:
    on_seat, in_base = (box("pillow", (0, 0), bottom, (0.5, 0.4, 0.15)) for bottom in (0.5, 0.2))
    assert faults(on_seat, "on-top", BED) == set()
    assert faults(in_base, "on-top", BED) == {"inside a solid"}


def test_beside_an_anchor_a_thing_needs_a_support_unless_it_hangs() -> None:
    stands, floats = (box("chair", (1.5, 0), bottom, CHAIR) for bottom in (0, 0.3))
    assert faults(stands, "left", TABLE) == set()
    assert faults(floats, "left", TABLE) == {"in the air"}
    assert faults(floats, "left", TABLE, hangs=True) == set()
    rug = box("rug", (1.5, 0), 0, (2, 2, 0.02))
    assert faults(stands, "left", TABLE, rug) == set()
    assert faults(box("chair", (1.5, 0), -0.2, CHAIR), "left", TABLE) == {"inside a solid"}


def test_a_shelf_of_the_anchor_is_not_solid() -> None:
    shelf = box("shelf", (0, 0), 0, (1, 0.4, 2))
    book, other = (box("book", (x, 0), 0.8, (0.1, 0.2, 0.2)) for x in (0, 0.2))
    assert faults(other, "left", book, shelf) == set()
    beside = box("chair", (0.9, 0), 0, CHAIR)
    assert "inside a solid" in faults(other, "left", beside, shelf)


def test_the_anchor_is_the_larger_thing() -> None:
    bear = box("teddy bear", (0, 0), 1, (0.3, 0.3, 0.3))
    assert "anchor smaller" in faults(BED, "under", bear)
    assert "anchor smaller" not in faults(bear, "on-top", BED)


@given(st.lists(st.floats(-2, 2), min_size=9, max_size=9))
def test_the_depth_frees_a_box_and_is_symmetric(values: list[float]) -> None:
    size = np.abs(values[6:]) + 0.1
    other = box("b", (values[3], values[4]), values[5], (0.5, 0.6, 0.7))
    one = box("a", (values[0], values[1]), values[2], tuple(size))
    depth = one.depth(other)
    assert depth == other.depth(one)
    moves = [np.eye(3)[axis] * sign * max(depth, 0) for axis, sign in product(range(3), (-1, 1))]
    assert min(Box("a", one.low + m, one.high + m).depth(other) for m in moves) <= 1e-9


def test_onsets_begin_where_the_frame_before_has_no_such_alarm() -> None:
    chair, cup = ("chair#1", "chair", "above"), ("cup#2", "cup", "on-top")
    alarms = [{(1,): chair}, {(1,): chair, (2,): cup}, {(2,): cup}, {(1,): chair}]
    frames = [Frame(dict(entries), set()) for entries in alarms]
    right, wrong = count_onsets(frames, intruders={"cup#2"})
    assert right == 1
    assert wrong == {("chair", "above", False): 2}


def test_each_impossible_statement_has_a_sensible_twin() -> None:
    statements = read_statements()
    assert len(statements) == 132
    for impossible, twin in zip(statements[::2], statements[1::2], strict=True):
        assert impossible.impossible
        assert not twin.impossible
        assert impossible.kind == twin.kind
        for statement in (impossible, twin):
            assert {statement.relation[0], statement.relation[2]} <= set(statement.objects)
