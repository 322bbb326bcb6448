from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from app.scene import (
    PoseRelations,
    Scene,
    SceneObject,
    Viewpoint,
    instance_evidence,
    observe,
    pool_instances,
)
from app.scene.relations import (
    ABOVE,
    CANONICAL,
    FRONT,
    LEFT,
    ON_TOP,
    RELATIONS,
    STACKED,
    canonicalise,
    contradiction,
    opposite,
    support_cycle,
)
from scene_client.schemas import RelationName

DESK = SceneObject("desk", "desk", 0, position=(2.0, 0.0, 0.4), size=(0.8, 1.6, 0.8))
MONITOR = SceneObject("monitor", "monitor", 1, position=(2.0, 0.2, 1.0), size=(0.1, 0.5, 0.4))
CHAIR = SceneObject("chair", "chair", 2, position=(1.2, 0.0, 0.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"class_index": -1}, "class_index of 'a'"),
        ({"confidence": 0.0}, "confidence of 'a'"),
        ({"confidence": 1.5}, "confidence of 'a'"),
        ({"position": (0.0, math.nan, 0.0)}, "position of 'a'"),
        ({"size": (1.0, -1.0, 1.0)}, "size of 'a'"),
        ({"yaw": math.inf}, "yaw of 'a'"),
    ],
)
def test_bad_objects_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SceneObject(**{"id": "a", "label": "a", "class_index": 0} | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objects": (DESK, DESK)}, "have the same id"),
        ({"relations": ((5, 0, 1),)}, "a relation index must be from 0 to 4, not 5"),
        ({"relations": ((0, 0, 2),)}, "object index 2"),
        ({"relations": ((0, 1, 1),)}, "'monitor' has the relation left to itself"),
        ({"relations": ((0, 0, 1), (0, 1, 0))}, "'left' is stated from 'desk' to 'monitor'"),
        ({"relations_complete": True}, "relations is None"),
        (
            {"poses": PoseRelations(np.zeros((5, 1, 1), bool), np.zeros((5, 1, 1), bool))},
            "poses must have the shape",
        ),
        ({"excluded": np.zeros((4, 2, 2), bool)}, "excluded must have the shape"),
    ],
)
def test_bad_scenes_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Scene(**{"objects": (DESK, MONITOR)} | change)


def test_poses_become_relations() -> None:
    seen = observe(Scene((DESK, MONITOR, CHAIR)))
    assert set(seen.relations or ()) == {(ON_TOP, 1, 0), (FRONT, 2, 0), (FRONT, 2, 1)}
    assert seen.poses is not None
    assert seen.poses.observed[LEFT, 0, 2]
    assert not seen.poses.observed[ABOVE, 0, 2]  # the chair has no size


def test_flat_boxes_have_relations_and_boxes_below_a_millimetre_have_no_size() -> None:
    rug = replace(MONITOR, id="rug", position=(2.0, 0.0, 0.0), size=(2.0, 3.0, 0.0))
    assert observe(Scene((DESK, rug))).relations == ((ON_TOP, 0, 1),)
    speck = replace(rug, size=(0.0, 0.0, 0.0005))
    bare = replace(rug, size=None)
    assert observe(Scene((DESK, speck))).relations == observe(Scene((DESK, bare))).relations


def test_typical_sizes_take_the_place_of_unknown_ones() -> None:
    cup = SceneObject("cup", "cup", 2, position=(2.0, -0.5, 0.85))
    sizes = np.array([[math.nan] * 3, [math.nan] * 3, [0.1, 0.1, 0.1]])
    without = observe(Scene((DESK, cup)))
    assert (ON_TOP, 1, 0) not in (without.relations or ())
    assert observe(Scene((DESK, cup)), typical_sizes=sizes).relations == ((ON_TOP, 1, 0),)
    # A label outside the vocabulary has no typical size.
    stranger = SceneObject("cup", "goblet", None, position=(2.0, -0.5, 0.85))
    assert observe(Scene((DESK, stranger)), typical_sizes=sizes).relations == without.relations


def test_stated_relations_stay_and_poses_exclude_others() -> None:
    """The monitor stands on the desk, 20 cm to the left, and the sofa is far away."""
    sofa = SceneObject("sofa", "sofa", 3, position=(6.0, 0.0, 0.4), size=(0.9, 2.0, 0.8))
    objects = (DESK, MONITOR, sofa)
    stated = Scene(objects, relations=((ON_TOP, 2, 0), (LEFT, 1, 0)))
    seen, derived = observe(stated, viewpoint=Viewpoint(0, 0, 0)), observe(Scene(objects))
    assert (seen, seen.poses) == (stated, None)
    assert seen.excluded is not None
    assert derived.excluded is not None
    added = derived.excluded ^ seen.excluded
    assert np.argwhere(added).tolist() == [[LEFT, 1, 0], [ON_TOP, 2, 0]]
    assert seen.excluded[[*STACKED], 0, 2].all()
    assert not seen.excluded[ON_TOP, 1, 0]
    # The sofa is behind the desk.
    assert np.argwhere(~seen.excluded[[LEFT, FRONT], 0, 2]).tolist() == [[FRONT]]
    assert seen.excluded[[LEFT, FRONT], 2, 0].all()


def test_in_a_map_without_a_viewer_no_direction_is_excluded() -> None:
    sofa = SceneObject("sofa", "sofa", 3, position=(6.0, 0.0, 0.4), size=(0.9, 2.0, 0.8))
    seen = observe(Scene((DESK, sofa)), frame_id="map")
    assert seen.excluded is not None
    assert not seen.excluded[[LEFT, FRONT]].any()


@pytest.mark.parametrize(("distance", "is_far"), [(2.9, False), (3.1, True)])
def test_boxes_of_unknown_size_are_not_stacked_from_far_apart(
    distance: float, is_far: bool
) -> None:
    """A footprint of unknown size reaches at most 1.5 m."""
    ends = [
        SceneObject(name, name, 0, position=(x, 0, 0)) for name, x in (("a", 0), ("b", distance))
    ]
    seen = observe(Scene(tuple(ends)))
    assert seen.excluded is not None
    assert seen.excluded[[*STACKED], 0, 1].all() == is_far


# --------------------------------------------------------------------------- evidence about classes


A = len(CANONICAL)


@st.composite
def instances(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    size = draw(st.integers(0, 6))
    classes = draw(hnp.arrays(np.int64, size, elements=st.integers(0, 3)))
    confidence = draw(hnp.arrays(float, size, elements=st.floats(0.01, 1)))
    holds = draw(hnp.arrays(bool, (A, size, size)))
    return classes, confidence, holds, draw(hnp.arrays(bool, (A, size, size)))


@given(instances())
def test_classes_are_the_or_over_instance_pairs(
    drawn: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    classes, confidence, holds, observed = drawn
    evidence = pool_instances(*drawn, room_type=3)
    assert evidence.room_type == 3
    assert evidence.classes.tolist() == sorted(set(classes.tolist()))
    assert evidence.counts.tolist() == [(classes == c).sum() for c in evidence.classes]
    for x, c in enumerate(evidence.classes):
        members = np.flatnonzero(classes == c)
        assert evidence.confidence[x] == pytest.approx(1 - np.prod(1 - confidence[members]))
        for y, d in enumerate(evidence.classes):
            pairs = [(i, j) for i in members for j in np.flatnonzero(classes == d) if i != j]
            for a in range(A):
                on = any(holds[a, i, j] for i, j in pairs)
                assert evidence.holds[a, x, y] == on
                observes = on or any(observed[a, i, j] for i, j in pairs)
                assert evidence.observed[a, x, y] == observes


def test_the_evidence_about_instances_is_stated_complete_or_from_poses() -> None:
    things = tuple(SceneObject(str(k), "x", 0) for k in range(3))
    triples = ((ON_TOP, 1, 0), (LEFT, 1, 2))
    holds, observed = instance_evidence(Scene(things, relations=triples))
    assert np.argwhere(holds).tolist() == [[LEFT, 1, 2], [ON_TOP, 1, 0]]
    assert not observed.any()
    stated, observed = instance_evidence(Scene(things, relations=triples, relations_complete=True))
    assert (stated == holds).all()
    assert observed.all()
    poses = PoseRelations(holds, np.roll(holds, 1))
    of_poses = instance_evidence(Scene(things, relations=((LEFT, 0, 1),), poses=poses))
    assert of_poses == (poses.holds, poses.observed)


def test_shapes_are_checked() -> None:
    nothing = np.zeros((A, 2, 2), bool)
    with pytest.raises(ValueError, match=rf"holds must have the shape \({A}, 1, 1\)"):
        pool_instances(np.array([0]), np.ones(1), nothing, nothing)
    with pytest.raises(ValueError, match="confidence must have the shape"):
        pool_instances(np.array([0, 1]), np.ones(1), nothing, nothing)


# ---------------------------------------------------------------------------------------- relations


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


def test_contradictions() -> None:
    assert contradiction([(0, 1, 2), (1, 2, 1), (0, 1, 2)]) is None
    assert contradiction([(0, 1, 2), (3, 0, 1), (0, 2, 1)]) == ((0, 1, 2), (0, 2, 1))


def test_supports_in_a_circle_are_found() -> None:
    """Only on-top (2) and inside (4) hold an object."""
    tower = [(2, "box", "book"), (4, "book", "bag"), (2, "bag", "desk")]
    assert support_cycle(tower) is None
    assert support_cycle([*tower, (3, "desk", "box"), (0, "desk", "box")]) is None
    circle = support_cycle([*tower, (2, "desk", "book")])
    assert circle is not None
    assert circle[0] == circle[-1]
    assert {*pairwise(circle)} == {
        ("book", "bag"), ("bag", "desk"), ("desk", "book"),
    }  # fmt: skip
