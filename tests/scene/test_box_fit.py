"""The likelihood of boxes, against values computed by hand and by scipy, and between readings."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_t

from app.questions.conventions import alternatives, readings_of
from app.scene.box_fit import Boxes, log_likelihoods
from scene_client.frames import METRES, Conventions

NO_TURN = (math.nan,) * 4
DECLARED = Conventions()


def boxes_of(*boxes, typical=None, spread=0.35, stands=(1.0, 0.0, 0.0), turns=None):
    """Boxes (centre, size, yaw) of classes with a typical size, by default their own size."""
    centre, size, yaw = (np.array(column, np.float64) for column in zip(*boxes, strict=True))
    n = len(boxes)
    return Boxes(
        centre=centre,
        size=size,
        yaw=yaw,
        turn=np.array(turns or [NO_TURN] * n, np.float64),
        typical=size.copy() if typical is None else np.array(typical, np.float64),
        spread=np.full(n, spread),
        stands=np.array([stands] * n, np.float64),
    )


def log_p(boxes: Boxes, declared: Conventions = DECLARED) -> list[float]:
    values, _ = log_likelihoods(boxes, readings_of(declared))
    return values.tolist()


def row_of(declared: Conventions, **fields: str) -> int:
    return [dict(one.declare) for one in alternatives(declared)].index(fields)


NOWHERE = (math.nan,) * 3


@given(st.tuples(*[st.floats(0.1, 5)] * 3), st.floats(0.2, 0.6))
def test_sizes_follow_students_distribution(size, spread):
    """In the footprint, the height and the ratio of the sides of the footprint."""
    boxes = boxes_of((NOWHERE, size, 0.0), typical=[(1.0, 1.0, 0.5)], spread=spread)
    x, y, z = np.log(size) - np.log((1.0, 1.0, 0.5))
    density = multivariate_t(shape=np.diag([spread**2, spread**2, 0.25]), df=4)
    deviation = [(x + y) / 2, z, abs(x - y) / 2]
    expected = density.logpdf(deviation) - density.logpdf([0, 0, 0])
    assert log_p(boxes)[0] == pytest.approx(expected)


def test_bottoms_share_a_floor():
    """A box at the floor, one 10 cm above it, and one below it."""
    places = [((0, 0, 0.5), (1, 1, 1), 0.0)]
    at_floor = math.log(0.97 * 0.6 / 0.04 + 0.003)
    assert log_p(boxes_of(*places))[0] == pytest.approx(at_floor)
    higher = boxes_of(*places, ((5, 0, 0.6), (1, 1, 1), 0.0))
    density = 0.6 / 0.04 / (1 + 2.5**2) ** 2
    assert log_p(higher)[0] == pytest.approx(at_floor + math.log(0.97 * density + 0.003))


def test_carried_boxes_touch_the_top_of_another_box():
    """Without a class that stands on the floor, no floor is known."""
    table = ((0, 0, 0.5), (1, 1, 1), 0.3)
    cup, high_cup = (((0.2, 0.2, z), (0.1, 0.1, 0.2), 0.0) for z in (1.1, 1.3))
    assert log_p(boxes_of(table, cup, stands=(0, 0, 1)))[0] == 0.0
    scores = []
    for one in (cup, high_cup):
        boxes = boxes_of(table, one)
        boxes.stands[1] = (0, 0, 1)
        scores.append(log_p(boxes)[0])
    free = 0.4 / (1 + (1 / 3) ** 2)
    touching = math.log(0.97 * (0.36 / 0.04 + 0.4 * free) + 0.003)
    assert scores[0] == pytest.approx(math.log(0.97 * 0.6 / 0.04 + 0.003) + touching)
    assert scores[0] > scores[1] + 1


@pytest.mark.parametrize(("distance", "overlaps"), [(0.5, 1), (0.97, 0), (1.5, 0)])
def test_boxes_that_reach_into_each_other(distance, overlaps):
    """5 % of the smaller box do not count."""
    apart = boxes_of(((0, 0, 0.5), (1, 1, 1), 0.4), ((9, 0, 0.5), (1, 1, 1), 0.4))
    x, y = distance * math.cos(0.4), distance * math.sin(0.4)
    near = boxes_of(((0, 0, 0.5), (1, 1, 1), 0.4), ((x, y, 0.5), (1, 1, 1), 0.4))
    assert log_p(near)[0] == pytest.approx(log_p(apart)[0] - overlaps)


def test_quaternions_are_upright():
    upright, tilted, over = (0, 0, 0.6, 0.8), (0.6, 0, 0, 0.8), (1, 0, 0, 0)
    box = ((0, 0, 0.5), (1, 1, 1), 0.0)
    without = log_p(boxes_of(box))[0]
    for turn, share in ((upright, 0.91), (tilted, 0.08), (over, 0.01)):
        assert log_p(boxes_of(box, turns=[turn]))[0] == pytest.approx(without + math.log(share))
    # About the y axis: upright if this axis points up.
    about_y = boxes_of(box, turns=[(0, 0.6, 0, 0.8)])
    assert log_p(about_y, Conventions("y"))[0] == pytest.approx(without + math.log(0.91))


raw = st.lists(
    st.tuples(
        st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(0.2, 2)] * 3), st.floats(-3, 3)
    ),
    min_size=1,
    max_size=4,
)
origins = st.sampled_from(["centre", "bottom", "corner"])
ups = st.sampled_from(["z", "y"])


@given(raw, ups, origins, st.sampled_from(["up", "extents", "box_origin"]), st.data())
def test_a_reading_is_the_scene_with_its_declaration(told, up, origin, name, data):
    """The same numbers under another declaration, and as a reading of the declared boxes."""
    declared = Conventions(up, box_origin=origin)
    others = {"up": ["z", "y"], "extents": ["half"], "box_origin": ["centre", "bottom", "corner"]}
    value = data.draw(st.sampled_from(others[name]))
    other = declared._replace(**{name: value})
    if other == declared:
        return
    read, right = (
        boxes_of(
            *(one.box(p, s, yaw=yaw) for p, s, yaw in told), typical=[(0.8, 0.8, 0.6)] * len(told)
        )
        for one in (declared, other)
    )
    row = row_of(declared, **{name: value})
    assert log_p(read, declared)[row] == pytest.approx(log_p(right, other)[0], abs=1e-6)


@given(raw, st.sampled_from(sorted(set(METRES) - {"m"})))
def test_a_unit_changes_the_sizes_alone(told, unit):
    """Boxes in another unit keep their places to each other."""
    typical = [(0.8, 0.8, 0.6)] * len(told)
    read, right = (
        boxes_of(*((NOWHERE, one.box(p, s)[1], 0.0) for p, s, _ in told), typical=typical)
        for one in (DECLARED, Conventions(units=unit))
    )
    row = row_of(DECLARED, units=unit)
    assert log_p(read)[row] == pytest.approx(log_p(right, Conventions(units=unit))[0], abs=1e-6)
