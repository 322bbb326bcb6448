import math
from dataclasses import replace
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from app.scene import RelationTable, Scene, SceneObject, observe
from app.scene.scene import Viewpoint, derive_relations, pool_classes, to_viewer_frame
from app.scene.spatial_relations import (
    ABOVE,
    CANONICAL,
    FRONT,
    INSIDE,
    LEFT,
    ON_TOP,
    RELATIONS,
    STACKED,
    canonicalise,
    opposite,
    support_cycle,
)
from app.scene.stands import (
    FLOOR,
    HANGS,
    SUPPORTED,
    UNKNOWN,
    Heights,
    floor_level,
    stands_of,
)
from scene_client.frames import (
    METRES,
    Conventions,
    is_optical,
    is_world_fixed,
    optical_name,
    viewer_axes,
)
from scene_client.schemas import RelationName
from tests.scene.test_geometry import LABELS, role_counts
from training.datasets.encoding import pool_instances

DESK = SceneObject("desk", "desk", 0, position=(2.0, 0.0, 0.4), size=(0.8, 1.6, 0.8))
MONITOR = SceneObject("monitor", "monitor", 1, position=(2.0, 0.2, 1.0), size=(0.1, 0.5, 0.4))
SOFA = SceneObject("sofa", "sofa", 3, position=(6.0, 0.0, 0.4), size=(0.9, 2.0, 0.8))
CHAIR = SceneObject("chair", "chair", 2, position=(1.2, 0.0, 0.5))


def excluded(scene: Scene) -> np.ndarray:
    off = scene.relations.rows(scene.relations.probability == 0)
    grid = np.zeros((len(CANONICAL), *[len(scene.objects)] * 2), bool)
    grid[off.relation, off.subject, off.object] = True
    return grid


def test_poses_become_relations() -> None:
    seen = observe(Scene((DESK, MONITOR, CHAIR)))
    assert set(seen.triples) == {(ON_TOP, 1, 0), (FRONT, 2, 0), (FRONT, 2, 1)}
    assert seen.has_boxes
    _, observed = seen.relations.grids(3)
    assert observed[LEFT, 0, 2]
    assert not observed[ABOVE, 0, 2]  # the chair has no size


def test_flat_boxes_have_relations_and_boxes_below_a_millimetre_have_no_size() -> None:
    rug = replace(MONITOR, id="rug", position=(2.0, 0.0, 0.0), size=(2.0, 3.0, 0.0))
    assert observe(Scene((DESK, rug))).triples == ((ON_TOP, 0, 1),)
    speck = replace(rug, size=(0.0, 0.0, 0.0005))
    bare = replace(rug, size=None)
    assert observe(Scene((DESK, speck))).triples == observe(Scene((DESK, bare))).triples


def test_typical_sizes_take_the_place_of_unknown_ones() -> None:
    cup = SceneObject("cup", "cup", 2, position=(2.0, -0.5, 0.85))
    sizes = np.array([[math.nan] * 3, [math.nan] * 3, [0.1, 0.1, 0.1]])
    without = observe(Scene((DESK, cup)))
    assert (ON_TOP, 1, 0) not in without.triples
    assert observe(Scene((DESK, cup)), typical_sizes=sizes).triples == ((ON_TOP, 1, 0),)
    # A label outside the vocabulary has no typical size.
    stranger = SceneObject("cup", "goblet", None, position=(2.0, -0.5, 0.85))
    assert observe(Scene((DESK, stranger)), typical_sizes=sizes).triples == without.triples


def test_stated_relations_stay_and_poses_exclude_others() -> None:
    """The monitor stands on the desk, 20 cm to the left, and the sofa is far away."""
    objects = (DESK, MONITOR, SOFA)
    stated = Scene(objects, RelationTable.stated([(ON_TOP, 2, 0), (LEFT, 1, 0)], [False, True]))
    seen, derived = observe(stated, viewpoint=Viewpoint(0, 0, 0)), observe(Scene(objects))
    assert (seen.objects, seen.triples, seen.opposites) == (
        objects, ((ON_TOP, 2, 0), (LEFT, 1, 0)), {(LEFT, 1, 0)}
    )  # fmt: skip
    assert not seen.has_boxes
    assert np.argwhere(excluded(derived) ^ excluded(seen)).tolist() == [
        [LEFT, 1, 0], [ON_TOP, 2, 0]
    ]  # fmt: skip
    assert excluded(seen)[[*STACKED], 0, 2].all()
    assert not excluded(seen)[ON_TOP, 1, 0]
    # The sofa is behind the desk.
    assert np.argwhere(~excluded(seen)[[LEFT, FRONT], 0, 2]).tolist() == [[FRONT]]
    assert excluded(seen)[[LEFT, FRONT], 2, 0].all()


def test_in_a_map_without_a_viewer_no_direction_is_excluded() -> None:
    assert not excluded(observe(Scene((DESK, SOFA)), has_viewer=False))[[LEFT, FRONT]].any()


@pytest.mark.parametrize(("distance", "is_far"), [(2.9, False), (3.1, True)])
def test_boxes_of_unknown_size_are_not_stacked_from_far_apart(distance, is_far):
    """A footprint of unknown size reaches at most 1.5 m."""
    places = {"a": 0, "b": distance}.items()
    ends = [SceneObject(name, name, 0, position=(x, 0, 0)) for name, x in places]
    assert excluded(observe(Scene(tuple(ends))))[[*STACKED], 0, 1].all() == is_far


A = len(CANONICAL)


@st.composite
def instances(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    size = draw(st.integers(0, 6))
    classes = draw(hnp.arrays(np.int64, size, elements=st.integers(0, 3)))
    confidence = draw(hnp.arrays(float, size, elements=st.floats(0.01, 1)))
    holds = draw(hnp.arrays(bool, (A, size, size)))
    return classes, confidence, holds, draw(hnp.arrays(bool, (A, size, size)))


@given(instances())
def test_classes_are_the_or_over_instance_pairs(drawn):
    classes, confidence, holds, observed = drawn
    evidence = pool_instances(classes, holds, observed)
    *_, presence = pool_classes(classes, confidence)
    assert evidence.classes.tolist() == sorted(set(classes.tolist()))
    assert evidence.counts.tolist() == [(classes == c).sum() for c in evidence.classes]
    for x, c in enumerate(evidence.classes):
        members = np.flatnonzero(classes == c)
        assert presence[x] == pytest.approx(1 - np.prod(1 - confidence[members]))
        for y, d in enumerate(evidence.classes):
            pairs = [(i, j) for i in members for j in np.flatnonzero(classes == d) if i != j]
            for a in range(A):
                on = any(holds[a, i, j] for i, j in pairs)
                assert evidence.holds[a, x, y] == on
                observes = on or any(observed[a, i, j] for i, j in pairs)
                assert evidence.observed[a, x, y] == observes


def test_observations_are_stated_complete_or_from_boxes() -> None:
    triples = [(ON_TOP, 1, 0), (LEFT, 1, 2)]
    holds, observed = RelationTable.stated(triples).grids(3)
    assert np.argwhere(holds).tolist() == [[LEFT, 1, 2], [ON_TOP, 1, 0]]
    assert np.array_equal(observed, holds)
    complete = RelationTable.stated(triples, complete_for=3)
    assert complete.triples == tuple(triples)
    stated, observed = complete.grids(3)
    assert np.array_equal(stated, holds)
    others = ~np.eye(3, dtype=bool)
    assert np.array_equal(observed, np.broadcast_to(others, observed.shape))
    # Excluded relations are no observations.
    far = np.roll(holds, 1)
    table = RelationTable.shown_by_boxes(holds, holds | far, np.ones_like(far))
    assert table.of_boxes
    assert len(table) == len(CANONICAL) * 6
    for grid, expected in zip(table.grids(3), (holds, holds | far & others), strict=True):
        assert np.array_equal(grid, expected)


@given(instances())
def test_a_relation_of_classes_has_the_largest_probability_of_their_objects(drawn):
    classes, _, holds, observed = drawn
    evidence = pool_instances(classes, holds & observed, observed)
    table = RelationTable.shown_by_boxes(holds & observed, observed, ~observed)
    row = np.searchsorted(evidence.classes, classes)
    a, i, j, p = table.of_classes(row, len(evidence.classes), A - 1) or ()
    expected = np.argwhere(evidence.observed[: A - 1])
    assert np.stack([a, i, j], 1).tolist() == expected.tolist()
    assert p.tolist() == evidence.holds[tuple(expected.T)].tolist()


relations = st.sampled_from(RELATIONS)


def test_the_schema_has_the_same_relations() -> None:
    assert {*get_args(RelationName)} == {*RELATIONS}


@given(relations, st.integers(0, 9), st.integers(0, 9))
def test_a_relation_and_its_opposite_are_one_statement(relation: str, i: int, j: int) -> None:
    assert canonicalise(i, relation, j) == canonicalise(j, opposite(relation), i)
    index, subject, anchor = canonicalise(i, relation, j)
    assert {subject, anchor} == {i, j}
    assert CANONICAL[index] in (relation, opposite(relation))


@pytest.mark.parametrize("name", ["", "Left", "on top", "near", "on_top"])
def test_unknown_relations_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"unknown relation '{name}'.*on-top"):
        canonicalise(0, name, 1)
    with pytest.raises(ValueError, match=rf"unknown relation '{name}'"):
        opposite(name)


def test_supports_in_a_circle_are_found() -> None:
    """Only on-top (2) and inside (4) hold an object."""
    tower = [(2, "box", "book"), (4, "book", "bag"), (2, "bag", "desk")]
    assert support_cycle(tower) is None
    assert support_cycle([*tower, (3, "desk", "box"), (0, "desk", "box")]) is None
    circle = support_cycle([*tower, (2, "desk", "book")])
    assert circle[0] == circle[-1]
    assert {*pairwise(circle)} == {("book", "bag"), ("bag", "desk"), ("desk", "book")}


NAN = math.nan
WORDS = {("bin", "desk"): (0, 9, 0), ("milk", "fridge"): (0, 0, 5), ("pillow", "bed"): (9, 0, 0)}
ROLES = role_counts({tuple(map(LABELS.index, pair)): n for pair, n in WORDS.items()})

Box = tuple[str, tuple[float, float, float], tuple[float, float, float]]
"""Label, extents, and position of the bottom."""

DESK_BOX: Box = ("desk", (1.6, 0.8, 0.75), (0, 0, 0))
FRIDGE: Box = ("fridge", (0.6, 0.6, 0.4), (0, 0, 0))


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
    shares, errors = np.array([0.9, 0.9, 0.9, 0.1, 0.8, 0.0]), np.full(6, 0.05)
    assert floor_level(bottoms, shares, errors) == pytest.approx(0.0, abs=0.03)
    assert floor_level(bottoms + 7, shares, errors) == pytest.approx(7.0, abs=0.03)


def test_the_likelihood_of_a_floor_is_that_of_a_hand_computation() -> None:
    """A shelf at 0 with an error of 5 cm, and a pot at .4 m: the pot is on something.

    At .4 m, the shelf would reach below the floor, which only an error explains.
    """
    bottoms, shares, errors = np.array([0.0, 0.4]), np.array([0.6, 0.55]), np.array([0.05, 0.05])
    peak = 1 / (0.05 * math.sqrt(2 * math.pi))
    low = math.log(0.6 * peak + 0.4 * (0.4 + 0.05)) + math.log(0.4 * (0.45 + 0.05))
    high = math.log(0.4 * 0.05) + math.log(0.55 * peak + 0.4 * (0.45 + 0.05))
    assert low > high
    assert floor_level(bottoms, shares, errors) == 0.0
    # A shelf that hardly ever stands on the floor is no candidate, and the pot stands above it.
    shares[0] = 0.49
    assert math.isnan(floor_level(bottoms, shares, errors))


def test_a_table_top_is_not_the_floor() -> None:
    """A plant usually stands on the floor, but not beside a fork and a spoon at one height."""
    bottoms, errors = np.full(3, 0.8), np.full(3, 0.05)
    assert math.isnan(floor_level(bottoms, np.array([0.6, 0.01, 0.01]), errors))
    # Two chairs at this height are on the floor, and the spoon has fallen.
    assert floor_level(bottoms, np.array([0.98, 0.98, 0.01]), errors) == 0.8
    # Two lamps and a pot on a bed show its top, and the bed shows the floor.
    on_bed, stands = np.array([0.0, 1.0, 1.0, 1.0]), np.array([0.9, 0.2, 0.2, 0.5])
    assert floor_level(on_bed, stands, np.full(4, 0.05)) == 0.0
    # A bin .8 m below a plant shows the floor, although a surface explains the plant better.
    shares, peak = np.array([0.6, 0.9]), 1 / (0.05 * math.sqrt(2 * math.pi))
    floor = math.log(0.6 * peak + 0.4 * (0.4 + 0.05)) + math.log(0.4 * 0.05)
    surface = math.log(0.2 * peak + 0.4 * (0.2 + 0.05)) + math.log(0.4 * (0.05 + 0.9 + 0.05))
    assert surface > floor
    assert floor_level(np.array([0.8, 0.0]), shares, errors[:2]) == 0.0
    # A plant beside a spoon, by hand.
    shares, peak = np.array([0.6, 0.01]), 1 / (0.05 * math.sqrt(2 * math.pi))
    floor = math.log(0.6 * peak + 0.4 * (0.4 + 0.05)) + math.log(0.01 * peak + 0.4 * (0.99 + 0.05))
    surface = math.log(0.2 * peak + 0.4 * (0.2 + 0.05))
    surface += math.log(0.495 * peak + 0.4 * (0.495 + 0.05))
    assert surface > floor
    assert math.isnan(floor_level(bottoms[:2], shares, errors[:2]))


def test_a_certain_box_outweighs_an_uncertain_one() -> None:
    """The error of the first box is 20 cm, so it may stand on the floor of the second one."""
    bottoms, shares = np.array([-0.2, 0.0]), np.array([0.9, 0.9])
    assert floor_level(bottoms, shares, np.array([0.2, 0.02])) == 0.0
    assert floor_level(bottoms, shares, np.array([0.02, 0.2])) == -0.2


floors = st.lists(
    st.tuples(st.floats(-1, 2), st.floats(0, 1), st.floats(0, 0.3)), min_size=1, max_size=6
)


@given(floors)
def test_the_floor_is_the_bottom_of_a_candidate(boxes):
    bottoms, shares, errors = np.array(boxes).T.copy()
    level = floor_level(bottoms, shares, errors)
    candidates = bottoms[shares >= 0.5]
    assert math.isnan(level) or level in candidates
    alone = [
        floor_level(bottoms[k : k + 1], shares[k : k + 1], errors[k : k + 1])
        for k in range(len(bottoms))
    ]
    assert all(
        math.isnan(x) if share < 0.5 else x == b
        for x, b, share in zip(alone, bottoms, shares, strict=True)
    )


def test_the_floor_is_unknown_without_objects_that_stand_on_it() -> None:
    bottoms, errors = np.array([NAN, 0.5]), np.full(2, 0.05)
    assert math.isnan(floor_level(bottoms, np.array([1.0, 0.0]), errors))
    assert math.isnan(floor_level(np.zeros(0), np.zeros(0), np.zeros(0)))
    # A cup tells nothing about the floor.
    assert math.isnan(floor_level(bottoms, np.array([1.0, 0.2]), errors))
    assert floor_level(bottoms, np.array([1.0, 0.6]), errors) == 0.5


def lamp(x: float, bottom: float) -> Box:
    return "lamp", (0.3, 0.3, 0.4), (x, 0, bottom)


@pytest.mark.parametrize(
    ("box", "other", "expected"),
    [
        *((lamp(3, bottom), DESK_BOX, FLOOR) for bottom in (0.0, 0.09, -0.4)),
        *((lamp(3, bottom), DESK_BOX, HANGS) for bottom in (0.11, 1.6)),
        (lamp(0, 0.75), DESK_BOX, SUPPORTED),
        # The relation is on-top of the desk to the bin.
        (("bin", (0.3, 0.3, 0.4), (0.3, 0, 0)), DESK_BOX, FLOOR),
        # The bottom of the milk is near the floor, but the milk is inside.
        (("milk", (0.1, 0.1, 0.2), (0, 0, 0.05)), FRIDGE, SUPPORTED),
        # A chair on a rug.
        (("chair", (0.5, 0.5, 0.9), (0, 0, 0.01)), ("towel", (2.0, 1.5, 0.01), (0, 0, 0)), FLOOR),
        (lamp(0, 0.75 + 0.13), DESK_BOX, UNKNOWN),
        (lamp(0, 0.75 + 0.17), DESK_BOX, HANGS),
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


def same_turn(a: float, b: float, period: float = 2 * math.pi) -> bool:
    return abs(math.remainder(a - b, period)) < 1e-9


@pytest.mark.parametrize(
    ("frame", "optical", "fixed"),
    [
        ("base_link", False, False),
        ("camera_optical", True, False),
        ("robot/camera_color_optical_frame", True, False),
        ("optical_table", False, False),
        ("map", False, True),
        ("MAP", False, True),
        (" Odom ", False, True),
        ("Camera_Optical", True, False),
        ("robot_1/odom", False, True),
        ("/world", False, True),
        ("map_server", False, False),
        ("", False, False),
    ],
)
def test_frames_by_name(frame: str, optical: bool, fixed: bool) -> None:
    assert is_optical(frame) is optical
    assert is_world_fixed(frame) is fixed


def test_optical_axes() -> None:
    # 3 m ahead, 1 m to the right, 2 m below the camera.
    position, size, yaw = Conventions("-y").box((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    assert position == (3.0, -1.0, -2.0)
    # Unturned in optical axes: x is its width, y its height, z its depth.
    assert size == (0.3, 0.1, 0.2)
    assert same_turn(yaw, 0.0)


@given(st.floats(-3, 3), st.floats(-0.6, 0.6))
def test_a_box_on_its_side(angle: float, tilt: float) -> None:
    """Tipped about x the box heads along its z axis, tipped about y along its y axis."""
    for axis, size, heading in (
        ("X", (3.0, 1.0, 2.0), angle - math.pi / 2),
        ("Y", (2.0, 3.0, 1.0), angle + math.pi / 2),
    ):
        # A tilt about the heading leaves it level.
        lean = Rotation.from_euler("ZXZ", [heading, tilt, -heading])
        turn = lean * Rotation.from_euler(f"Z{axis}", [angle, math.pi / 2])
        _, upright, yaw = Conventions().box(None, (1.0, 2.0, 3.0), turn.as_quat().tolist())
        assert upright == size
        assert same_turn(yaw, heading)


@given(st.floats(-0.6, 0.6), st.floats(-3, 3))
def test_a_tilt_is_dropped(tilt: float, angle: float) -> None:
    # Yaw after a tilt about the box's own x axis leaves that axis horizontal.
    both = Rotation.from_euler("ZX", [angle, tilt])
    _, size, yaw = Conventions().box(None, (1.0, 2.0, 3.0), both.as_quat().tolist())
    assert size == (1.0, 2.0, 3.0)
    assert same_turn(yaw, angle)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 2), (0, 0, 0, math.nan)])
def test_quaternions_must_have_length_one(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="quaternion of length 1"):
        Conventions().box((0.0, 0.0, 0.0), None, quaternion)


@given(st.floats(-7, 7), st.sampled_from(["z", "y", "-y"]), st.tuples(*[st.floats(-5, 5)] * 3))
def test_viewer_axes_invert_the_conversion_to_the_viewer(yaw, up, point):
    """A point read into body axes, seen by the viewer, and told in the frame again."""
    body, _, _ = Conventions(up).box(point)
    (seen,), _ = to_viewer_frame([body], Viewpoint(0.0, 0.0, yaw))
    frame = "camera_optical_frame" if up == "-y" else "map"
    axes = viewer_axes(frame, yaw, "y" if up == "y" else None)
    told = [sum(seen[k] * axes[k][n] for k in range(3)) for n in range(3)]
    assert told == pytest.approx(point, abs=1e-9)


@pytest.mark.parametrize("frame", ["map", "base_link", None])
def test_a_viewer_without_a_direction_looks_along_the_first_axis(frame):
    assert viewer_axes(frame) == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert viewer_axes(frame, up="y") == ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


# A frame with y up: x right, y up, z towards the viewer.
TO_Y_UP = Rotation.from_matrix([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
boxes = st.tuples(*[st.floats(-5, 5)] * 3), st.tuples(*[st.floats(0.1, 3)] * 3), st.floats(-3, 3)


@given(
    *boxes,
    st.sampled_from(["z", "y"]),
    st.sampled_from(sorted(METRES)),
    st.sampled_from(["full", "half"]),
    st.sampled_from(["centre", "bottom", "corner"]),
    st.sampled_from(["xyzw", "wxyz", "yaw"]),
)
def test_every_convention_describes_the_same_box(
    centre, size, yaw, up, units, extents, origin, order
):
    """A box in body axes, told under other conventions and read again."""
    turn = Rotation.from_euler("Z", yaw)
    shares = {"centre": (0, 0, 0), "bottom": (0, 0, -0.5), "corner": (-0.5, -0.5, -0.5)}[origin]
    sides = np.array(size)
    if up == "y":
        sides, turn = sides[[1, 2, 0]], TO_Y_UP * turn * TO_Y_UP.inv()
        # The smallest z of a box is ahead.
        shares = (shares[0] * -1, shares[1] * -1, shares[2])
    told = np.array(centre) + Rotation.from_euler("Z", yaw).apply(np.array(shares) * size)
    told = TO_Y_UP.apply(told) if up == "y" else told
    metres = METRES[units]
    q = np.roll(turn.as_quat(), order == "wxyz").tolist()
    read = Conventions(up, units, extents, origin, "xyzw" if order == "yaw" else order).box(
        tuple((told / metres).tolist()),
        tuple((sides / metres / (2 if extents == "half" else 1)).tolist()),
        *((None, yaw) if order == "yaw" else (tuple(q), None)),
    )
    assert read[0] == pytest.approx(centre, abs=1e-9)
    assert read[1] == pytest.approx(size)
    assert same_turn(read[2], yaw)


@pytest.mark.parametrize("units", sorted(METRES))
def test_standard_deviations_have_the_units_of_positions_and_sizes(units):
    """Half extents have half the error of full extents."""
    metres = METRES[units]
    assert Conventions(units=units).errors(0.5, 0.25) == (0.5 * metres, 0.25 * metres)
    assert Conventions(units=units, extents="half").errors(0.5, 0.25)[1] == 0.5 * metres
    assert Conventions(units=units).errors(None, 0.0) == (None, 0.0)
    assert Conventions(units=units).errors(0.0, None) == (0.0, None)


@pytest.mark.parametrize("up", ["z", "y"])
def test_a_typical_size_leads_from_the_bottom_to_the_centre(up):
    place, size, _ = Conventions(up, "cm", box_origin="bottom").box(
        (0.0, 0.0, 0.0), typical=(2.0, 1.0, 0.6)
    )
    assert place == (0.0, 0.0, 0.3)
    assert size is None
    # Without any size, the origin counts as the centre.
    assert Conventions(up, box_origin="corner").box((0.0, 0.0, 0.0))[0] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("frame", "optical", "body"),
    [
        (None, "camera_optical", "camera"),
        ("map", "map_optical", "map"),
        ("cam_optical_frame", "cam_optical", "cam"),
        ("cam_optical", "cam_optical", "cam"),
    ],
)
def test_names_of_frames_with_and_without_optical_axes(frame, optical, body):
    assert optical_name(frame, optical=True) == optical
    assert optical_name(frame, optical=False) == body
    assert is_optical(optical)
    assert not is_optical(body)
