from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene import CANONICAL
from training.datasets.encoding import derive_from_boxes

LEFT, FRONT, ON_TOP, ABOVE = range(4)
corners = st.integers(0, 40)
boxes = st.lists(
    st.tuples(corners, corners, st.integers(1, 20), st.integers(1, 20)).map(
        lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
    ),
    max_size=6,
)


@given(boxes)
def test_no_pair_contradicts_itself(drawn: list[tuple[int, int, int, int]]) -> None:
    found = derive_from_boxes(drawn)
    n = len(drawn)
    assert found.holds.shape == (len(CANONICAL), n, n)
    assert not (found.holds & ~found.observed).any()
    assert not (found.holds & found.holds.transpose(0, 2, 1)).any()
    assert not (found.holds[LEFT] & (found.holds[ABOVE] | found.holds[ABOVE].T)).any()
    assert not found.observed[[FRONT, ON_TOP]].any()


@given(boxes)
def test_mirrored_images_exchange_left_and_right(drawn: list[tuple[int, int, int, int]]) -> None:
    mirrored = [(-b[2], b[1], -b[0], b[3]) for b in drawn]
    here, there = derive_from_boxes(drawn), derive_from_boxes(mirrored)
    assert (here.holds[LEFT] == there.holds[LEFT].T).all()
    assert (here.holds[ABOVE] == there.holds[ABOVE]).all()


def test_known_boxes() -> None:
    found = derive_from_boxes(
        [(0, 50, 10, 60), (14, 51, 24, 61), (1, 10, 11, 40), (500, 0, 510, 9)]
    )
    assert np.argwhere(found.holds).tolist() == [[LEFT, 0, 1], [ABOVE, 2, 0], [ABOVE, 2, 1]]
    assert not found.observed[:, 3].any()  # far from everything
    assert found.observed[LEFT, 1, 0]
    # Offsets of less than a tenth of the box decide nothing.
    assert not derive_from_boxes([(0, 0, 100, 100), (5, 5, 105, 105)]).holds.any()


def test_unseen_boxes_are_unobserved() -> None:
    found = derive_from_boxes([(0, 0, 9, 9), (math.nan,) * 4])
    assert not found.observed.any()


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match=r"boxes has shape \(1, 3\), must be \(1, 4\)"):
        derive_from_boxes([[1, 2, 3]])
