from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.scene import PoseRelations, Scene, SceneObject, Viewpoint, observe
from app.scene.relations import ABOVE, FRONT, LEFT, ON_TOP, STACKED

DESK = SceneObject("desk", "desk", 0, position=(2.0, 0.0, 0.4), size=(0.8, 1.6, 0.8))
MONITOR = SceneObject("monitor", "monitor", 1, position=(2.0, 0.2, 1.0), size=(0.1, 0.5, 0.4))
CHAIR = SceneObject("chair", "chair", 2, position=(1.2, 0.0, 0.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"class_index": -1}, "class_index of 'a'"),
        ({"confidence": 0.0}, "confidence of 'a'"),
        ({"confidence": 1.5}, "confidence of 'a'"),
        ({"confidence": math.nan}, "confidence of 'a'"),
        ({"position": (0.0, math.nan, 0.0)}, "position of 'a'"),
        ({"position": (0.0, 0.0)}, "position of 'a'"),
        ({"size": (1.0, -1.0, 1.0)}, "size of 'a'"),
        ({"size": (1.0, math.inf, 1.0)}, "size of 'a'"),
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
        ({"relations": ((0, -1, 1),)}, "object index -1"),
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
