"""The entries of `misplaced`: their kinds, their terms, and the object that has moved."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.model import Possibility
from app.model.calibration import WEIGHTS, Judgement
from app.model.possibility import CONTAINER
from app.questions.misplaced import (
    BELOW,
    BESIDE,
    EXPLAINED,
    HELD,
    LEAST_LISTED,
    LEAST_Z,
    OVER_IT,
    POSED,
    SUPPORT,
    THE_FLOOR,
    UNHELD,
    entries_of,
    misplaced_fields,
    wrong_log_odds,
    wrong_relations,
)
from app.questions.posterior import present
from app.questions.standing import Standing, shares_in_scene, standing
from app.scene import ObjectClass, RelationTable, Scene, SceneObject, Vocabulary, observe
from app.scene.scene import errors_of
from app.scene.spatial_relations import ABOVE, INSIDE, LEFT, ON_TOP
from tests.questions.answers import misplaced
from tests.questions.artifacts import judging, larger_artifact, lines, places_of, scene_of

# Sizes, and the shares of the floor, of the wall and of supports.
THINGS = {
    "desk": ((1.6, 0.8, 0.75), (0.95, 0.01, 0.04)),
    "monitor": ((0.6, 0.2, 0.4), (0.05, 0.15, 0.8)),
    "bin": ((0.3, 0.3, 0.4), (0.9, 0.02, 0.08)),
    "stove": ((0.6, 0.6, 0.9), (0.96, 0.01, 0.03)),
    "pot": ((0.25, 0.25, 0.2), (0.02, 0.08, 0.9)),
    "sofa": ((2.0, 0.9, 0.8), (0.97, 0.01, 0.02)),
    "rug": ((2.0, 1.4, 0.01), (0.9, 0.04, 0.06)),
    "shelf": ((1.0, 0.4, 2.0), (0.6, 0.35, 0.05)),
    "wall": ((4.0, 0.1, 2.5), (1.0, 0.0, 0.0)),
}
NAMES, (SIZES, STANDS) = tuple(THINGS), zip(*THINGS.values(), strict=True)
DESK, MONITOR, BIN, STOVE, POT, SOFA, RUG, SHELF, WALL = range(len(THINGS))
V = len(THINGS)
# A bin is under a desk, a monitor is on it, and a pot on a stove.
SHOWN = {(ON_TOP, MONITOR, DESK): 9, (ON_TOP, POT, STOVE): 40}
PLACES = places_of(
    V,
    SHOWN,
    stands=np.array(STANDS, np.float32),
    role_pair=np.array([MONITOR * V + DESK, BIN * V + DESK], np.int32),
    role_counts=np.array([(9, 0, 0), (0, 5, 0)], np.float32),
    role_anchor=np.array([(9, 5, 0), *[(0, 0, 0)] * (V - 1)], np.float32),
)
VOCABULARY = Vocabulary(
    [ObjectClass(name, structure=name == "wall", size=size) for name, (size, _) in THINGS.items()],
    ("office", "kitchen"),
)
# Only what stands on surfaces has the share 1 of a surface, and only the desk and the stove are
# surfaces. The weights are those of the share and of the surface.
POSSIBILITY = Possibility(
    stands=np.array([[f, w, 0, s, 0] for f, w, s in STANDS], np.float32),
    traits=np.array([(k in (DESK, STOVE), 0, 0) for k in range(V)], np.float32),
    spread=np.full(V, 0.25, np.float32),
    weights=np.array([(1, 2, 0, 0), (0.5, 1, 0, 0), (1, 0, 0, 0), (1, 3, 0, 0)], np.float32),
)
ARTIFACT = replace(larger_artifact("triway"), vocabulary=VOCABULARY, places=PLACES)
WITH_PRIOR = replace(ARTIFACT, possibility=POSSIBILITY)
FLAT = -7.0  # log-odds of the relations that a test does not name


def posterior_of(scene, alone=(), change=()):
    """A stub with these log-odds and changes of triples. Each object has a class of its own."""
    listing = present(scene, ARTIFACT.spec)
    n = len(listing.classes)
    log_odds, changes = np.full((5, n, n), FLAT), np.zeros((5, n, n))
    for array, values in ((log_odds, dict(alone)), (changes, dict(change))):
        for (a, i, j), value in values.items():
            array[a, listing.row[i], listing.row[j]] = value
    return SimpleNamespace(
        present=listing, alone_log_odds=lambda: log_odds, relation_change=lambda: changes
    )


def stated(classes, triples, by_opposite=()):
    objects = tuple(SceneObject(NAMES[c], NAMES[c], c) for c in classes)
    flags = [triple in by_opposite for triple in triples]
    return Scene(objects, RelationTable.stated(triples, flags))


def posed(*bottoms, artifact=ARTIFACT):
    """A scene of pairs of a class and the centre of its bottom, with relations from the poses."""
    objects = tuple(
        SceneObject(NAMES[c], NAMES[c], c, position=(x, y, z + SIZES[c][2] / 2), size=SIZES[c])
        for c, (x, y, z) in bottoms
    )
    roles = None if artifact.places is None else artifact.places.roles
    return observe(Scene(objects), typical_sizes=VOCABULARY.sizes, roles=roles)


def entries(scene, alone=(), change=(), artifact=ARTIFACT):
    """Entries as a dictionary from triples to kind, terms z, d, s, q, u, and mover."""
    table = entries_of(artifact, posterior_of(scene, alone, change), scene)
    assert (table.terms[:, 5] == np.log(max(len(table.kind), 1))).all()
    rows = zip(*(column.tolist() for column in table), strict=True)
    return {tuple(triple): (kind, terms[:5], mover) for triple, kind, terms, mover in rows}


def close(*terms):
    return pytest.approx(terms, rel=1e-5)


# ------------------------------------------------------------------------------ stated relations


def test_the_terms_of_a_hand_computed_example():
    on, under, left = (ON_TOP, 1, 0), (ON_TOP, 0, 2), (LEFT, 2, 1)
    scene = stated([DESK, MONITOR, BIN], [on, under, left], {under})
    alone = {on: 1.0, under: -2.0, (ABOVE, 0, 2): -0.5, left: 0.25, (ON_TOP, 1, 2): -1.0}
    table = entries(scene, alone, {on: 0.5, under: -0.125, left: -1.5})
    # Nine scenes show the monitor on a desk. The counts of all supporters are smoothed by .5.
    q = math.log((9 + 10 * 9.5 / (49 + 0.5 * V)) / (9 + 10))
    assert table == {
        on: (SUPPORT, close(1.0, 0.5, math.log(0.8), q, 0.0), 1),
        # Five scenes show the bin under a desk, and none on it.
        under: (BELOW, close(math.log(25 / 0.5), -0.125, 0.0, 0.0, 0.0), 2),
        left: (BESIDE, [0.25, -1.5, 0.0, 0.0, 0.0], 2),
    }


def test_the_prior_weighs_relations_that_few_scenes_show():
    """Nine scenes show the monitor on a desk, and none shows a pot on a sofa, which is no surface.

    The log-odds contain a quarter of the prior.
    """
    on, strange = (ON_TOP, 1, 0), (ON_TOP, 2, 3)
    scene = stated([DESK, MONITOR, POT, SOFA], [on, strange])
    table = entries(scene, {on: 1.0, strange: -3.0}, artifact=WITH_PRIOR)
    k = 9 / 11
    c = math.log(0.8)
    assert table[on][1][0] == pytest.approx(k * 1.0)
    assert table[on][1][4] == pytest.approx((1 - k) * (1.0 + 0.75 * c), rel=1e-5)
    c = math.log(0.9) - 2.0
    assert table[strange][1][0] == 0.0
    assert table[strange][1][4] == pytest.approx(-3.0 + 0.75 * c, rel=1e-5)


@pytest.mark.parametrize(
    ("triple", "is_opposite", "c"),
    [
        ((ON_TOP, 1, 0), False, math.log(0.08)),  # a bin on the desk
        # The bin under the desk, which is a surface; and the desk under the bin, which is none.
        ((ON_TOP, 0, 1), True, 0.5 * math.log(0.9)),
        ((ON_TOP, 1, 0), True, 0.5 * math.log(0.95) - 1.0),
        ((ABOVE, 1, 0), False, math.log(0.02)),
        ((INSIDE, 1, 0), False, math.log(0.01) - 3.0),
    ],
)
def test_the_prior_of_each_place(triple, is_opposite, c):
    scene = stated([DESK, BIN], [triple], {triple} if is_opposite else ())
    places = replace(PLACES, role_pair=PLACES.role_pair[:1], role_counts=PLACES.role_counts[:1])
    artifact = replace(WITH_PRIOR, places=places)
    ((_, terms, _),) = entries(scene, {triple: -2.0}, artifact=artifact).values()
    assert terms[0] == 0.0
    assert terms[4] == pytest.approx(-2.0 + 0.75 * c, rel=1e-4)


def test_words_that_mean_under_tell_little_about_on_top():
    """Five scenes say that the bin is under the desk, so few mean "the desk is on the bin"."""
    on = (ON_TOP, 0, 1)
    ((_, terms, mover),) = entries(stated([DESK, BIN], [on]), {on: 1.5}).values()
    assert terms[0] == pytest.approx(1.5 + math.log(0.5 / 5.5))
    assert mover == 0


@pytest.mark.parametrize(
    ("triple", "is_opposite", "kind", "mover"),
    [
        ((LEFT, 0, 1), False, BESIDE, 0),
        ((LEFT, 0, 1), True, BESIDE, 1),  # "the bin is to the right of the desk"
        ((ON_TOP, 1, 0), False, SUPPORT, 1),
        ((ON_TOP, 0, 1), True, BELOW, 1),  # "the bin is under the desk"
        ((ON_TOP, 0, 1), False, SUPPORT, 0),  # "the desk is on top of the bin"
        ((INSIDE, 1, 0), False, SUPPORT, 1),
        ((INSIDE, 1, 0), True, SUPPORT, 1),  # "the desk contains the bin"
        ((ABOVE, 0, 1), False, OVER_IT, 0),
        ((ABOVE, 0, 1), True, OVER_IT, 1),
    ],
)
def test_kind_and_mover_of_a_stated_relation(triple, is_opposite, kind, mover):
    table = entries(stated([DESK, BIN], [triple], {triple} if is_opposite else ()))
    assert {key: (k, m) for key, (k, _, m) in table.items()} == {triple: (kind, mover)}


@pytest.mark.parametrize(("a", "is_judged"), [(LEFT, True), (ON_TOP, False), (ABOVE, False)])
def test_stacks_of_one_class_are_not_judged(a, is_judged):
    objects = tuple(SceneObject(f"pot {k}", "pot", POT) for k in range(2))
    scene = Scene(objects, RelationTable.stated([(a, 0, 1)]))
    assert len(entries(scene)) == is_judged


def test_stacks_of_one_class_are_not_judged_by_their_boxes_either():
    """A bin on a bin. The lower bin and the desk stand on the floor."""
    things = posed((BIN, (0, 0, 0)), (BIN, (0, 0, 0.4)), (DESK, (9, 0, 0))).objects
    things = tuple(replace(thing, id=str(k)) for k, thing in enumerate(things))
    assert {i for _, i, _ in entries(observe(Scene(things)))} == {0, 2}
    pot = replace(things[1], label="pot", class_index=POT)
    assert {i for _, i, _ in entries(observe(Scene((things[0], pot, things[2]))))} == {0, 1, 2}


def test_the_stand_of_classes_that_belong_everywhere_is_not_judged():
    """A bag under the desk, or on the floor, is normal. On the monitor, z decides alone."""
    objects = [replace(thing, anywhere=thing.label == "bin") for thing in VOCABULARY.objects]
    artifact = replace(ARTIFACT, vocabulary=Vocabulary(objects, VOCABULARY.room_types))
    under, on = (ON_TOP, 0, 1), (ON_TOP, 1, 2)
    scene = stated([DESK, BIN, MONITOR], [under, on], {under})
    table = entries(scene, {on: -2.0}, artifact=artifact)
    assert table == {on: (SUPPORT, [-2.0, 0.0, 0.0, 0.0, 0.0], 1)}
    alone = entries(posed((BIN, (0, 0, 0)), (DESK, (4, 0, 0))), artifact=artifact)
    assert [mover for _, _, mover in alone.values()] == [1]
    held = posed((BIN, (0, 0, 0.75)), (DESK, (0, 0, 0)))
    _, terms, _ = entries(held, {(ON_TOP, 0, 1): -2.0}, artifact=artifact)[ON_TOP, 0, 1]
    # Words say that the bin is under the desk, and none that it is on it.
    assert terms == pytest.approx([-2.0 * evidence(held).held[0], 0.0, 0.0, 0.0, 0.0])


def test_a_supported_object_above_another_is_not_misplaced():
    over = (ABOVE, 1, 2)
    alone = entries(stated([DESK, MONITOR, RUG], [over]), {over: -11.0})
    assert alone[over] == (OVER_IT, [LEAST_Z, 0.0, 0.0, 0.0, 0.0], 1)
    held = entries(stated([DESK, MONITOR, RUG], [(ON_TOP, 1, 0), over]))
    assert held[over] == (OVER_IT, [EXPLAINED, 0.0, 0.0, 0.0, 0.0], 1)


def confirming(artifact, *triples):
    confirmed = artifact.calibration.misplaced.model_copy(update={"confirmed": triples})
    calibration = artifact.calibration.model_copy(update={"misplaced": confirmed})
    return replace(artifact, calibration=calibration)


@pytest.mark.parametrize("is_posed", [False, True])
def test_a_confirmed_support_has_no_other_evidence(is_posed):
    artifact = confirming(WITH_PRIOR, (ON_TOP, POT, SOFA))
    scene = stated([POT, SOFA], [(ON_TOP, 0, 1)])
    if is_posed:
        scene = posed((POT, (0, 0, 0.8)), (SOFA, (0, 0, 0)))
    table = entries(scene, artifact=artifact)
    assert table[ON_TOP, 0, 1][1] == [EXPLAINED, 0.0, 0.0, 0.0, 0.0]
    assert entries(scene, artifact=WITH_PRIOR)[ON_TOP, 0, 1][1][4] < -6


# ------------------------------------------------------------------------------------------ boxes


def evidence(scene, floor=0.0, places=PLACES):
    """The evidence about each object of a scene with boxes, with the terms t and r."""
    classes = np.array([thing.class_index for thing in scene.objects])
    centres = np.array([thing.position for thing in scene.objects])
    sizes = np.array([thing.size for thing in scene.objects])
    of_any = places.any_supporters(classes)[None]
    supporters = np.concatenate([places.supporters(classes, classes), of_any])
    supporters[:, classes == WALL] = 0.0
    errors = errors_of(scene.objects, sizes, classes, None)
    boxes = centres, sizes, np.zeros(len(classes)), errors
    stands, within = np.array(STANDS)[classes], places.within[classes].astype(float)
    of_objects = stands, shares_in_scene(supporters), within, np.zeros(len(classes))
    return Standing(*standing(boxes, floor, *of_objects))


BESIDE_IT = (9.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("thing", "other", "triple", "kind", "reason"),
    [
        ((MONITOR, (4, 0, 0)), (DESK, (0, 0, 0)), (ON_TOP, 0, -1), POSED, "on-floor"),
        ((POT, (0, 0, 0.8)), (SOFA, (0, 0, 0)), (ON_TOP, 0, 1), HELD, "wrong-support"),
        ((POT, (0, 0, 0.9)), (STOVE, (0, 0, 0)), (ON_TOP, 0, 1), HELD, "wrong-support"),
        ((DESK, (0, 0, 0.7)), (STOVE, BESIDE_IT), (ABOVE, 0, -1), UNHELD, "floats"),
        ((DESK, (0, 0, -0.5)), (STOVE, BESIDE_IT), (INSIDE, 0, -1), UNHELD, "sunk-in"),
        ((STOVE, (0, 0, 0.2)), (SOFA, (0, 0, 0)), (INSIDE, 0, 1), UNHELD, "sunk-in"),
    ],
)
def test_each_box_has_one_entry_with_its_likeliest_wrong_place(thing, other, triple, kind, reason):
    # Three more pieces show where the floor is.
    scene = posed(thing, other, (RUG, (20, 0, 0)), (BIN, (24, 0, 0)), (SHELF, (28, 0, 0)))
    change = {triple: 0.75} if triple[2] >= 0 else {}
    table = entries(scene, {triple: -1.0} if change else {}, change)
    assert len(table) == len(scene.objects)
    assert {i for _, i, _ in table} == set(range(len(scene.objects)))
    found, (z, d, s, q, u), mover = table[triple]
    assert (found, mover) == (kind, 0)
    found = evidence(scene)
    assert s == pytest.approx(-found.log_ratio[0], abs=1e-6)
    if kind == HELD:
        classes, r = (np.array([thing[0]]), np.array([other[0]])), found.held[0]
        log_q = math.log(PLACES.supporters(*classes)[0, 0])
        assert (z, d, q, u) == pytest.approx((-r, 0.75 * r, log_q * r, 0.0), abs=1e-6)
        assert r > 0.8
    else:
        assert (z, d, q, u) == (0, 0, 0, 0)
    answer = {entry["moved"]: entry for entry in fields_of(scene, judgements=EVERY)}
    entry = answer[NAMES[thing[0]]]
    assert entry["reason"] == reason
    assert entry["object"] == (NAMES[other[0]] if triple[2] >= 0 else THE_FLOOR)


def test_a_thing_in_a_listed_container_is_inside_it():
    """The relation of an entry is inside, if the boxes show this. It has the unit of inside."""
    roles = {
        "role_pair": np.array([POT * V + SHELF], np.int32),
        "role_counts": np.array([(0, 0, 9)], np.float32),
        "within": np.full(V, 0.9, np.float32),
    }
    artifact = replace(ARTIFACT, places=replace(PLACES, **roles))
    scene = posed((SHELF, (0, 0, 0)), (POT, (0, 0, 0.9)), artifact=artifact)
    table = entries(scene, {(INSIDE, 1, 0): 0.5}, artifact=artifact)
    assert table[INSIDE, 1, 0][:1] == (HELD,)
    r = evidence(scene, places=artifact.places).held[1]
    assert table[INSIDE, 1, 0][1][0] == pytest.approx(0.5 * r)


def seen_part(scene, bottom, top):
    """The scene, in which a sensor saw only this part of the height of the first box."""
    thing = scene.objects[0]
    x, y, _ = thing.position
    part = replace(thing, position=(x, y, (bottom + top) / 2), size=(*thing.size[:2], top - bottom))
    return observe(Scene((part, *scene.objects[1:])))


OTHERS = [(RUG, (20, 0, 0)), (BIN, (24, 0, 0)), (STOVE, (28, 0, 0))]


@pytest.mark.parametrize("bottom", [0.2, 0.4, 0.7])
def test_furniture_whose_lower_part_is_hidden_reaches_the_floor(bottom):
    """The top of the desk is .75 m high. The same box as a pot floats, and so does a higher one."""
    desk = posed((DESK, (0, 0, 0)), *OTHERS)
    whole, part = entries(desk), entries(seen_part(desk, bottom, 0.75))
    found, expected = (table[ON_TOP, 0, -1] for table in (part, whole))
    assert found[0] == expected[0] == POSED
    assert found[1] == pytest.approx(expected[1], abs=0.02)  # the error of the height differs
    assert entries(seen_part(desk, bottom + 0.6, 1.35))[ABOVE, 0, -1][0] == UNHELD
    pot = posed((POT, (0, 0, 0)), *OTHERS)
    assert entries(seen_part(pot, 0.7, 0.75))[ABOVE, 0, -1][0] == UNHELD


def test_things_in_a_described_container_are_not_on_the_floor():
    """The table of descriptions tells which classes are containers."""
    traits = POSSIBILITY.traits.copy()
    traits[SHELF, CONTAINER] = 1.0
    container = replace(WITH_PRIOR, possibility=replace(POSSIBILITY, traits=traits))
    assert container.containers.nonzero()[0].tolist() == [SHELF]
    scene = posed((MONITOR, (0, 0, 0.02)), (SHELF, (0, 0, 0)), (STOVE, (9, 0, 0)))
    on_floor, inside = (
        entries(scene, artifact=artifact)[ON_TOP, 0, -1][1][2]
        for artifact in (WITH_PRIOR, container)
    )
    assert inside > on_floor + 0.5  # -t


def test_tops_show_the_floor_if_no_whole_box_does():
    """Two tops of desks at .75 m, and a pot between them and the floor."""
    things = posed((DESK, (0, 0, 0)), (DESK, (9, 0, 0)), (POT, (20, 0, 0.3))).objects
    tops = [
        replace(thing, position=(*thing.position[:2], 0.725), size=(1.6, 0.8, 0.05))
        for thing in things[:2]
    ]
    scene = observe(Scene((replace(tops[0], id="a"), replace(tops[1], id="b"), things[2])))
    kinds = {mover: kind for kind, _, mover in entries(scene).values()}
    assert kinds == {0: POSED, 1: POSED, 2: UNHELD}


def test_a_small_thing_of_a_large_kind_is_not_stretched():
    """A bin of 10 cm on the desk is on it, although bins are .4 m high."""
    scene = posed((BIN, (0, 0, 0.75)), (DESK, (0, 0, 0)), *OTHERS)
    assert entries(seen_part(scene, 0.75, 0.85))[ON_TOP, 0, 1][0] == HELD


def test_structure_is_neither_judged_nor_an_anchor():
    on_it = posed((POT, (0, 0, 2.5)), (STOVE, (9, 0, 0)), (WALL, (0, 0, 0)))
    without = posed((POT, (0, 0, 2.5)), (STOVE, (9, 0, 0)))
    assert entries(on_it) == entries(without)
    # A pot that reaches into the wall floats, because something else should hold it.
    in_it = posed((WALL, (0, 0, 0)), (POT, (0, 0, 1.2)), (STOVE, (9, 0, 0)))
    assert entries(in_it)[ABOVE, 1, -1][0] == UNHELD


def test_the_evidence_of_a_class_never_on_the_floor_is_finite():
    stands = PLACES.stands.copy()
    stands[MONITOR] = (0, 0, 1)
    artifact = replace(ARTIFACT, places=replace(PLACES, stands=stands))
    table = entries(posed((MONITOR, (0, 0, 0)), (DESK, (4, 0, 0))), artifact=artifact)
    assert -20 < table[ON_TOP, 0, -1][1][2] < -3


def test_without_places_stated_supports_have_no_stand_and_boxes_no_entry():
    artifact = replace(ARTIFACT, places=None)
    scene = stated([DESK, MONITOR], [(ON_TOP, 1, 0)])
    table = entries(scene, {(ON_TOP, 1, 0): 1.5}, artifact=artifact)
    assert table == {(ON_TOP, 1, 0): (SUPPORT, [1.5, 0.0, 0.0, 0.0, 0.0], 1)}
    posterior = posterior_of(scene)
    (entry,) = misplaced_fields(artifact, posterior, scene, "medium", np.ones(len(scene.objects)))
    assert (entry["subject"], entry["moved"]) == ("monitor", "monitor")
    boxes = posed((DESK, (0, 0, 0)), (MONITOR, (0, 0, 0.75)), artifact=artifact)
    assert not entries_of(artifact, posterior_of(boxes), boxes).kind.size


# ----------------------------------------------------------------------------------------- answer

JUDGED = judging(lines(3.0, 2.0, 1.0), stand=-1.0)
EVERY = judging(lines(-99.0, -99.0, -99.0), stand=-1.0)


def fields_of(scene, alone=(), sensitivity="medium", judgements=JUDGED):
    calibration = ARTIFACT.calibration.model_copy(update={"misplaced": judgements})
    artifact = replace(ARTIFACT, calibration=calibration)
    posterior = posterior_of(scene, alone)
    return misplaced_fields(artifact, posterior, scene, sensitivity, np.ones(len(scene.objects)))


def test_the_log_odds_are_a_weighted_sum_of_the_terms():
    weights = dict(zip(WEIGHTS, (-1.0, 2.0, -0.25, -0.5, -3.0, -0.125), strict=True))
    judgement = Judgement(intercept=0.5, lines=lines(0, 0, 0), **weights)
    terms = np.array([[1.0, 0.5, -4.0, -2.0, 0.25, 2.0], [0.0] * 6])
    assert wrong_log_odds(judgement, terms).tolist() == [0.5 - 1 + 1 + 1 + 1 - 0.75 - 0.25, 0.5]


def test_the_answer_has_the_probability_of_the_judgement():
    scene = posed((MONITOR, (4, 0, 0)), (DESK, (0, 0, 0)))
    (entry,) = (e for e in fields_of(scene, judgements=EVERY) if e["moved"] == "monitor")
    t = evidence(scene).log_ratio[0]
    assert entry == {
        "subject": "monitor",
        "relation": "on-top",
        "object": "floor",
        "probability": pytest.approx(1 / (1 + math.exp(-t)), rel=1e-4),
        "is_misplaced": True,
        "reason": "on-floor",
        "moved": "monitor",
    }


def test_a_stated_relation_has_its_words_and_no_reason_of_boxes():
    under, left = (ON_TOP, 0, 1), (LEFT, 0, 2)
    scene = stated([DESK, BIN, POT], [under, left], {under})
    answer = {entry["relation"]: entry for entry in fields_of(scene, {left: 1.0})}
    assert {name: (e["subject"], e["object"], e["moved"]) for name, e in answer.items()} == {
        "under": ("bin", "desk", "bin"), "left": ("desk", "pot", "desk"),
    }  # fmt: skip
    assert {entry["reason"] for entry in answer.values()} == {"relation"}
    assert answer["left"]["probability"] == pytest.approx(1 / (1 + math.e), rel=1e-4)


@pytest.mark.parametrize("sensitivity", ["low", "medium", "high"])
def test_boxes_on_the_floor_are_listed_above_the_line_or_the_least_probability(sensitivity):
    """The lines are at the odds e, e² and e³."""
    things = [(c, (4.0 * c, 0, 0)) for c in (DESK, MONITOR, BIN, POT, SOFA)]
    scene = posed(*things)
    t, line = evidence(scene).log_ratio, {"low": 3, "medium": 2, "high": 1}[sensitivity]
    p = {thing.id: 1 / (1 + math.exp(-x)) for thing, x in zip(scene.objects, t, strict=True)}
    answer = fields_of(scene, sensitivity=sensitivity)
    expected = sorted((x for x in p if p[x] >= LEAST_LISTED), key=p.__getitem__, reverse=True)
    assert [entry["moved"] for entry in answer] == expected
    assert {"pot", "monitor"} <= {*expected}
    for entry in answer:
        assert entry["is_misplaced"] == (p[entry["moved"]] >= 1 / (1 + math.exp(-line)))
    # Above the least probability, the most sensitive line does not matter, and below it, it does.
    assert len(fields_of(scene, judgements=EVERY)) == len(scene.objects)


def test_supports_of_boxes_are_listed_even_if_they_are_right():
    scene = posed((STOVE, (0, 0, 0)), (POT, (0, 0, 0.9)), (DESK, (9, 0, 0)))
    answer = fields_of(scene, {(ON_TOP, 1, 0): 6.0})
    (entry,) = (entry for entry in answer if entry["moved"] == "pot")
    assert (entry["relation"], entry["object"], entry["is_misplaced"]) == ("on-top", "stove", False)
    assert entry["probability"] < LEAST_LISTED


def test_a_kind_without_judgement_is_left_out():
    scene = stated([DESK, MONITOR, BIN], [(ON_TOP, 1, 0), (LEFT, 2, 1)])
    (entry,) = fields_of(scene, judgements=judging(lateral=None))
    assert entry["relation"] == "on-top"
    on_floor = posed((POT, (0, 0, 0)), (SOFA, (4, 0, 0)))
    assert fields_of(on_floor)
    assert not fields_of(on_floor, judgements=JUDGED.model_copy(update={"on_floor": None}))


def test_wrong_relations_have_the_log_odds_of_the_answer():
    artifact = larger_artifact("triway")
    scene = scene_of([0, 1, 2, 3], [(ON_TOP, 1, 2), (LEFT, 0, 3), (ABOVE, 1, 0)])
    log_odds = wrong_relations(artifact, scene)
    names = {(ON_TOP, 1, 2): "on-top", (LEFT, 0, 3): "left", (ABOVE, 1, 0): "above"}
    answer = {entry.relation: entry.probability for entry in misplaced(artifact, scene)}
    assert log_odds.keys() == names.keys()
    for triple, z in log_odds.items():
        assert answer[names[triple]] == pytest.approx(1 / (1 + math.exp(-z)), rel=1e-5)
