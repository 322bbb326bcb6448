import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.scene import CANONICAL, ObjectClass, Vocabulary, to_viewer_frame
from app.scene.spatial_relations import ABOVE, FRONT, LEFT, ON_TOP
from tests.training.scenes import encode_objects, things
from training.datasets import AnnotatedObject, annotated_classes, encode
from training.datasets.encoding import derive_from_boxes, room_viewpoint

THINGS = [ObjectClass("desk"), ObjectClass("monitor", ("screen",)), ObjectClass("pencil")]
STRUCTURE = [ObjectClass(label, structure=True) for label in ("wall", "floor")]
VOCABULARY = Vocabulary([*THINGS, *STRUCTURE], ["bathroom", "office"])
DESK, MONITOR, PENCIL, WALL, FLOOR = range(5)
DESK_BOX: dict[str, Any] = {"position": (2.0, 0.0, 0.4), "size": (0.8, 1.6, 0.8)}
MONITOR_BOX: dict[str, Any] = {"position": (2.0, 0.3, 1.0), "size": (0.1, 0.5, 0.4)}
DESK_THING = AnnotatedObject("d", "desk", **DESK_BOX)
MONITOR_THING = AnnotatedObject("m", "monitor", **MONITOR_BOX)


def encoded(objects: tuple[AnnotatedObject, ...], **fields: Any) -> Any:
    return encode_objects(objects, VOCABULARY, **fields)


def triples(scene: Any) -> set[tuple[int, int, int]]:
    names = scene.evidence.classes
    return {(int(a), int(names[x]), int(names[y])) for a, x, y in np.argwhere(scene.evidence.holds)}


def test_classes_counts_and_unknown_labels() -> None:
    scene = encoded(
        things("Screens", "desk", "goblet", "Goblets", "monitor", "wall"), room_type="Toilet"
    )
    assert scene.instance_classes.tolist() == [MONITOR, DESK, MONITOR, WALL]
    assert scene.evidence.classes.tolist() == [DESK, MONITOR, WALL]
    assert scene.evidence.counts.tolist() == [1, 2, 1]
    assert scene.unknown == ("Goblets",)
    assert scene.room_type == 0  # a toilet is a bathroom
    assert not scene.evidence.observed.any()


@pytest.mark.parametrize("room_type", [None, "unknown", "attic"])
def test_rooms_without_a_type(room_type: str | None) -> None:
    scene = encoded(things("desk"), room_type=room_type)
    assert scene.room_type == -1


def test_unlisted_relations_are_false_in_scenes_with_listed_relations() -> None:
    scene = encoded(
        things("desk", "monitor", "monitor", "pencil"),
        relations=((1, "on-top", 0), (0, "under", 1), (2, "behind", 1)),
    )
    assert triples(scene) == {(ON_TOP, MONITOR, DESK), (FRONT, MONITOR, MONITOR)}
    assert scene.instance_holds.sum() == 2
    assert (scene.instance_observed == ~np.eye(4, dtype=bool)).all()
    # A class with one instance has no pair with itself.
    single = scene.evidence.counts == 1
    assert (scene.evidence.observed == ~np.diag(single)).all()
    assert scene.instance_positions is scene.instance_sizes is scene.instance_yaws is None


def test_contradictory_relations_are_unobserved() -> None:
    scene = encoded(
        things("desk", "monitor", "pencil"),
        relations=((0, "front", 1), (0, "behind", 1), (2, "on-top", 0), (1, "on-top", 0)),
    )
    assert triples(scene) == {(ON_TOP, PENCIL, DESK), (ON_TOP, MONITOR, DESK)}
    unobserved = np.argwhere(~scene.instance_observed & ~np.eye(3, dtype=bool))
    assert unobserved.tolist() == [[FRONT, 0, 1], [FRONT, 1, 0]]


def test_relations_of_structure_are_unobserved() -> None:
    scene = encoded(
        things("desk", "floor", "monitor"), relations=((0, "on-top", 1), (2, "on-top", 0))
    )
    assert triples(scene) == {(ON_TOP, MONITOR, DESK)}
    floor = list(scene.evidence.classes).index(FLOOR)
    assert not scene.evidence.observed[:, floor].any()
    assert not scene.evidence.observed[:, :, floor].any()
    assert not scene.instance_observed[:, 1].any()
    assert scene.evidence.observed[:, 0, 1].all()


def test_incompletely_annotated_labels_of_a_source_are_left_out() -> None:
    scene = encoded(things("wall", "desk", "floor"), source="sunrgbd")
    assert scene.evidence.classes.tolist() == [DESK]
    assert scene.unknown == ()
    # The source has an open vocabulary, so it annotates every other class.
    annotated = annotated_classes([scene], VOCABULARY)["sunrgbd"]
    assert annotated.tolist() == [True, True, True, False, False]
    assert encoded(things("wall", "desk")).evidence.classes.tolist() == [DESK, WALL]


def test_other_sources_annotate_the_classes_that_they_mention() -> None:
    first, second = encoded(things("desk")), encoded(things("screen", "wall"))
    annotated = annotated_classes([first, second], VOCABULARY)
    assert annotated["t"].tolist() == [True, True, False, True, False]
    assert annotated_classes([], VOCABULARY) == {}


def test_poses_in_viewer_axes() -> None:
    objects = (
        DESK_THING,
        MONITOR_THING,
        AnnotatedObject("p", "pencil", position=(1.4, 0.1, 0.8), size=(0.1, 0.1, 0.1)),
        AnnotatedObject("w", "wall"),
    )
    scene = encoded(objects, viewer_frame=True)
    assert triples(scene) == {
        (ON_TOP, MONITOR, DESK),
        (FRONT, PENCIL, DESK),
        (FRONT, PENCIL, MONITOR),
    }
    assert scene.evidence.observed[:, :3, :3][:, ~np.eye(3, dtype=bool)].all()
    assert not scene.evidence.observed[:, 3].any()


def test_without_viewer_axes_relations_depend_on_the_chosen_viewpoint() -> None:
    objects = (
        AnnotatedObject("d", "desk", position=(0.0, 0.0, 0.4), size=(0.5, 0.5, 0.8)),
        AnnotatedObject("m", "monitor", position=(1.0, 0.0, 0.4), size=(0.5, 0.5, 0.8)),
    )
    seen = {frozenset(triples(encoded(objects, scene_id=f"scene-{k}"))) for k in range(40)}
    # From the four sides of the room: in front, behind, left and right.
    assert seen == {
        frozenset({(FRONT, DESK, MONITOR)}),
        frozenset({(FRONT, MONITOR, DESK)}),
        frozenset({(LEFT, DESK, MONITOR)}),
        frozenset({(LEFT, MONITOR, DESK)}),
    }


def test_scenes_without_known_objects_are_empty() -> None:
    scene = encoded(things("goblet"), relations=())
    assert scene.unknown == ("goblet",)
    assert scene.evidence.classes.shape == (0,)
    assert scene.evidence.holds.shape == (len(CANONICAL), 0, 0)
    assert encode([], VOCABULARY) == []


def test_boxes_are_in_the_axes_that_relations_were_derived_in() -> None:
    objects = (
        AnnotatedObject("0", "goblet", position=(9.0, 9.0, 9.0), size=(1.0, 1.0, 1.0)),
        AnnotatedObject("1", "desk", yaw=0.2, **DESK_BOX),
        AnnotatedObject("2", "pencil"),
        AnnotatedObject("3", "monitor", **MONITOR_BOX),
    )
    seen, chosen = encoded(objects, viewer_frame=True), encoded(objects)
    positions = [DESK_BOX["position"], MONITOR_BOX["position"]]
    assert seen.instance_positions[[0, 2]].tolist() == list(map(list, positions))
    assert seen.instance_yaws.tolist() == [0.2, 0.0, 0.0]
    for scene in (seen, chosen):
        assert scene.instance_sizes[0].tolist() == list(DESK_BOX["size"])
        assert np.isnan([scene.instance_positions[1], scene.instance_sizes[1]]).all()
    unknown = (math.nan,) * 3
    viewpoint = room_viewpoint("s", np.array([thing.position or unknown for thing in objects]))
    expected, _ = to_viewer_frame(positions, viewpoint)
    assert chosen.instance_positions[[0, 2]] == pytest.approx(expected)
    assert chosen.instance_yaws == pytest.approx(seen.instance_yaws - viewpoint.yaw)


def test_left_and_above_in_an_image() -> None:
    drawn = [(0, 50, 10, 60), (14, 51, 24, 61), (1, 10, 11, 40), (500, 0, 510, 9), None]
    labels = ("desk", "monitor", "pencil", "desk", "pencil")
    objects = tuple(replace(x, box2d=b) for x, b in zip(things(*labels), drawn, strict=True))
    scene = encoded(objects)
    holds, observed = scene.instance_holds, scene.instance_observed
    assert np.argwhere(holds).tolist() == [[LEFT, 0, 1], [ABOVE, 2, 0], [ABOVE, 2, 1]]
    # One box is far from all others, one is unknown.
    assert not observed[:, 3:].any()
    assert not observed[:, :, 3:].any()
    assert observed[LEFT, 1, 0]
    # Offsets of less than a tenth of the box decide nothing.
    assert not derive_from_boxes([(0, 0, 100, 100), (5, 5, 105, 105)]).holds.any()
