from dataclasses import replace

import numpy as np
import pytest

from app.model import Possibility
from app.model.possibility import UNKNOWN as UNDESCRIBED
from app.scene import ObjectClass, Vocabulary
from app.scene.spatial_relations import INSIDE, LEFT, ON_TOP
from app.scene.stands import FLOOR, HANGS, SUPPORTED, UNKNOWN
from tests.training.evaluation.scenes import scene
from training.datasets.roles import count_roles
from training.fit.draft import fit_places

KINDS = [ObjectClass("table lamp", parent="lamp"), ObjectClass("wall", structure=True)]
VOCABULARY = Vocabulary([*map(ObjectClass, ("desk", "lamp", "picture")), *KINDS])
DESK, LAMP, PICTURE, TABLE_LAMP, WALL = range(5)
V = len(VOCABULARY)
ROLES = count_roles((), VOCABULARY)


def key(a: int, i: int, j: int) -> int:
    return (a * V + i) * V + j


def test_each_scene_counts_once_for_each_triple():
    scenes = [
        scene([DESK, LAMP], [(ON_TOP, LAMP, DESK), (LEFT, DESK, LAMP)]),
        scene([DESK, LAMP], [(ON_TOP, LAMP, DESK)]),
        scene([LAMP, PICTURE], [(INSIDE, PICTURE, LAMP)]),
        scene([DESK]),
    ]
    places = fit_places(scenes, ROLES, VOCABULARY)
    triples = {key(ON_TOP, LAMP, DESK): 2, key(LEFT, DESK, LAMP): 1, key(INSIDE, PICTURE, LAMP): 1}
    assert dict(zip(places.triple.tolist(), places.triple_scenes.tolist(), strict=True)) == triples
    assert places.triple.tolist() == sorted(triples)
    # One more for each class: three, three, one, none and none of the four scenes list it.
    assert places.frequency == pytest.approx(np.array([4, 4, 2, 1, 1]) / 12)
    shown = places.scenes((ON_TOP, LEFT), np.array([LAMP, DESK]), np.array([DESK, LAMP]))
    assert shown.tolist() == [[[2, 0], [0, 0]], [[0, 0], [0, 1]]]


def test_structure_and_pairs_of_one_class_do_not_count():
    silent = [
        scene([DESK, WALL], [(ON_TOP, DESK, WALL)]),
        scene([DESK, LAMP]),
        scene([DESK, DESK], [(LEFT, DESK, DESK)]),
    ]
    assert fit_places(silent, ROLES, VOCABULARY) is None
    assert fit_places([], ROLES, VOCABULARY) is None


def test_stands_are_smoothed_towards_the_parent_and_all_classes():
    """Ten lamps: six on the floor, four on an object. Two pictures hang. The desk is unknown."""
    lamps = [scene([LAMP, DESK], [(ON_TOP, LAMP, DESK)]) for _ in range(10)]
    stands = [FLOOR] * 6 + [SUPPORTED] * 4
    scenes = [
        replace(one, instance_stands=np.array([stand, UNKNOWN]))
        for one, stand in zip(lamps, stands, strict=True)
    ]
    hanging = replace(scene([PICTURE, PICTURE]), instance_stands=np.array([HANGS, HANGS]))
    shares = fit_places([*scenes, hanging], ROLES, VOCABULARY).stands
    usual = np.array([7, 3, 5]) / 15
    lamp, picture = np.array([6, 0, 4]), np.array([0, 2, 0])
    expected = {DESK: usual, WALL: usual, PICTURE: (picture + 5 * usual) / 7}
    # No scene shows a table lamp, so it has the shares of its parent.
    expected |= dict.fromkeys((LAMP, TABLE_LAMP), (lamp + 5 * usual) / 15)
    for index, row in expected.items():
        assert shares[index] == pytest.approx(row, rel=1e-6)


def standing(*stands: tuple[int, int], source: str = "toy"):
    """A scene of objects (class, stand), without relations."""
    classes, held = (list(column) for column in zip(*stands, strict=True))
    return replace(scene(classes, source=source), instance_stands=np.array(held))


RELATED = scene([LAMP, DESK], [(LEFT, LAMP, DESK)])
# A source that shows all stands.
EVERY = standing((PICTURE, HANGS), (LAMP, FLOOR), (LAMP, SUPPORTED))


def stands_of(scenes, possibility=None):
    return fit_places([RELATED, *scenes], ROLES, VOCABULARY, possibility).stands


def test_a_kind_that_was_seen_moves_away_from_its_parent():
    seen = standing((TABLE_LAMP, SUPPORTED), (LAMP, FLOOR))
    shares = stands_of([seen] * 5 + [standing((PICTURE, HANGS))])
    usual = np.array([6, 2, 6]) / 14
    parent = (np.array([5, 0, 0]) + 5 * usual) / 10
    assert shares[LAMP] == pytest.approx(parent, rel=1e-6)
    assert shares[TABLE_LAMP] == pytest.approx((np.array([0, 0, 5]) + 5 * parent) / 10, rel=1e-6)
    assert shares.sum(1) == pytest.approx(np.ones(V), rel=1e-6)


@pytest.mark.parametrize("shown", [(FLOOR, SUPPORTED), (HANGS, SUPPORTED), (FLOOR, HANGS)])
def test_only_sources_that_show_all_stands_count(shown):
    """Words hardly ever state the floor. The third stand may be in another scene of the source."""
    partial = [standing(*((DESK, stand) for stand in shown), source="words")] * 9
    expected = stands_of([EVERY])
    np.testing.assert_array_equal(stands_of([EVERY, *partial]), expected)
    (third,) = {FLOOR, HANGS, SUPPORTED} - {*shown}
    completed = stands_of([EVERY, *partial, standing((WALL, third), source="words")])
    assert completed[DESK, list(shown)] == pytest.approx(0.5, abs=0.15)
    assert expected[DESK] == pytest.approx(np.full(3, 1 / 3), rel=1e-6)


DESCRIBED = Possibility(
    stands=np.float32(
        [[0.7, 0.1, 0.1, 0.1, 0], [0.2] * 5, [0.2] * 5, [0.1, 0, 0, 0.4, 0.5], [0.2] * 5]
    ),
    traits=np.float32(
        [[1, 0.5, 2], [UNDESCRIBED] * 3, [UNDESCRIBED] * 3, [0, 1, 1], [UNDESCRIBED] * 3]
    ),
    spread=np.full(V, 0.2, np.float32),
    weights=np.zeros((4, 4), np.float32),
)


def test_stands_are_smoothed_to_the_description_before_the_parent():
    """The description has the weight of ten objects. A wall and a ceiling are one stand."""
    seen = [EVERY, standing((DESK, SUPPORTED), (TABLE_LAMP, HANGS))]
    shares, without = stands_of(seen, DESCRIBED), stands_of(seen)
    assert shares[DESK] == pytest.approx(np.array([7, 2, 1 + 1]) / 11, rel=1e-6)
    assert shares[TABLE_LAMP] == pytest.approx(np.array([1, 0 + 1, 9]) / 11, rel=1e-6)
    np.testing.assert_array_equal(shares[[LAMP, PICTURE, WALL]], without[[LAMP, PICTURE, WALL]])


def boxed(*pairs: tuple[int, int, float], relation: int = ON_TOP):
    """A scene of things (class, class of the support, bottom below the top of the support)."""
    classes = [c for thing, support, _ in pairs for c in (thing, support)]
    one = scene(classes)
    holds = np.zeros_like(one.instance_holds)
    positions, sizes = np.zeros((2, len(classes), 3))
    sizes[:] = 0.4
    for k, (*_, depth) in enumerate(pairs):
        holds[relation, 2 * k, 2 * k + 1] = True
        positions[2 * k, 2] = 0.4 - depth
    return replace(one, instance_holds=holds, instance_positions=positions, instance_sizes=sizes)


def within(scenes, possibility=None):
    return fit_places([RELATED, *scenes], ROLES, VOCABULARY, possibility).within


def test_things_far_below_the_top_of_their_support_are_within_it():
    """Five objects without a description smooth the shares: .15 of them are within."""
    shares = within(
        [
            boxed((LAMP, DESK, 0.0), (PICTURE, DESK, 0.09), (PICTURE, DESK, 0.11)),
            boxed((LAMP, DESK, 0.3), relation=INSIDE),
            boxed((LAMP, PICTURE, 0.3), relation=LEFT),
        ]
    )
    others = [0.15] * (V - 1)
    assert shares.tolist() == pytest.approx([(2 + 0.75) / 9, *others])
    unknown = boxed((LAMP, DESK, 0.3))
    unknown.instance_sizes[1] = np.nan
    assert within([unknown]).tolist() == pytest.approx([0.15] * V)


def test_containers_have_more_within_them():
    """The table lamp contains things, and the desk sometimes does."""
    expected = [0.15 + 0.6 * share for share in (0.5, 0, 0, 1, 0)]
    assert within([], DESCRIBED).tolist() == pytest.approx(expected)
    seen = within([boxed(*[(LAMP, TABLE_LAMP, 0.0)] * 5)], DESCRIBED)
    assert seen[TABLE_LAMP] == pytest.approx(0.75 * 5 / 10)
