"""The entries of `misplaced`: their kinds, their terms, and the object that has moved."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.model.calibration import Judgement
from app.questions.misplaced import (
    BELOW,
    BESIDE,
    EXPLAINED,
    LEAST_Z,
    OVER,
    STAND,
    SUPPORT,
    entries_of,
    misplaced_fields,
    wrong_log_odds,
    wrong_relations,
)
from app.questions.posterior import present
from app.scene import ObjectClass, RelationTable, Scene, SceneObject, Vocabulary, observe
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
# A bin is under a desk, and a monitor is on it.
PLACES = places_of(
    V,
    {(ON_TOP, MONITOR, DESK): 9},
    stands=np.array(STANDS, np.float32),
    role_pair=np.array([MONITOR * V + DESK, BIN * V + DESK], np.int32),
    role_counts=np.array([(9, 0, 0), (0, 5, 0)], np.float32),
    role_anchor=np.array([(9, 5, 0), *[(0, 0, 0)] * (V - 1)], np.float32),
)
VOCABULARY = Vocabulary(
    [ObjectClass(name, structure=name == "wall", size=size) for name, (size, _) in THINGS.items()],
    ("office", "kitchen"),
)
ARTIFACT = replace(larger_artifact("triway"), vocabulary=VOCABULARY, places=PLACES)
FLAT = -9.0  # log-odds of the relations that a test does not name


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
        SceneObject(NAMES[c], NAMES[c], c, position=(x, y, z + SIZES[c][2] / 2))
        for c, (x, y, z) in bottoms
    )
    roles = None if artifact.places is None else artifact.places.roles
    return observe(Scene(objects), typical_sizes=VOCABULARY.sizes, roles=roles)


def entries(scene, alone=(), change=(), artifact=ARTIFACT):
    """Entries as a dictionary from triples to kind, terms and mover."""
    table = entries_of(artifact, posterior_of(scene, alone, change), scene)
    rows = zip(*(column.tolist() for column in table), strict=True)
    return {tuple(triple): (kind, terms, mover) for triple, kind, terms, mover in rows}


def test_the_terms_of_a_hand_computed_example():
    on, under, left = (ON_TOP, 1, 0), (ON_TOP, 0, 2), (LEFT, 2, 1)
    scene = stated([DESK, MONITOR, BIN], [on, under, left], {under})
    alone = {on: 1.0, under: -2.0, (ABOVE, 0, 2): -0.5, left: 0.25, (ON_TOP, 1, 2): -1.0}
    table = entries(scene, alone, {on: 0.5, under: -0.125, left: -1.5})
    # Nine scenes show the monitor on a desk. The counts of all supporters are smoothed by .5.
    q = math.log((9 + 10 * 9.5 / (9 + 0.5 * V)) / (9 + 10))
    assert table == {
        on: (SUPPORT, pytest.approx([1.0, 0.5, 0.0, q], rel=1e-5), 1),
        # Five scenes show the bin under a desk, and none on it. The stand of the bin is unknown.
        under: (BELOW, pytest.approx([math.log(25 / 0.5), -0.125, 0.0, 0.0], rel=1e-5), 2),
        left: (BESIDE, [0.25, -1.5, 0.0, 0.0], 2),
    }


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
        ((ABOVE, 0, 1), False, OVER, 0),
        ((ABOVE, 0, 1), True, OVER, 1),
    ],
)
def test_kind_and_mover_of_a_stated_relation(triple, is_opposite, kind, mover):
    table = entries(stated([DESK, BIN], [triple], {triple} if is_opposite else ()))
    assert {key: (k, m) for key, (k, _, m) in table.items()} == {triple: (kind, mover)}


def test_the_stand_of_classes_that_belong_everywhere_is_not_judged():
    """A bag under the desk, or on the floor, is normal. On the monitor, z decides alone."""
    objects = [replace(thing, anywhere=thing.label == "bin") for thing in VOCABULARY.objects]
    artifact = replace(ARTIFACT, vocabulary=Vocabulary(objects, VOCABULARY.room_types))
    under, on = (ON_TOP, 0, 1), (ON_TOP, 1, 2)
    scene = stated([DESK, BIN, MONITOR], [under, on], {under})
    table = entries(scene, {on: -2.0}, artifact=artifact)
    assert table == {on: (SUPPORT, [-2.0, 0.0, 0.0, 0.0], 1)}
    alone = entries(posed((BIN, (0, 0, 0)), (DESK, (4, 0, 0))), artifact=artifact)
    assert [mover for _, _, mover in alone.values()] == [1]


def test_a_supported_object_above_another_is_not_misplaced():
    over = (ABOVE, 1, 2)
    alone = entries(stated([DESK, MONITOR, RUG], [over]))
    assert alone[over] == (OVER, [LEAST_Z, 0.0, 0.0, 0.0], 1)
    held = entries(stated([DESK, MONITOR, RUG], [(ON_TOP, 1, 0), over]))
    assert held[over] == (OVER, [EXPLAINED, 0.0, 0.0, 0.0], 1)


STANDING = -1  # the floor as object of an entry


def test_a_monitor_under_the_desk_has_moved():
    """Its bottom is on the floor, so the desk is on top of it: the poses show no other role."""
    under = (ON_TOP, 0, 1)
    table = entries(posed((DESK, (0, 0, 0)), (MONITOR, (0, 0, 0))), {under: -3.0})
    floor = math.log(0.05)
    assert table[under] == (BELOW, pytest.approx([-3.0, 0, floor, 0], rel=1e-5), 1)
    assert table[ON_TOP, 1, STANDING] == (STAND, pytest.approx([0, 0, floor, 0], rel=1e-5), 1)
    assert table[ON_TOP, 0, STANDING][1] == pytest.approx([0, 0, math.log(0.95), 0], rel=1e-5)
    assert len(table) == 3


def test_the_support_of_a_class_never_on_the_floor_is_finite():
    """A share of 0 counts as 1e-6."""
    stands = PLACES.stands.copy()
    stands[MONITOR] = (0, 0, 1)
    artifact = replace(ARTIFACT, places=replace(PLACES, stands=stands))
    table = entries(posed((MONITOR, (0, 0, 0)), (DESK, (4, 0, 0))), artifact=artifact)
    assert table[ON_TOP, 0, STANDING][1][2] == pytest.approx(math.log(1e-6))


@pytest.mark.parametrize("is_posed", [True, False])
def test_without_places_stands_are_unknown(is_posed):
    artifact = replace(ARTIFACT, places=None)
    if is_posed:
        scene = posed((DESK, (0, 0, 0)), (MONITOR, (0, 0, 0.75)), artifact=artifact)
    else:
        scene = stated([DESK, MONITOR], [(ON_TOP, 1, 0)])
    table = entries(scene, {(ON_TOP, 1, 0): 1.5}, artifact=artifact)
    assert table == {(ON_TOP, 1, 0): (SUPPORT, [1.5, 0.0, 0.0, 0.0], 1)}
    (entry,) = misplaced_fields(artifact, posterior_of(scene), scene, "medium")
    assert (entry["subject"], entry["moved"]) == ("monitor", "monitor")


JUDGED = judging(lines(3.0, 2.0, 1.0), stand=-1.0)


def fields_of(scene, alone=(), sensitivity="medium", judgements=JUDGED):
    calibration = ARTIFACT.calibration.model_copy(update={"misplaced": judgements})
    artifact = replace(ARTIFACT, calibration=calibration)
    return misplaced_fields(artifact, posterior_of(scene, alone), scene, sensitivity)


def test_the_log_odds_are_a_weighted_sum_of_the_terms():
    judgement = Judgement(
        intercept=0.5, relation=-1.0, change=2.0, stand=-0.25, supporter=-0.5, lines=lines(0, 0, 0)
    )
    terms = np.array([[1.0, 0.5, -4.0, -2.0], [0.0, 0.0, 0.0, 0.0]])
    assert wrong_log_odds(judgement, terms).tolist() == [0.5 - 1 + 1 + 1 + 1, 0.5]


def test_the_answer_names_the_moved_object_of_each_entry():
    scene = posed((DESK, (0, 0, 0)), (MONITOR, (0, 0, 0)))
    answer = fields_of(scene, {(ON_TOP, 0, 1): 0.5})
    # log-odds -0.5 + log 20 and log 20
    expected = [
        ("monitor", "on-top", "floor", 20.0),
        ("monitor", "under", "desk", 20.0 * math.exp(-0.5)),
    ]
    for entry, (subject, relation, object_, odds) in zip(answer, expected, strict=True):
        named = [entry[name] for name in ("subject", "relation", "object")]
        assert named == [subject, relation, object_]
        assert entry["moved"] == "monitor"
        assert entry["probability"] == pytest.approx(odds / (1 + odds), rel=1e-4)
        assert entry["is_misplaced"]


@pytest.mark.parametrize("sensitivity", ["low", "medium", "high"])
def test_objects_on_the_floor_are_listed_only_above_the_most_sensitive_line(sensitivity):
    """The lines are at the odds e, e² and e³. Odds are 1/p(floor) or 1/p(hangs)."""
    scene = posed(*((c, (4.0 * c, 0, 0)) for c in (DESK, MONITOR, BIN, POT, SOFA)),
                  (SHELF, (40, 0, 0.9)))  # fmt: skip
    answer = fields_of(scene, sensitivity=sensitivity)
    held = 10 * 0.5 / (9 + 0.5 * V) / 10  # share of each supporter that no scene shows
    on_desk = 10 * 9.5 / (9 + 0.5 * V) / 10
    unlisted = 1 - on_desk - 5 * held
    odds = {"pot": 50, "monitor": 20, "shelf": 1 / (0.35 + 0.05 * unlisted)}
    assert [entry["moved"] for entry in answer] == [*odds]
    line = math.exp({"low": 3, "medium": 2, "high": 1}[sensitivity])
    for entry in answer:
        assert entry["object"] == "floor"
        assert entry["relation"] == ("above" if entry["moved"] == "shelf" else "on-top")
        assert entry["is_misplaced"] == (odds[entry["moved"]] >= line)


def test_a_kind_without_judgement_is_left_out():
    scene = stated([DESK, MONITOR, BIN], [(ON_TOP, 1, 0), (LEFT, 2, 1)])
    (entry,) = fields_of(scene, judgements=judging(lateral=None))
    assert entry["relation"] == "on-top"
    on_floor = posed((POT, (0, 0, 0)), (SOFA, (4, 0, 0)))
    assert fields_of(on_floor)
    assert not fields_of(on_floor, judgements=JUDGED.model_copy(update={"stand": None}))


def test_wrong_relations_have_the_log_odds_of_the_answer():
    artifact = larger_artifact("triway")
    scene = scene_of([0, 1, 2, 3], [(ON_TOP, 1, 2), (LEFT, 0, 3), (ABOVE, 1, 0)])
    log_odds = wrong_relations(artifact, scene)
    names = {(ON_TOP, 1, 2): "on-top", (LEFT, 0, 3): "left", (ABOVE, 1, 0): "above"}
    answer = {entry.relation: entry.probability for entry in misplaced(artifact, scene)}
    assert log_odds.keys() == names.keys()
    for triple, z in log_odds.items():
        assert answer[names[triple]] == pytest.approx(1 / (1 + math.exp(-z)), rel=1e-5)
