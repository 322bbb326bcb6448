from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from app.scene import Scene, SceneObject, Viewpoint, observe
from app.scene.relations import ABOVE, FRONT, LEFT, ON_TOP, STACKED
from tests.scene.role_counts import LABELS, role_counts

DESK = SceneObject("desk", "desk", 0, position=(2.0, 0.0, 0.4), size=(0.8, 1.6, 0.8))
MONITOR = SceneObject("monitor", "monitor", 1, position=(2.0, 0.2, 1.0), size=(0.1, 0.5, 0.4))
CHAIR = SceneObject("chair", "chair", 2, position=(1.2, 0.0, 0.5))


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


def test_counts_decide_between_the_roles_of_boxes_that_reach_into_each_other() -> None:
    bin_ = SceneObject("bin", "bin", LABELS.index("bin"), 1.0, (2.1, 0.4, 0.2), (0.3, 0.3, 0.4))
    desk = replace(DESK, class_index=LABELS.index("desk"))
    roles = role_counts({(bin_.class_index or 0, desk.class_index or 0): (0, 9, 0)})
    assert observe(Scene((desk, bin_)), roles=roles).relations == ((ON_TOP, 0, 1),)
    assert observe(Scene((desk, bin_))).relations == ()
    # A label outside the vocabulary has no counts.
    assert observe(Scene((desk, replace(bin_, class_index=None))), roles=roles).relations == ()


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


def test_scenes_without_poses_stay_as_they_are() -> None:
    for relations in (None, ((LEFT, 0, 1),)):
        bare = Scene((SceneObject("a", "a", 0), SceneObject("b", "b", 1)), relations)
        assert observe(bare) is bare


def test_objects_without_a_position_have_no_observed_relations() -> None:
    seen = observe(Scene((DESK, SceneObject("cup", "cup", 1))), viewpoint=Viewpoint(0, 0, 1.0))
    assert seen.relations == ()
    assert seen.poses is not None
    assert not seen.poses.observed.any()
    assert seen.objects[1].position is None
