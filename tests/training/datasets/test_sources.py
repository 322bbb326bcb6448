from typing import Any

import numpy as np
import pytest
import torch

from app.scene import ObjectClass, RoleCounts, Vocabulary
from app.scene.spatial_relations import ABOVE, FRONT, INSIDE, LEFT, ON_TOP, SUPPORTS
from app.scene.stands import FLOOR, HANGS, SUPPORTED, UNKNOWN
from tests.training.scenes import encode_objects, things
from training.datasets import (
    AnnotatedObject,
    AnnotatedScene,
    EncodedScene,
    annotated_classes,
    encode,
)
from training.datasets.batches import scene_tensors
from training.datasets.cases import annotated_relations
from training.datasets.sources import relations_of, supported_subjects

VOCABULARY = Vocabulary([ObjectClass("desk"), ObjectClass("monitor"), ObjectClass("pencil")])
LATERAL, VERTICAL = [LEFT, FRONT], [ON_TOP, ABOVE]
CUBE = (0.2, 0.2, 0.2)


def encoded(source: str, *objects: AnnotatedObject, **fields: Any) -> EncodedScene:
    objects = objects or things("desk", "monitor", "pencil")
    return encode_objects(objects, VOCABULARY, source=source, viewer_frame=True, **fields)


def off(found: EncodedScene) -> set[tuple[int, int, int]]:
    known = found.instance_observed & ~found.instance_holds
    return {(int(a), int(i), int(j)) for a, i, j in np.argwhere(known)}


@pytest.mark.parametrize("source", ["vrd", "nr3d", "coco_captions", "alfred", "bddl_goal"])
def test_unlisted_relations_of_mentions_are_unobserved_except_of_stacked_pairs(source: str) -> None:
    found = encoded(source, relations=((1, "on-top", 0), (2, "left", 1)))
    assert np.argwhere(found.instance_holds).tolist() == [[LEFT, 2, 1], [ON_TOP, 1, 0]]
    beside = {(LEFT, 0, 1), (LEFT, 1, 0), (FRONT, 0, 1), (FRONT, 1, 0)}
    stacked = {(ON_TOP, 0, 1), (ABOVE, 0, 1), (ABOVE, 1, 0), (INSIDE, 0, 1), (INSIDE, 1, 0)}
    assert off(found) == stacked | beside


def test_denied_relations_are_false_and_contradicted_ones_unobserved() -> None:
    one = ((1, "on-top", 0),)
    assert not encoded("vsr", relations=one, false_relations=one).instance_observed.any()
    found = encoded("vsr", relations=(), false_relations=((1, "under", 0), (2, "right", 0)))
    assert off(found) == {(ON_TOP, 0, 1), (LEFT, 0, 2)}
    assert not found.instance_holds.any()
    # Without listed relations, a relation can be denied too.
    assert off(encoded("robot", false_relations=((1, "on-top", 0),))) == {(ON_TOP, 1, 0)}


def test_3dssg_shows_all_supports_of_some_objects_and_sides_of_related_pairs() -> None:
    found = encoded("3dssg", relations=((1, "on-top", 0), (2, "left", 0)), supported=(1,))
    for relation in (ON_TOP, INSIDE):
        assert np.argwhere(found.instance_observed[relation]).tolist() == [[0, 1], [1, 0], [1, 2]]
    related = np.array([[0, 1, 1], [1, 0, 0], [1, 0, 0]], dtype=bool)
    assert (found.instance_observed[LATERAL] == related).all()
    assert np.argwhere(found.instance_observed[ABOVE]).tolist() == [[0, 1], [1, 0]]


def test_a_listed_support_excludes_all_other_supports() -> None:
    """A monitor is attached to a wall, and the desk stands on the floor."""
    vocabulary = Vocabulary([*VOCABULARY.objects, ObjectClass("floor", structure=True)])
    lists = {"relations": ((0, "on-top", 3), (2, "on-top", 0)), "supported": (0, 1, 2)}
    objects = things("desk", "monitor", "pencil", "floor")
    found = encode_objects(objects, vocabulary, source="3dssg", **lists)
    assert found.instance_stands.tolist() == [FLOOR, HANGS, SUPPORTED, UNKNOWN]
    assert (found.instance_observed[[*SUPPORTS], :3, :3] == ~np.eye(3, dtype=bool)).all()
    assert np.argwhere(found.instance_holds).tolist() == [[ON_TOP, 2, 0]]


PHRASES = [
    ("3dssg", "standing on", "on-top", True),
    ("3dssg", "hanging in", "inside", True),
    ("3dssg", "attached to", None, True),
    ("3dssg", "left", "left", False),
    ("vrd", "in", "inside", False),
    ("vrd", "next to", None, False),
    ("procthor", "contains", "contains", False),
    ("virtualhome", "close", None, False),
]


@pytest.mark.parametrize(("source", "phrase", "relation", "is_support"), PHRASES)
def test_phrases_of_a_source(source, phrase, relation, is_support):
    listed = [(4, phrase, 0), (4, phrase, 4), (4, phrase, 0)]
    assert relations_of(source, listed) == (((4, relation, 0),) if relation else ())
    assert supported_subjects(source, listed) == ((4,) if is_support else ())


KITCHEN = Vocabulary([ObjectClass("fridge"), ObjectClass("milk"), ObjectClass("jar")])
FRIDGE, MILK, JAR = range(3)
# One jar is on the fridge in words, and one in it.
ROLES = RoleCounts(
    np.array([MILK * 3 + FRIDGE, JAR * 3 + FRIDGE]),
    np.array([[0, 0, 9], [5, 0, 5]], dtype=np.float32),
    np.zeros((3, 3), dtype=np.float32),
)


@pytest.mark.parametrize(
    ("label", "bottom", "roles", "relation"),
    [
        ("milk", 1.8, ROLES, ON_TOP),
        ("milk", 1.78, ROLES, ON_TOP),
        ("jar", 1.8, ROLES, ON_TOP),
        ("milk", 0.6, ROLES, INSIDE),
        ("jar", 0.6, ROLES, None),
        ("milk", 0.6, None, ON_TOP),
    ],
)
def test_a_link_means_on_top_in_contact_and_else_the_role_of_the_classes(
    label: str, bottom: float, roles: RoleCounts | None, relation: int | None
) -> None:
    """A link says that a fridge of 1.8 m supports an object at a height in metres."""
    fridge = AnnotatedObject("f", "fridge", (0.0, 0.0, 0.9), (0.8, 0.8, 1.8))
    milk = AnnotatedObject("t", label, (0.0, 0.0, bottom + 0.1), (0.1, 0.1, 0.2), supported_by="f")
    fields = {"source": "procthor", "viewer_frame": True}
    found = encode_objects((fridge, milk), KITCHEN, roles, **fields)
    stated = [] if relation is None else [[relation, 1, 0]]
    assert np.argwhere(found.instance_holds).tolist() == stated
    assert found.instance_observed[:, 0, 1].all()
    assert found.instance_observed[[LEFT, FRONT, ABOVE], 1, 0].all()
    assert (found.instance_observed[[*SUPPORTS], 1, 0] == (relation is not None)).all()
    assert found.instance_stands.tolist() == [FLOOR, SUPPORTED]


def annotated(found: EncodedScene) -> dict[int, set[tuple[int, int]]]:
    mask = annotated_relations(found)
    pairs = {a: {(int(i), int(j)) for i, j in np.argwhere(mask[a])} for a in range(len(mask))}
    return {a: every for a, every in pairs.items() if every}


ALL = {(i, j) for i in range(3) for j in range(3) if i != j}
STACK = {(0, 1), (1, 0)}


@pytest.mark.parametrize(
    ("source", "pairs"),
    [
        # The pencil is beside the monitor, which stands on the desk.
        ("nr3d", {LEFT: STACK, FRONT: STACK}),
        ("vrd", {LEFT: STACK, FRONT: STACK}),
        ("virtualhome", {LEFT: STACK, FRONT: STACK, ON_TOP: ALL, INSIDE: ALL}),
        ("3dssg", {LEFT: STACK, FRONT: STACK, ON_TOP: STACK | {(1, 2)}, INSIDE: STACK | {(1, 2)}}),
        ("robot", dict.fromkeys((LEFT, FRONT, ON_TOP, ABOVE, INSIDE), ALL)),
    ],
)
def test_only_sources_that_show_false_relations_annotate_them(source, pairs):
    listed = ((1, "on-top", 0), (2, "left", 1))
    assert annotated(encoded(source, relations=listed, supported=(1,))) == pairs


def test_boxes_annotate_sides_of_all_pairs_and_no_above() -> None:
    """The pencil is nine metres away, and one more desk has no position."""
    objects = (
        AnnotatedObject("0", "desk", (0.0, 0.0, 0.4), (0.8, 0.8, 0.8)),
        AnnotatedObject("1", "monitor", (0.0, 0.0, 1.0), (0.4, 0.4, 0.4)),
        AnnotatedObject("2", "pencil", (9.0, 0.0, 0.4), (0.1, 0.1, 0.1)),
        AnnotatedObject("3", "desk"),
    )
    found = encoded("procthor", *objects)
    assert found.instance_holds[ON_TOP, 1, 0]
    assert annotated(found) == dict.fromkeys((LEFT, FRONT, ON_TOP, INSIDE), ALL)
    # A camera frame shows only neighbours.
    assert annotated(encoded("sunrgbd_bedrooms_3d", *objects[:3])) == {}


def in_a_row(size: tuple[float, float, float] | None) -> tuple[AnnotatedObject, ...]:
    places = (("desk", 0.0), ("monitor", 0.5), ("pencil", 9.0))
    return tuple(AnnotatedObject(label, label, (x, 0.0, 0.5), size) for label, x in places)


@pytest.mark.parametrize("source", ["procthor", "rooms", "robot"])
def test_boxes_far_apart_are_not_stacked(source: str) -> None:
    objects = in_a_row(CUBE)
    observed = encoded(source, *objects, AnnotatedObject("d", "pencil")).instance_observed
    located = np.array([1, 1, 1, 0], dtype=bool)
    assert (observed[VERTICAL] == (located[:, None] & located & ~np.eye(4, dtype=bool))).all()
    assert np.argwhere(observed[LEFT]).tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize("source", ["sunrgbd_bedrooms_3d", "sunrgbd-bedroom-3d"])
def test_centres_show_only_left_and_front(source: str) -> None:
    found = encoded(source, *in_a_row(None))
    assert (found.instance_observed[LATERAL] == ~np.eye(3, dtype=bool)).all()
    assert not found.instance_observed[VERTICAL].any()
    assert np.argwhere(found.instance_holds).tolist() == [[FRONT, 0, 1]]


def test_an_unlisted_class_of_a_coarse_source_is_unobserved() -> None:
    labels = ("table", "coffee table", "lamp")
    vocabulary = Vocabulary([ObjectClass(label) for label in labels])
    objects = things(*labels[:2])
    scenes = [AnnotatedScene("s", source, "g", None, objects) for source in ("sunrgbd", "3dssg")]
    found = encode(scenes, vocabulary)
    assert [scene.evidence.classes.tolist() for scene in found] == [[0, 1]] * 2
    annotated = annotated_classes(found, vocabulary)
    assert annotated["sunrgbd"].tolist() == [True, False, True]
    assert annotated["3dssg"].tolist() == [True, True, False]
    # Without a class of its own, a coffee table is a table, which the source does annotate.
    tables = Vocabulary([ObjectClass("table", ("coffee table",))])
    assert annotated_classes(encode(scenes, tables), tables)["sunrgbd"].tolist() == [True]


def test_a_floor_plan_counts_as_a_few_scenes() -> None:
    objects = things("desk", "pencil", count=[4, 1])
    scenes = [AnnotatedScene(f"s{k}", "alfred", f"g{k // 6}", None, objects) for k in range(8)]
    scenes += [AnnotatedScene(f"v{k}", "bddl_goal", "g", None, objects, ()) for k in range(5)]
    found = encode(scenes, VOCABULARY)
    assert [scene.weight for scene in found] == [0.5] * 6 + [1.0] * 2 + [1.0] * 5
    assert found[0].evidence.counts.tolist() == [4, 1]
    assert found[0].instance_classes.tolist() == [0, 2]
    tensors = scene_tensors(found, annotated_classes(found, VOCABULARY), VOCABULARY)
    assert tensors.source_names == ("alfred", "bddl_goal")
    batch = tensors.batch(torch.tensor([12, 0]))
    assert batch.source.tolist() == [1, 0]
    assert batch.counts.tolist() == [[4, 1], [4, 1]]
    assert batch.rows(torch.tensor([False, True])).source.tolist() == [0]
    assert tensors.weight[[12, 0]].tolist() == [1.0, 0.5]
    assert tensors.complete[[12, 0]].tolist() == [False, True]


def test_a_photograph_of_several_sources_counts_as_one_scene() -> None:
    objects = things("desk", "pencil")
    sources = ("coco_captions", "coco_labels", "vsr", "vsr")
    scenes = [
        AnnotatedScene(f"{k}", source, "coco-1", None, objects) for k, source in enumerate(sources)
    ]
    scenes.append(AnnotatedScene("other", "coco_labels", "coco-2", None, objects))
    assert [scene.weight for scene in encode(scenes, VOCABULARY)] == [0.25] * 4 + [1.0]
