"""The evidence of boxes that an object is at a wrong place, and the reason."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.questions.standing import (
    FLOATS,
    HUNG,
    HUNG_STD,
    ON_FLOOR,
    ON_OBJECT,
    ROOM,
    SUNK,
    WRONG,
    Standing,
    shares_in_scene,
    standing,
)

# Size in metres; shares of the floor, of the wall and of supports; usual supporters; share k of the
# things far below the top. The rest of the supporters is not in the scene.
THINGS = {
    "bed": ((1.6, 2.1, 0.9), (0.97, 0.01, 0.02), {}, 0.6),
    "chandelier": ((0.8, 0.8, 0.5), (0.01, 0.98, 0.01), {}, 0.0),
    "cup": ((0.08, 0.08, 0.1), (0.005, 0.015, 0.98), {"table": 0.5, "shelf": 0.1}, 0.0),
    "curtain": ((2.0, 0.15, 2.2), (0.02, 0.96, 0.02), {}, 0.0),
    "fridge": ((0.7, 0.7, 1.8), (0.97, 0.01, 0.02), {}, 0.9),
    "laundry basket": ((0.45, 0.45, 0.6), (0.7, 0.01, 0.29), {"washing machine": 0.6}, 0.8),
    "nightstand": ((0.5, 0.4, 0.5), (0.97, 0.01, 0.02), {}, 0.3),
    "pillow": ((0.6, 0.4, 0.15), (0.03, 0.01, 0.96), {"bed": 0.8, "sofa": 0.15}, 0.0),
    "shelf": ((0.9, 0.3, 1.8), (0.8, 0.18, 0.02), {}, 0.9),
    "sofa": ((2.0, 0.9, 0.8), (0.98, 0.0, 0.02), {}, 0.7),
    "table": ((1.6, 0.8, 0.75), (0.96, 0.01, 0.03), {}, 0.1),
    "umbrella": ((0.15, 0.15, 0.9), (0.4, 0.3, 0.3), {}, 0.0),
    "washing machine": ((0.6, 0.6, 0.85), (0.97, 0.01, 0.02), {}, 0.5),
    "window": ((1.4, 0.1, 1.2), (0.0, 1.0, 0.0), {}, 0.0),
}
ANY = {"table": 0.3, "shelf": 0.2, "bed": 0.1}  # shares among the supporters of all things
ERROR = 0.05


def judge(*placed, floor=0.0, error=ERROR, containers=()):
    """The fields of `Standing` of (label, centre x, y, and height of the bottom)."""
    rows = [THINGS[label] for label, *_ in placed]
    sizes = np.array([row[0] for row in rows], float)
    centres = np.array([place for _, *place in placed], float)
    centres[:, 2] += sizes[:, 2] / 2
    errors = np.column_stack([np.full(len(rows), error), np.hypot(error, sizes[:, 2] * error)])
    of_things = np.array([[row[2].get(label, 0.01) for label, *_ in placed] for row in rows])
    of_any = np.array([[ANY.get(label, 0.01) for label, *_ in placed]])
    return Standing(
        *standing(
            (centres, sizes, np.zeros(len(rows)), errors),
            floor,
            np.array([row[1] for row in rows]),
            shares_in_scene(np.concatenate([of_things, of_any])),
            np.array([row[3] for row in rows]),
            np.array([float(label in containers) for label, *_ in placed]),
        )
    )


def normal(distance, s):
    """The density of an error s, of which 1 % are three times as large."""
    one, three = (math.exp(-0.5 * (distance / k / s) ** 2) / k for k in (1, 3))
    return (0.99 * one + 0.01 * three) / (s * math.sqrt(2 * math.pi))


def share(margin, s):
    return 0.5 * (1 + math.erf(margin / s / math.sqrt(2)))


@pytest.mark.parametrize("bottom", [0.0, 0.05, 0.3, 1.2])
def test_a_box_on_nothing_is_that_of_a_hand_computation(bottom):
    """An umbrella above the floor: on the floor, on the wall, or on an unlisted object."""
    at = judge(("umbrella", 0, 0, bottom), ("fridge", 5, 0, 0))
    s = math.hypot(ERROR, 0.9 * ERROR)
    on_floor, below = normal(bottom, s), share(-2 * s - bottom, s)
    lifted = share(bottom - 0.2, s) / ROOM
    hung = share(bottom, s) / ROOM / 2 + normal(bottom + 0.9 - HUNG, HUNG_STD) / 2
    # 1 % of the supporters are of each class, and unlisted ones count with .3 of their share.
    unlisted = 0.3 * 0.98 / (0.3 * 0.98 + 0.02) * lifted * share(2.0 - bottom, s)
    usual = 0.4 * on_floor + 0.3 * hung + 0.3 * unlisted
    # The fridge shows the floor with its share of the floor.
    wrong = np.array(WRONG) * [0.97 * on_floor, unlisted, (1 - below) / ROOM, below / ROOM]
    assert at.log_ratio[0] == pytest.approx(math.log(wrong.sum() / usual))
    wrong[ON_OBJECT] = 0.0  # it touches nothing
    assert (at.reason[0], at.anchor[0], at.held[0]) == (wrong.argmax(), -1, 0.0)


@pytest.mark.parametrize("lift", [0.0, 0.08, -0.05])
def test_a_box_on_another_is_that_of_a_hand_computation(lift):
    """A cup in the middle of a table, which carries it, and holds some things lower."""
    at = judge(("table", 0, 0, 0), ("cup", 0, 0, 0.75 + lift))
    s, of_table = math.hypot(ERROR, 0.1 * ERROR), math.hypot(ERROR, 0.75 * ERROR)
    error, bottom = math.hypot(s, of_table), 0.75 + lift
    inside = share(-lift, error) * share(bottom, error)
    density = 0.9 * normal(lift, error) + 0.1 * inside / 0.75
    on_floor, lifted = normal(bottom, s), share(bottom - 0.2, s) / ROOM
    hung = share(bottom, s) / ROOM / 2 + normal(bottom + 0.1 - HUNG, HUNG_STD) / 2
    blocked = 1 - share(lift - 0.2, error)
    # Where the table does not carry the cup, an unlisted object may have the height of the table.
    carried, beside = max(math.exp(-0.5 * (lift / error) ** 2), 0.1 * inside), 0.03
    level = (1 + beside * ROOM * normal(bottom, error)) / (1 + beside)
    unheld = lifted * share(2.0 - bottom, s) * (carried + (1 - carried) * level)
    # Half of the supporters of cups are tables, 1 % are cups, and unlisted ones count with .3.
    table, rest = np.array([0.5, 0.3 * 0.49]) / (0.51 + 0.3 * 0.49)
    held = table * density + rest * blocked * unheld
    usual = 0.005 * on_floor + 0.015 * hung + 0.98 * held
    r = (1 - 0.015) * WRONG[ON_OBJECT] * density  # things on the wall are on nothing
    r /= r + usual - 0.98 * table * density
    # The same with the supporters of all things: .3 are tables.
    table, rest = np.array([0.3, 0.3 * 0.69]) / (0.31 + 0.3 * 0.69)
    sunk = 0.9 * share(-2 * error - lift, error) * inside
    strange = table * density + rest * unheld
    wrong = np.array(WRONG) * [0.96 * on_floor, strange, 1 / ROOM, sunk / ROOM]
    assert at.log_ratio[1] == pytest.approx(math.log(wrong.sum() / usual), abs=1e-5)
    assert (at.reason[1], at.anchor[1]) == (ON_OBJECT, 0)
    assert at.held[1] == pytest.approx(r, abs=1e-5)


def test_things_at_one_height_share_a_supporter_that_the_scene_does_not_list():
    """A pillow and a cup at .9 m are on one worktop, if the cup is near and no bed is below it."""
    near, far, over_a_bed = (
        judge(("pillow", 0, 0, 0.9), ("cup", x, 0, 0.9), ("bed", y, 0, 0)).log_ratio[0]
        for x, y in ((0.5, 5), (2.0, 5), (0.5, 0))
    )
    assert near < far - 0.3
    assert over_a_bed == pytest.approx(
        judge(("pillow", 0, 0, 0.9), ("cup", 2.0, 0, 0.9), ("bed", 0, 0, 0)).log_ratio[0], abs=0.01
    )


def test_the_inside_of_a_container_is_not_the_floor():
    placed = ("cup", 0, 0, 0.02), ("shelf", 0, 0, 0), ("table", 5, 0, 0)
    on_floor, inside = judge(*placed), judge(*placed, containers=("shelf",))
    assert on_floor.reason[0] == ON_FLOOR
    assert inside.log_ratio[0] < on_floor.log_ratio[0] - 0.5


def test_a_single_box_cannot_show_the_floor_and_lie_wrong_on_it():
    assert judge(("cup", 0, 0, 0)).reason.tolist() == [-1]
    assert judge(("cup", 0, 0, 0), ("cup", 5, 0, 0)).reason.tolist() == [-1, -1]
    assert judge(("cup", 0, 0, 0), ("bed", 5, 0, 0)).reason.tolist() == [ON_FLOOR, -1]


def test_a_box_high_above_the_floor_is_that_of_a_hand_computation():
    """A cup that reaches 10 cm into a pillow near its edge, 3 m above the floor of two pieces."""
    at = judge(
        ("cup", 0.05, 0, 3.0), ("pillow", 0.3, 0, 2.95), ("bed", 5, 0, 0), ("table", 9, 0, 0)
    )
    s, of_pillow = math.hypot(ERROR, 0.1 * ERROR), math.hypot(ERROR, 0.15 * ERROR)
    error, lift = math.hypot(s, of_pillow), 3.0 - 3.1
    # The cup covers x from .01 to .09, and the pillow from 0 to .6: it is within by 1 cm.
    overlap = share((1 - 0.3) * 0.08 + 0.01, math.hypot(ERROR, ERROR))
    inside = share(-lift, error) * share(lift + 0.15, error)
    density = overlap * (0.9 * normal(lift, error) + 0.1 * inside / 0.15)
    thick = 1 - math.exp(-0.5 * (0.15 / error) ** 2)
    carried = overlap * max(thick * math.exp(-0.5 * (lift / error) ** 2), 0.0)
    beside = 0.96 * math.exp(-0.5 * (0.25 / 0.5) ** 2)
    level = (1 + beside * ROOM * normal(0.05, error)) / (1 + beside)
    higher = 0.25 + 0.75 * share(2.0 - 3.0, s)
    unlisted = higher / ROOM * (carried + (1 - carried) * level)
    hung = 1 / ROOM / 2 + normal(3.1 - HUNG, HUNG_STD) / 2
    # Of the supporters of cups, half are tables, and 1 % each of the other classes.
    total = 0.53 + 0.3 * 0.47
    usual = 0.015 * hung + 0.98 * (0.01 * density + 0.3 * 0.47 * unlisted) / total
    total = 0.42 + 0.3 * 0.58
    strange = (0.01 * density + 0.3 * 0.58 * unlisted) / total
    sunk = overlap * share(-2 * error - lift, error) * inside / ROOM
    wrong = np.array(WRONG) * [0.0, strange, 1 / ROOM, sunk]
    assert at.log_ratio[0] == pytest.approx(math.log(wrong.sum() / usual), abs=1e-4)
    # Both pieces show the floor, so it counts as shown: the sum of their shares is at most 1.
    assert at.reason[0] == (ON_OBJECT if WRONG[ON_OBJECT] * density > wrong[FLOATS] else FLOATS)


RIGHT = [
    # The curtain reaches the floor, and the window is behind it.
    (("window", 0, 0, 0.9), ("curtain", 0, 0.05, 0.02)),
    (("chandelier", 0, 0, 1.9), ("table", 0, 0, 0)),
    (("umbrella", 3, 0, 0.0), ("table", 0, 0, 0)),
    (("laundry basket", 3, 0, 0.0), ("table", 0, 0, 0)),
    (("laundry basket", 0, 0, 0.85), ("washing machine", 0, 0, 0)),
    (("fridge", 0, 0, 0.05), ("table", 3, 0, 0)),
    (("pillow", 0, 0.7, 0.55), ("bed", 0, 0, 0)),  # in front of the headboard
    (("cup", 0, 0, 1.1), ("shelf", 0, 0, 0)),  # on a board
    (("cup", 3, 0, 0.9), ("table", 0, 0, 0)),  # on a worktop that nobody lists
    (("cup", 0.3, 0, 0.8), ("table", 0, 0, 0)),
]
WRONG_PLACES = [
    (("cup", 0, 0, 1.4), ("table", 0, 0, 0), FLOATS, -1),
    (("cup", 3, 0, 0.0), ("table", 0, 0, 0), ON_FLOOR, -1),
    (("nightstand", 0, 0, 0.9), ("bed", 0, 0, 0), ON_OBJECT, 1),
    (("sofa", 0, 0, -0.4), ("table", 5, 0, 0), SUNK, -1),
    (("sofa", 0, 0, 0.75), ("table", 0, 0, 0), ON_OBJECT, 1),
    # Things may be in a fridge, and hardly in a table.
    (("washing machine", 0, 0, 0.4), ("fridge", 0, 0, 0), ON_OBJECT, 1),
    (("fridge", 0, 0, 0.3), ("table", 0, 0, 0), SUNK, 1),
    (("table", 0, 0, 0.8), ("bed", 6, 0, 0), FLOATS, -1),
    (("pillow", 0, 0, 0.0), ("bed", 6, 0, 0), ON_FLOOR, -1),
    (("washing machine", 0, 0, 0.75), ("table", 0, 0, 0), ON_OBJECT, 1),
]
"""Each first object is at a wrong place: the reason, and the anchor."""


@pytest.mark.parametrize("placed", RIGHT, ids=lambda placed: placed[0][0])
def test_usual_places_are_not_wrong(placed):
    at = judge(*placed)
    assert at.log_ratio.max() < 1.0


@pytest.mark.parametrize(("thing", "other", "reason", "anchor"), WRONG_PLACES)
def test_wrong_places_and_their_reasons(thing, other, reason, anchor):
    at = judge(thing, other)
    assert at.log_ratio[0] > 0.5
    assert (at.reason[0], at.anchor[0]) == (reason, anchor)
    assert at.log_ratio[1] < 0.0


@pytest.mark.parametrize("reason", [ON_FLOOR, ON_OBJECT, FLOATS])
def test_wrong_places_have_more_evidence_than_usual_ones_of_the_same_reason(reason):
    """Each reason has a judgement of its own."""
    judged = [judge(*placed) for placed in RIGHT]
    right = max(at.log_ratio[at.reason == reason].max(initial=-math.inf) for at in judged)
    wrong = min(judge(*row[:2]).log_ratio[0] for row in WRONG_PLACES if row[2] == reason)
    assert wrong > right + 1.0


@given(st.sampled_from(RIGHT), st.floats(-20, 20), st.floats(-2, 2))
def test_only_differences_of_positions_matter(placed, x, z):
    moved = [(label, a + x, b - x, c + z) for label, a, b, c in placed]
    one, two = judge(*placed), judge(*moved, floor=z)
    assert one.log_ratio == pytest.approx(two.log_ratio, abs=1e-6)
    assert one.reason.tolist() == two.reason.tolist()


@pytest.mark.parametrize("error", [0.02, 0.05, 0.1])
def test_a_higher_box_over_the_table_floats_more(error):
    """A cup more than 20 cm over its usual supporter is hardly on an unlisted object."""
    lifts = np.linspace(0.2, 0.6, 9)
    t = [
        judge(("cup", 0, 0, 0.75 + lift), ("table", 0, 0, 0), error=error).log_ratio[0]
        for lift in lifts
    ]
    assert np.diff(t).min() > -0.05  # some things at this height hang on a wall
    assert t[-1] > t[0] + 0.5


def test_an_error_explains_a_gap():
    lifted = ("fridge", 0, 0, 0.2), ("table", 3, 0, 0)
    t = [judge(*lifted, error=error).log_ratio[0] for error in (0.02, 0.05, 0.1)]
    assert t == sorted(t, reverse=True)
    assert t[0] > 1 > 0 > t[-1]


def test_without_a_floor_a_box_is_only_judged_on_an_object():
    """Nothing is known about the floor, so nothing is on the floor, below it or far above it."""
    at = judge(("cup", 0, 0, 0.75), ("table", 0, 0, 0), ("sofa", 9, 0, -3), floor=math.nan)
    assert at.reason.tolist() == [ON_OBJECT, -1, -1]
    assert at.log_ratio[0] < 0


def test_boxes_without_a_position_are_not_judged():
    at = judge(("cup", 0, 0, 0.75), ("table", math.nan, 0, math.nan))
    assert (at.reason[1], at.anchor[1], at.log_ratio[1]) == (-1, -1, 0.0)
    assert (at.reason[0], at.anchor[0]) == (-1, -1)


@given(st.lists(st.lists(st.floats(0.0, 0.3), min_size=3, max_size=3), min_size=1, max_size=3))
def test_shares_in_a_scene_sum_to_1_and_keep_the_ratios_of_listed_classes(rows):
    supporters = np.array(rows)
    found = shares_in_scene(supporters)
    assert found.sum(1) == pytest.approx(1)
    listed = supporters.sum(1)
    # An unlisted supporter counts with .3 of its share.
    assert found[:, -1] == pytest.approx(0.3 * (1 - listed) / (listed + 0.3 * (1 - listed)))
    assert found[:, :-1] * listed[:, None] == pytest.approx(
        supporters * found[:, :-1].sum(1, keepdims=True), abs=1e-9
    )
