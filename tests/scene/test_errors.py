"""Probabilities of relations between boxes with errors of their positions and sizes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene import Scene, SceneObject, observe
from app.scene.scene import (
    CONTACT,
    POSITION_STD,
    SIZE_STD,
    SPREAD,
    TOUCH,
    contact_weights,
    derive_relations,
    errors_of,
)
from app.scene.spatial_relations import ABOVE, CANONICAL, FRONT, INSIDE, LEFT, ON_TOP
from tests.scene.test_geometry import COUNTS, LABELS

NAN = math.nan
TABLE = (2.0, 0.0, 0.4), (1.0, 1.6, 0.8)
CUP_SIZE = (0.1, 0.1, 0.1)


def cup(lift, y=0.0):
    """A cup over the table, with this lift."""
    return (2.0, y, 0.8 + lift + 0.05), CUP_SIZE


def probabilities(*things, error=0.0, of_faces=None, labels=None):
    """p[a, i, j] of boxes (centre, size) with one error of the centres, and one of the faces."""
    positions, sizes = zip(*things, strict=True)
    faces = error if of_faces is None else of_faces
    errors = np.tile([error, faces], (len(things), 1)).astype(float)
    classes = None if labels is None else np.array([LABELS.index(label) for label in labels])
    roles = None if labels is None else COUNTS
    found = derive_relations(positions, sizes, errors=errors, classes=classes, roles=roles)
    return found.probability


coordinate, extent = st.floats(-1.0, 1.0), st.floats(0.02, 1.2)
boxes = st.tuples(
    st.tuples(coordinate, coordinate, st.floats(0.0, 1.5)), st.tuples(extent, extent, extent)
)


@given(boxes, boxes, st.sampled_from([0.0, 0.01, 0.05, 0.2]), st.booleans())
def test_relations_of_two_boxes_exclude_each_other(one, other, error, known):
    """All stacked relations, or one direction of left or front, in either order of the boxes."""
    labels = ("lamp", "shelf") if known else None
    p = probabilities(one, other, error=error, labels=labels)
    assert (p >= 0).all()
    assert p[ON_TOP:].sum() <= 1 + 1e-6
    assert p[[LEFT, FRONT]].sum() <= 1 + 1e-6
    assert not p[:, [0, 1], [0, 1]].any()
    # Lateral relations hold if no stacked one does.
    assert p[[LEFT, FRONT]].sum() + p[ON_TOP:].sum() <= 1 + 1e-6
    mirrored = probabilities(other, one, error=error, labels=labels and labels[::-1])
    assert mirrored.swapaxes(1, 2) == pytest.approx(p, abs=1e-5)


@pytest.mark.parametrize("height", [0.12, 0.14])
def test_boxes_at_the_same_height_are_not_on_each_other(height):
    """Their centres have the same height, so the order of the boxes would decide."""
    one, other = ((2.0, 0.0, 0.5), (0.3, 0.3, 0.12)), ((2.0, 0.1, 0.5), (0.3, 0.3, height))
    for pair in ((one, other), (other, one)):
        assert not probabilities(*pair, error=0.05)[[ON_TOP, ABOVE]].any()


@given(boxes, boxes)
def test_boxes_without_errors_have_certain_overlaps_and_directions(one, other):
    """Only the lift has an error, of at least 2 cm. It decides between the stacked relations."""
    p = probabilities(one, other)
    assert np.isin(p[[LEFT, FRONT]], [0, 1]).all()
    total = p[ON_TOP:].sum()
    assert total == pytest.approx(0) or total <= 1 + 1e-6
    if total > 0:
        assert not p[[LEFT, FRONT]].any()


ERRORS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)


def test_a_resting_box_is_less_certain_with_a_larger_error():
    on = [probabilities(cup(0.0), TABLE, error=s)[ON_TOP, 0, 1] for s in ERRORS]
    assert on == sorted(on, reverse=True)
    assert on[0] > 0.95
    # The smallest error of a lift is 2 cm, which two errors of 1 cm do not exceed.
    assert on[0] == probabilities(cup(0.0), TABLE, error=0.01)[ON_TOP, 0, 1]
    assert on[-1] < on[2] - 0.2


def test_a_floating_box_touches_more_probably_with_a_larger_error():
    """The lift is 20 cm: a gap without errors, and perhaps none with an error of 10 cm."""
    errors = (0.0, 0.05, 0.07, 0.1)
    above = [probabilities(cup(0.2), TABLE, error=s)[ABOVE, 0, 1] for s in errors]
    on = [probabilities(cup(0.2), TABLE, error=s)[ON_TOP, 0, 1] for s in errors]
    assert above == sorted(above, reverse=True)
    assert on == sorted(on)
    assert (above[0], on[0]) == pytest.approx((1, 0), abs=1e-6)
    assert on[-1] > 0.5


@pytest.mark.parametrize("error", ERRORS)
def test_a_higher_box_is_less_probably_on_the_table_and_more_probably_above_it(error):
    p = [probabilities(cup(lift), TABLE, error=error) for lift in np.linspace(0, 1, 21)]
    on, above = ([float(one[a, 0, 1]) for one in p] for a in (ON_TOP, ABOVE))
    assert on == sorted(on, reverse=True)
    assert above == sorted(above)
    assert above[-1] > 4 * on[-1]


def test_the_overlap_and_the_direction_are_less_certain_with_a_larger_error():
    """The cup is over the edge with 60 % of its footprint, and a box is 30 cm to the left."""
    over_edge, beside = cup(0.0, y=0.79), ((2.0, 0.3, 0.5), (0.05, 0.05, 0.5))
    other = (2.0, 0.0, 0.5), (0.05, 0.05, 0.5)
    on = [probabilities(over_edge, TABLE, error=s, of_faces=0.0)[ON_TOP, 0, 1] for s in ERRORS]
    left = [probabilities(beside, other, error=s)[LEFT, 0, 1] for s in ERRORS]
    for values in (on, left):
        assert values == sorted(values, reverse=True)
        assert values[0] > values[2] > values[-1]
    assert left[0] == 1


def test_an_uncertain_overlap_leaves_both_a_support_and_a_direction():
    """The edge of the table is at 80 cm, and 40 % of the box, or nearly 30 %, are over it."""
    box = (0.2, 0.2, 0.2)
    p = probabilities(((2.0, 0.82, 0.9), box), TABLE, error=0.05)
    assert p[ON_TOP, 0, 1] >= 0.5
    assert p[LEFT, 0, 1] == 0
    p = probabilities(((2.0, 0.85, 0.9), box), TABLE, error=0.05)
    assert 0.3 < p[ON_TOP, 0, 1] < 0.5 < p[LEFT, 0, 1] < 0.7
    # The rest is that the box reaches into the table in an undecided role.
    assert p[LEFT, 0, 1] + p[ON_TOP:].sum() == pytest.approx(1, abs=0.05)


def test_without_errors_a_lift_of_five_centimetres_is_the_limit():
    touch, above, deep = contact_weights(CONTACT, 0.0)
    assert touch == pytest.approx(above + deep)
    for lift in (0.0, 0.03, 0.049, -0.049):
        touch, above, deep = contact_weights(lift, 0.0)
        assert touch > above + deep
    for lift in (0.051, 0.2, -0.051, -0.2):
        touch, above, deep = contact_weights(lift, 0.0)
        assert touch < above + deep
        assert (above > deep) == (lift > 0)


@given(st.floats(-2, 2), st.floats(0, 0.5))
def test_above_and_into_are_complements_and_mirror_images(lift, error):
    touch, above, deep = contact_weights(lift, error)
    assert above + deep == pytest.approx(1)
    assert contact_weights(-lift, error) == pytest.approx((touch, deep, above))


@pytest.mark.parametrize("error", [0.02, 0.05, 0.12])
def test_the_weights_of_contact_are_the_posterior_of_a_simulation(error):
    """The true lift is 0 with the mass `TOUCH`, or it has one unit of mass for each metre."""
    rng, n, reach = np.random.default_rng(0), 4_000_000, 1.0
    touches = rng.random(n) < TOUCH / (TOUCH + 2 * reach)
    true = np.where(touches, 0.0, rng.uniform(-reach, reach, n))
    measured = true + rng.normal(0.0, error, n)
    for lift in (0.0, 0.04, 0.1, -0.06, 0.3):
        near = np.abs(measured - lift) < 0.002
        weights = np.array(contact_weights(lift, error))
        expected = weights / weights.sum()
        cases = touches[near], ~touches[near] & (true[near] > 0), ~touches[near] & (true[near] < 0)
        shares = [case.mean() for case in cases]
        # Five standard deviations of the share in a sample of this size.
        assert near.sum() > 2000
        assert shares == pytest.approx(expected, abs=2.5 / math.sqrt(near.sum()))


@pytest.mark.parametrize("size", [(0.02, 0.02, 0.003), (0.14, 0.01, 0.01), (0.5, 0.5, 0.3)])
@pytest.mark.parametrize("yaw", [0.0, 0.8])
def test_the_distance_to_the_edge_makes_small_things_certain(size, yaw):
    """A coin, a pen and a box in the middle of the table, and at its edge."""
    height = 0.8 + size[2] / 2
    errors = np.full((2, 2), 0.05)

    def overlap(y):
        found = derive_relations(
            [(2.0, y, height), TABLE[0]], [size, TABLE[1]], [yaw, 0.0], errors=errors
        )
        return float(found.probability[ON_TOP:].sum())

    p = [overlap(y) for y in np.linspace(0, 1.2, 25)]
    assert p == sorted(p, reverse=True)
    # In the middle, the overlap is certain: the rest is that the box reaches into the table.
    touch, above, deep = contact_weights(0.0, math.hypot(0.05, 0.05))
    assert p[0] == pytest.approx((touch + above) / (touch + above + deep), abs=1e-4)
    assert p[-1] < 0.02


@pytest.mark.parametrize(
    ("size", "centre", "relation"),
    [
        # A shelf of 3 m on a table of 1.6 m, centred over it, and centred beside it.
        ((0.8, 3.0, 0.2), (2.0, 0.0, 0.9), ON_TOP),
        ((0.8, 3.0, 0.2), (2.0, 0.7, 0.9), ON_TOP),
        ((0.8, 3.0, 0.2), (2.0, 0.9, 0.9), ABOVE),
        # A smaller box may overhang: its centre is beside the table.
        ((0.4, 1.0, 0.2), (2.0, 0.95, 0.9), ON_TOP),
    ],
)
def test_an_overhanging_larger_box_is_above_and_not_on(size, centre, relation):
    p = probabilities((centre, size), TABLE)
    likely = {ON_TOP: ABOVE, ABOVE: ON_TOP}[relation]
    assert p[relation, 0, 1] > 0.9
    assert p[likely, 0, 1] < 0.05


def test_the_axes_of_a_turned_anchor_tell_whether_it_carries_a_larger_box():
    """A plank of 3 m lies across a table of 1 m by 1.6 m, with its centre 70 cm from it."""
    plank = (0.6, 3.0, 0.2)
    for turn, carries in ((0.0, True), (math.pi / 2, False)):
        found = derive_relations([(2.0, 0.7, 0.9), TABLE[0]], [plank, TABLE[1]], [0.0, turn])
        assert (found.probability[ON_TOP, 0, 1] > 0.9) == carries


ROOM = {
    "desk": ((2.0, 0.0, 0.375), (0.8, 1.6, 0.75)),
    "monitor": ((2.0, 0.2, 0.75 + 0.2), (0.1, 0.5, 0.4)),
    "lamp": ((2.0, -0.5, 0.75 + 0.2), (0.15, 0.15, 0.4)),
    "bed": ((2.0, 4.0, 0.25), (2.0, 1.6, 0.5)),
    "pillow": ((2.0, 4.4, 0.5 + 0.06), (0.4, 0.6, 0.12)),
}
SUPPORTS = {("monitor", "desk"), ("lamp", "desk"), ("pillow", "bed")}


def test_measured_positions_keep_the_supports_of_resting_boxes():
    """Each coordinate has an error of 5 cm. A support remains in 9 of 10 measurements or more."""
    rng, names = np.random.default_rng(0), list(ROOM)
    centres, sizes = (np.array(part) for part in zip(*ROOM.values(), strict=True))
    faces = np.hypot(POSITION_STD, SIZE_STD * sizes[:, 2] / 2)
    errors = np.column_stack([np.full(len(names), POSITION_STD), faces])
    kept = dict.fromkeys(SUPPORTS, 0)
    rounds, false = 400, 0
    for _ in range(rounds):
        noisy = centres + rng.normal(0, POSITION_STD, centres.shape)
        holds = derive_relations(noisy, sizes, errors=errors).holds
        on = {(names[i], names[j]) for i, j in np.argwhere(holds[ON_TOP])}
        false += len(on - SUPPORTS)
        for pair in on & SUPPORTS:
            kept[pair] += 1
    assert min(kept.values()) >= 0.9 * rounds
    assert not false
    # Read as exact, the same boxes lose about half of their supports.
    exact = derive_relations(centres + rng.normal(0, POSITION_STD, centres.shape), sizes)
    assert len(np.argwhere(exact.holds[ON_TOP])) < len(SUPPORTS) + 1


def things(*stated):
    """Objects with these standard deviations of position and size."""
    return [
        SceneObject(str(k), str(k), None, size=size, position_std=p, size_std=s)
        for k, (size, p, s) in enumerate(stated)
    ]


def test_errors_of_stated_and_typical_sizes():
    objects = things(
        ((1.0, 1.0, 0.8), None, None), ((1.0, 1.0, 0.8), 0.01, 0.02), (None, 0.0, None),
        (None, None, None), (None, None, 0.3),
    )  # fmt: skip
    extents = np.tile([1.0, 1.0, 0.8], (5, 1))
    classes, spread = np.array([0, 0, 1, -1, 1]), np.array([0.5, 0.25])
    expected = [
        (POSITION_STD, math.hypot(POSITION_STD, SIZE_STD * 0.4)),
        (0.01, math.hypot(0.01, 0.01)),
        (0.0, 0.25 * 0.4),
        (POSITION_STD, math.hypot(POSITION_STD, SPREAD * 0.4)),
        (POSITION_STD, math.hypot(POSITION_STD, 0.15)),
    ]
    assert errors_of(objects, extents, classes, spread) == pytest.approx(np.array(expected))
    # Without spreads, all typical sizes have one.
    plain = errors_of(objects, extents, classes, None)
    assert plain[2] == pytest.approx([0.0, SPREAD * 0.4])


def test_the_errors_of_a_request_decide_between_on_top_and_above():
    """The lift of a lamp over the table is 12 cm: a gap if the boxes are exact."""
    (x, y, z), size = cup(0.12)
    lamp = SceneObject("lamp", "lamp", None, position=(x, y, z), size=size)
    table = SceneObject("table", "table", None, position=TABLE[0], size=TABLE[1])
    assert observe(Scene((lamp, table))).triples == ((ON_TOP, 0, 1),)
    exact = [replace(thing, position_std=0.0, size_std=0.0) for thing in (lamp, table)]
    assert observe(Scene(tuple(exact))).triples == ((ABOVE, 0, 1),)


def test_unlikely_relations_of_boxes_remain_in_the_table():
    """The rows have the probability of each relation, and those of at least .5 hold."""
    lamp = SceneObject("lamp", "lamp", None, position=cup(0.12)[0], size=CUP_SIZE)
    table = SceneObject("table", "table", None, position=TABLE[0], size=TABLE[1])
    seen = observe(Scene((lamp, table))).relations
    columns = seen.relation.tolist(), seen.subject.tolist(), seen.probability.tolist()
    p = {(a, i): value for a, i, value in zip(*columns, strict=True)}
    assert len(p) == 2 * len(CANONICAL)
    assert 0.5 < p[ON_TOP, 0] < 0.9
    assert p[ABOVE, 0] == pytest.approx(1 - p[ON_TOP, 0], abs=0.1)
    assert 0 == p[ON_TOP, 1] == p[ABOVE, 1] == p[INSIDE, 1]


def test_a_bin_under_the_desk_is_below_it_with_the_probability_that_they_overlap():
    desk, bin_ = ((2.0, 0.0, 0.375), (0.7, 1.4, 0.75)), ((2.1, 0.4, 0.175), (0.3, 0.3, 0.35))
    p = probabilities(bin_, desk, error=0.03, labels=("bin", "desk"))
    assert p[ABOVE, 1, 0] > 0.95
    assert p[ON_TOP:].sum() == pytest.approx(1, abs=1e-3)
    assert p[[ON_TOP, INSIDE]].max() < 0.03
