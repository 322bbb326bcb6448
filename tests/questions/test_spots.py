"""Free spots of missing objects, in random rooms and at boxes with known spots."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from app.model import Offsets
from app.model.statistics import UNOBSERVED
from app.questions import spots
from app.questions.posterior import present
from app.questions.spots import move_to_free_spots
from app.scene import ObjectClass, Scene, SceneObject, Vocabulary
from app.scene.footprints import overlap_and_gap
from app.scene.scene import boxes_of, derive_relations, observe
from app.scene.spatial_relations import CANONICAL, INSIDE, LATERAL, ON_TOP, RELATIONS, canonicalise
from app.scene.stands import FLOOR, HANGS
from tests.questions.artifacts import LABELS, STRUCTURE, larger_artifact

BED, LAMP, DESK, CHAIR, SOFA, VASE, SHELF, RUG, WALL = range(9)
SIZES = {
    "bed": (2.0, 1.6, 0.9), "lamp": (0.25, 0.25, 0.4), "desk": (0.7, 1.4, 0.75),
    "chair": (0.5, 0.5, 0.9), "sofa": (0.9, 2.0, 0.8), "vase": (0.2, 0.2, 0.3),
    "shelf": (0.8, 0.3, 0.4), "rug": (2.0, 1.5, 0.01),
}  # fmt: skip
VOCABULARY = Vocabulary(
    [ObjectClass(name, structure=name in STRUCTURE, size=SIZES.get(name)) for name in LABELS],
    ("bedroom", "office"),
)
MODEL = replace(larger_artifact("triway"), vocabulary=VOCABULARY)
STANDS = MODEL.places.stands.argmax(1)
SMALL_RUG = [
    replace(entry, size=(0.1, 0.05, 0.01)) if entry.label == "rug" else entry
    for entry in VOCABULARY.objects
]
FLAT_RUG = replace(MODEL, vocabulary=Vocabulary(SMALL_RUG, ("bedroom", "office")))


def box(name, x, y, bottom=0.0, size=None, yaw=0.0):
    index, (length, width, height) = LABELS.index(name), size or SIZES[name]
    centre = (x, y, bottom + height / 2)
    return index, centre, (length, width, height), yaw


def scene_of(*boxes):
    objects = (
        SceneObject(str(k), LABELS[index], index, position=centre, size=size, yaw=yaw)
        for k, (index, centre, size, yaw) in enumerate(boxes)
    )
    return observe(Scene(tuple(objects)), typical_sizes=VOCABULARY.sizes)


def spot_of(scene, name, missing, anchor, mean=(0.0, 0.0, 0.0), std=0.3, model=MODEL):
    """Return the offset of a missing class at a place, and its standard deviation, or None."""
    relation, subject, _ = canonicalise("missing", name, "anchor")
    means, stds, scenes = np.array([mean], float), np.full((1, 3), std), np.array([9])
    columns = (np.array([value]) for value in (relation, missing, subject == "missing", anchor))
    move_to_free_spots(
        model,
        scene,
        present(scene, model.spec),
        boxes_of(scene.objects, model.vocabulary.sizes),
        *columns,
        means,
        stds,
        scenes,
    )
    return None if scenes[0] == UNOBSERVED else (means[0], stds[0])


lengths, angles = st.floats(0.3, 2.0), st.sampled_from([0.0, math.pi / 2]) | st.floats(-3, 3)
places = st.floats(-2.5, 2.5)
furniture = st.builds(
    box,
    st.sampled_from(["bed", "desk", "chair", "sofa"]),
    places,
    places,
    size=st.tuples(lengths, lengths, st.floats(0.3, 1.2)),
    yaw=angles,
)
small = st.tuples(
    st.sampled_from(["lamp", "vase", "shelf"]),
    st.integers(0, 9),
    *(2 * [st.floats(-0.4, 0.4)]),
    st.tuples(*(3 * [st.floats(0.08, 0.3)])),
    angles,
)


@st.composite
def rooms(draw):
    """Furniture on the floor, and objects on the furniture. The boxes may overlap."""
    boxes = draw(st.lists(furniture, min_size=1, max_size=5))
    for name, number, u, v, size, yaw in draw(st.lists(small, max_size=5)):
        _, (x, y, z), (length, width, height), turn = boxes[number % len(boxes)]
        cos, sin = math.cos(turn), math.sin(turn)
        dx, dy = cos * u * length - sin * v * width, sin * u * length + cos * v * width
        boxes.append(box(name, x + dx, y + dy, z + height / 2, size, yaw))
    return scene_of(*boxes)


def heights_of(scene, name, missing, anchor, z):
    """Bottom and top of a missing object. A support reaches from the floor to its load."""
    height, own = VOCABULARY.sizes[missing, 2], scene.objects[anchor]
    low = own.position[2] - own.size[2] / 2
    if name == "under" and STANDS[own.class_index] != FLOOR:
        return 2 * z - low, low
    return z - height / 2, z + height / 2


def points_in(centre, size, yaw, bottom, top):
    """Points in a box, 3 mm from its faces."""
    x, y, z = np.meshgrid(*(3 * [np.linspace(-1, 1, 7)]), indexing="ij")
    cos, sin = math.cos(yaw), math.sin(yaw)
    u, v = (size[0] / 2 - 0.003) * x.ravel(), (size[1] / 2 - 0.003) * y.ravel()
    w = (bottom + top) / 2 + ((top - bottom) / 2 - 0.003) * z.ravel()
    return np.stack([centre[0] + cos * u - sin * v, centre[1] + sin * u + cos * v, w], 1)


def contains_any(thing, points, margin):
    delta = points - thing.position
    cos, sin = math.cos(thing.yaw), math.sin(thing.yaw)
    x, y = cos * delta[:, 0] + sin * delta[:, 1], cos * delta[:, 1] - sin * delta[:, 0]
    within = [abs(x) < thing.size[0] / 2, abs(y) < thing.size[1] / 2]
    return bool((within[0] & within[1] & (abs(delta[:, 2]) < thing.size[2] / 2 - margin)).any())


@settings(max_examples=400, deadline=None)
@given(
    rooms(),
    st.sampled_from(RELATIONS),
    st.sampled_from([BED, LAMP, DESK, CHAIR, SOFA, VASE, SHELF]),
    st.integers(0, 9),
    st.tuples(places, places, st.floats(-1.5, 1.5)),
)
def test_a_spot_is_neither_in_a_box_nor_in_the_air_nor_occupied(scene, name, missing, number, mean):
    anchor = number % len(scene.objects)
    own, size = scene.objects[anchor], VOCABULARY.sizes[missing]
    spot = spot_of(scene, name, missing, anchor, mean)
    if spot is None:
        return
    centre = spot[0] + own.position
    bottom, top = heights_of(scene, name, missing, anchor, centre[2])
    assert bottom >= -0.03
    points, holder = points_in(centre, size, own.yaw, bottom, top), None
    for a, i, j in scene.triples:
        if i == anchor and a in (ON_TOP, INSIDE):
            holder = j
    if holder is not None:
        thing = scene.objects[holder]
        top_of_holder = thing.position[2] + thing.size[2] / 2
        # Beds in each other: the lamp on the lower one is on a board within the higher one.
        assume(abs(top_of_holder - own.position[2] + own.size[2] / 2) < 1e-6)
    for k, thing in enumerate(scene.objects):
        low, high = (thing.position[2] + side * thing.size[2] / 2 for side in (-1, 1))
        is_held = bottom - 0.03 < low and high < top + 0.03
        may_overlap = {
            "inside": k in (anchor, holder),
            "under": k == anchor,
            "contains": k == anchor or is_held,
            "on-top": k == holder,
        }
        if not may_overlap.get(name):
            assert not contains_any(thing, points, 0.021), (k, thing)
    # The object has a support: the floor, a box below it, or the box around it.
    tops = [
        thing.position[2] + thing.size[2] / 2
        for thing in scene.objects
        if contains_any(replace_height(thing), centre[None], 0.0)
    ]
    hangs = STANDS[missing] == HANGS or (name == "under" and STANDS[own.class_index] != FLOOR)
    within = name == "inside" and bottom >= own.position[2] - own.size[2] / 2 - 1e-9
    is_supported = min(abs(bottom - height) for height in [0.0, *tops]) < 1e-6
    assert is_supported or within or hangs or name == "contains"


def replace_height(thing):
    return replace(thing, size=(*thing.size[:2], 99.0))


@settings(max_examples=200, deadline=None)
@given(rooms(), st.sampled_from(RELATIONS), st.sampled_from([LAMP, CHAIR, VASE]), st.integers(0, 9))
def test_the_relation_holds_at_the_spot(scene, name, missing, number):
    """Also rules of poses see the relation. They leave roles of boxes in each other undecided."""
    anchor = number % len(scene.objects)
    own, size = scene.objects[anchor], VOCABULARY.sizes[missing]
    relation, subject, _ = canonicalise("missing", name, "anchor")
    spot = spot_of(scene, name, missing, anchor)
    if spot is None or relation == INSIDE or name == "under":
        return
    poses = derive_relations(
        [spot[0] + own.position, own.position], [size, own.size], [own.yaw, own.yaw]
    )
    i, j = (0, 1) if subject == "missing" else (1, 0)
    assert poses.holds[relation, i, j], (CANONICAL[relation], spot)
    if relation in LATERAL:
        columns = [[spot[0][:2]], [size[:2]], [own.yaw], [[0, 0]], [own.size[:2]], [own.yaw]]
        assert overlap_and_gap(*map(np.array, columns))[0] == 0.0


@given(st.data())
def test_footprints_overlap_if_their_projections_do(data):
    """The table of obstacles, compared with the distance of the boxes."""
    boxes = [data.draw(furniture) for _ in range(2)]
    scene = scene_of(*boxes)
    (_, p, own, yaw), (_, q, other, turn) = boxes
    columns = [[p[:2]], [own[:2]], [yaw], [q[:2]], [other[:2]], [turn]]
    gap = overlap_and_gap(*map(np.array, columns))[1][0]
    table = spots._table(
        *boxes_of(scene.objects, None),
        np.array([yaw, turn]),
        np.full(2, math.inf),
        MODEL.places.stands[[BED, BED]],
        np.array([-1, -1]),
    )
    obstacles = np.empty((2, 8))
    count = spots._find_obstacles(table, 0, spots._BESIDE, own, 0.0, 2.0, -1, obstacles)
    is_free = spots._is_free(obstacles[1:count], p[:2], (math.cos(yaw), math.sin(yaw)))
    assert count == 2
    if gap < 0.01 - 1e-6 or gap > 0.03:  # the minimum gap is 0.01 along one of the sides
        assert is_free == (gap > 0.01)


def test_heights_come_from_the_faces_of_the_anchor():
    """A desk with a top face at 0.6 m, whatever the statistics say."""
    scene = scene_of(box("desk", 1, 0, size=(0.7, 1.4, 0.6)))
    for learned in (-0.2, 0.4, 1.5):
        vase, spread = spot_of(scene, "on-top", VASE, 0, (0.1, 0.2, learned))
        assert vase.tolist() == pytest.approx([0.1, 0.2, 0.3 + 0.15])
        # The centre can be 0.25 m and 0.6 m from the middle.
        assert spread.tolist() == pytest.approx([0.25 / math.sqrt(3), 0.3, 0.3])
        inside, _ = spot_of(scene, "inside", VASE, 0, (0, 0, learned))
        assert inside[2] == pytest.approx(min(max(learned, -0.15), 0.15))
    far, _ = spot_of(scene, "on-top", VASE, 0, (3.0, -3.0, 0.0))
    assert far[:2].tolist() == pytest.approx([0.25, -0.6])
    under, _ = spot_of(scene, "under", LAMP, 0)
    assert under[2] == pytest.approx(0.2 - 0.3)


def test_a_support_reaches_from_the_floor_to_its_load():
    scene = scene_of(box("bed", 5, 5), box("vase", 1, 0, 0.8))
    under, _ = spot_of(scene, "under", DESK, 1)
    assert under[2] == pytest.approx(0.4 - 0.95)
    assert spot_of(scene_of(box("bed", 5, 5), box("vase", 1, 0, 1.9)), "under", DESK, 1) is None


def test_an_occupied_mean_moves_to_the_nearest_free_spot_or_has_none():
    desk, vase = box("desk", 1, 0), box("vase", 1, 0.1, 0.75)
    free, _ = spot_of(scene_of(desk, vase), "on-top", VASE, 0)
    assert 0.1 <= math.hypot(free[0], free[1] - 0.1) <= 0.4
    assert free[2] == pytest.approx(0.75 / 2 + 0.15)
    full = box("lamp", 1, 0, 0.75, size=(0.7, 1.4, 0.3))
    assert spot_of(scene_of(desk, full), "on-top", VASE, 0) is None


def test_objects_beside_each_other_stand_on_the_same_support():
    desk, lamp = box("desk", 1, 0), box("lamp", 1, -0.5, 0.75)
    left, _ = spot_of(scene_of(desk, lamp), "left", VASE, 1, (0.0, 0.9, 0.3))
    assert left.tolist() == pytest.approx([0.0, 0.9, 0.15 - 0.2])
    # To the right, the desk ends.
    assert spot_of(scene_of(desk, lamp), "right", VASE, 1, (0.0, -0.9, 0.3)) is None
    chair, _ = spot_of(scene_of(desk, lamp), "front", CHAIR, 1, (-0.8, 0.0, 0.3))
    assert chair[2] == pytest.approx(0.45 - 0.95)  # on the floor
    assert 1 + chair[0] + 0.25 <= 1 - 0.35 + 1e-9  # not in the desk


def test_an_object_that_never_stands_on_the_floor_needs_a_surface():
    """Left of the chair, the vase stands on the desk, if there is one."""
    chair, desk = box("chair", 1, 0), box("desk", 1, 1.2)
    assert spot_of(scene_of(chair), "left", VASE, 0, (0.0, 1.0, 0.3)) is None
    on_rug = scene_of(chair, box("rug", 1, 0, size=(4.0, 4.0, 0.01)))
    assert spot_of(on_rug, "left", VASE, 0, (0.0, 1.0, 0.3)) is None
    vase, _ = spot_of(scene_of(chair, desk), "left", VASE, 0, (0.0, 1.0, 0.4))
    assert vase[2] == pytest.approx(0.75 + 0.15 - 0.45)
    assert vase[1] >= 0.5 + 0.1


def test_objects_stand_on_rugs_and_rugs_lie_under_furniture():
    scene = scene_of(box("rug", 1, 0), box("chair", 1, 0))
    beside, _ = spot_of(scene, "left", CHAIR, 1, (0.0, 0.6, 0.0))
    assert beside.tolist() == pytest.approx([0.0, 0.6, 0.0])
    rug, _ = spot_of(scene_of(box("desk", 1, 0), box("chair", 0.4, 0)), "under", RUG, 0)
    assert rug[2] == pytest.approx(0.005 - 0.375)


def test_hanging_objects_keep_the_height_of_the_statistics():
    stands = MODEL.places.stands.copy()
    stands[VASE] = 0.0, 1.0, 0.0
    model = replace(MODEL, places=replace(MODEL.places, stands=stands))
    scene = scene_of(box("sofa", 2, 0))
    above, _ = spot_of(scene, "above", VASE, 0, (0.0, 0.1, 1.4), model=model)
    assert above.tolist() == pytest.approx([0.0, 0.1, 1.4])
    low, _ = spot_of(scene, "above", VASE, 0, (0.0, 0.1, 0.2), model=model)
    assert low[2] - 0.15 > 0.4 + 0.05
    assert spot_of(scene, "above", LAMP, 0, (0.0, 0.1, 1.4)) is None


def test_objects_below_have_space():
    """The bottom of the lamp is 1 m or 0.8 m above the floor, and the desk is 0.75 m high."""
    lamps = {gap: scene_of(box("lamp", 1, 0, gap), box("bed", 4, 4)) for gap in (1.0, 0.8)}
    below, _ = spot_of(lamps[1.0], "below", DESK, 0)
    assert below[2] == pytest.approx(0.375 - 1.2)
    assert spot_of(lamps[0.8], "below", DESK, 0) is None
    table = scene_of(box("lamp", 1, 0, 1.5), box("desk", 1, 0), box("bed", 4, 4))
    vase, _ = spot_of(table, "below", VASE, 0)
    assert vase[2] == pytest.approx(0.75 + 0.15 - 1.7)


def test_boxes_without_a_stated_size_keep_the_statistics():
    thing = SceneObject("0", "desk", DESK, position=(1.0, 0.0, 0.4))
    mean, spread = spot_of(Scene((thing,)), "on-top", VASE, 0, (0.4, 0.5, 0.6))
    assert mean.tolist() == [0.4, 0.5, 0.6]
    assert spread.tolist() == [0.3, 0.3, 0.3]


def seat_model(offset, spread, scenes):
    """A model whose training scenes show vases and lamps on sofas."""
    V, nothing = len(LABELS), np.zeros((5, len(LABELS), 6), np.float32)
    keys = sorted((ON_TOP * V + thing) * V + SOFA for thing in (LAMP, VASE))
    offsets = Offsets(
        relation=np.tile(np.float32([0, 0, 0, 1, 1, 1]), (5, 1)),
        relation_scenes=np.full(5, 9),
        subject=nothing,
        object=nothing,
        pair=np.array(keys),
        pair_offset=np.float32([[0, 0, z, 0.1, 0.1, spread] for z in (offset + 0.05, offset)]),
        pair_scenes=np.array([scenes, scenes]),
    )
    return replace(MODEL, offsets=offsets)


def test_things_lie_on_the_seat_below_a_back():
    """The seat is 0.45 m above the floor: 0.2 m above the centre, less half a vase of 0.3 m.

    In a higher box, such as that of a bunk bed, it is at .45 of the height.
    """
    model = seat_model(0.2, 0.05, 50)
    assert model.seats[SOFA] == pytest.approx(0.45)
    assert np.isinf(np.delete(model.seats, SOFA)).all()
    for height, bottom in ((0.8, 0.45), (1.1, 0.495), (0.5, 0.5), (0.4, 0.4)):
        scene = scene_of(box("sofa", 2, 0, size=(0.9, 2.0, height)))
        spot, _ = spot_of(scene, "on-top", VASE, 0, model=model)
        assert spot[2] + height / 2 - 0.15 == pytest.approx(bottom)
    for other in (seat_model(0.2, 0.5, 50), seat_model(0.2, 0.05, 5), seat_model(0.5, 0.05, 50)):
        assert np.isinf(other.seats).all()


@pytest.mark.parametrize(("bottom", "height"), [(0.0, 0.01), (0.03, 0.03), (0.045, 0.01)])
def test_a_rug_above_the_floor_takes_no_spot(bottom, height):
    rug = box("rug", 2, 0, bottom, (8.0, 8.0, height))
    assert spot_of(scene_of(box("sofa", 2, 0), rug), "left", CHAIR, 0) is not None


def test_a_thing_just_above_a_surface_takes_its_spot():
    """A simulator puts a vase 4 cm above the desk, so a flat thing would fit below it."""
    desk, vase = box("desk", 2, 0), box("vase", 2, 0, 0.79, (0.3, 0.3, 0.3))
    spot, _ = spot_of(scene_of(desk, vase), "on-top", RUG, 0, (0.0, 0.0, 0.4), model=FLAT_RUG)
    assert max(abs(spot[0]), abs(spot[1])) > 0.15


def test_a_kind_has_the_seat_of_its_broader_class():
    kinds = [replace(entry) for entry in VOCABULARY.objects]
    kinds[BED] = replace(kinds[BED], parent="sofa")
    kinds[CHAIR] = replace(kinds[CHAIR], parent="bed")
    model = replace(seat_model(0.2, 0.05, 50), vocabulary=Vocabulary(kinds, ("bedroom", "office")))
    assert model.seats[[BED, CHAIR, SOFA]] == pytest.approx(0.45)
