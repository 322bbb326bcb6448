from dataclasses import replace

import numpy as np
import pytest

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
    shows = places.shows(ON_TOP, np.array([LAMP, PICTURE]), np.array([DESK]))
    assert shows.tolist() == [[True], [False]]


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


def test_a_kind_that_was_seen_moves_away_from_its_parent():
    seen = replace(
        scene([TABLE_LAMP, LAMP], [(LEFT, TABLE_LAMP, LAMP)]),
        instance_stands=np.array([SUPPORTED, FLOOR]),
    )
    shares = fit_places([seen] * 5, ROLES, VOCABULARY).stands
    usual = np.array([6, 1, 6]) / 13
    parent = (np.array([5, 0, 0]) + 5 * usual) / 10
    assert shares[LAMP] == pytest.approx(parent, rel=1e-6)
    assert shares[TABLE_LAMP] == pytest.approx((np.array([0, 0, 5]) + 5 * parent) / 10, rel=1e-6)
    assert shares.sum(1) == pytest.approx(np.ones(V), rel=1e-6)
