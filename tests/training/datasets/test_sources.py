from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from app.scene import ObjectClass, Vocabulary
from app.scene.relations import ABOVE, FRONT, INSIDE, LEFT, ON_TOP
from training.datasets import (
    AnnotatedObject,
    AnnotatedScene,
    EncodedScene,
    annotated_classes,
    encode,
)
from training.datasets.batches import scene_tensors
from training.datasets.sources import SOURCES, meaning_of, relation_of

VOCABULARY = Vocabulary([ObjectClass("desk"), ObjectClass("monitor"), ObjectClass("pencil")])
LATERAL, VERTICAL = [LEFT, FRONT], [ON_TOP, ABOVE]
CUBE = (0.2, 0.2, 0.2)


def encoded(source: str, *objects: AnnotatedObject, **fields: Any) -> EncodedScene:
    things = objects or tuple(AnnotatedObject(x, x) for x in ("desk", "monitor", "pencil"))
    scene = AnnotatedScene("s", source, "g", None, things, viewer_frame=True, **fields)
    (found,) = encode([scene], VOCABULARY)
    return found


def off(found: EncodedScene) -> set[tuple[int, int, int]]:
    known = found.instance_observed & ~found.instance_holds
    return {(int(a), int(i), int(j)) for a, i, j in np.argwhere(known)}


@pytest.mark.parametrize("source", ["vrd", "nr3d", "coco_captions", "alfred", "bddl_goal"])
def test_people_mention_few_of_the_relations_that_hold(source: str) -> None:
    found = encoded(source, relations=((1, "on-top", 0), (2, "left", 1)))
    assert np.argwhere(found.instance_holds).tolist() == [[LEFT, 2, 1], [ON_TOP, 1, 0]]
    beside = {(LEFT, 0, 1), (LEFT, 1, 0), (FRONT, 0, 1), (FRONT, 1, 0)}
    stacked = {(ON_TOP, 0, 1), (ABOVE, 0, 1), (ABOVE, 1, 0), (INSIDE, 0, 1), (INSIDE, 1, 0)}
    assert off(found) == stacked | beside


def test_an_object_on_a_support_may_also_be_listed_beside_it() -> None:
    found = encoded("nr3d", relations=((1, "on-top", 0), (1, "left", 0)))
    assert found.instance_holds[[ON_TOP, LEFT], 1, 0].all()
    assert (LEFT, 0, 1) in off(found)


def test_two_listed_vertical_relations_of_one_pair_both_hold() -> None:
    found = encoded("nr3d", relations=((1, "on-top", 0), (1, "above", 0)))
    assert found.instance_holds[VERTICAL, 1, 0].all()
    assert off(found) >= {(ON_TOP, 0, 1), (ABOVE, 0, 1)}
    assert not {(a, i, j) for a, i, j in off(found) if a in VERTICAL and (i, j) == (1, 0)}


def test_denied_relations_are_off_and_listed_ones_of_them_unobserved() -> None:
    one = ((1, "on-top", 0),)
    assert not encoded("vsr", relations=one, false_relations=one).instance_observed.any()
    found = encoded("vsr", relations=(), false_relations=((1, "under", 0), (2, "right", 0)))
    assert off(found) == {(ON_TOP, 0, 1), (LEFT, 0, 2)}
    assert not found.instance_holds.any()
    # Nobody listed relations, somebody denied one.
    assert off(encoded("robot", false_relations=((1, "on-top", 0),))) == {(ON_TOP, 1, 0)}


def test_3dssg_annotates_all_supports_of_some_objects_and_sides_of_related_pairs() -> None:
    listed = ((1, "on-top", 0), (2, "left", 0))
    found = encoded("3dssg", relations=listed, supported=(1,))
    for relation in (ON_TOP, INSIDE):
        known = np.argwhere(found.instance_observed[relation]).tolist()
        assert known == [[0, 1], [1, 0], [1, 2]]
    related = np.array([[0, 1, 1], [1, 0, 0], [1, 0, 0]], dtype=bool)
    assert (found.instance_observed[LATERAL] == related).all()
    assert np.argwhere(found.instance_observed[ABOVE]).tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize("source", ["procthor", "rooms", "robot"])
def test_boxes_far_apart_are_not_stacked(source: str) -> None:
    objects = tuple(
        AnnotatedObject(str(x), label, position=(x, 0.0, 0.5), size=CUBE)
        for label, x in (("desk", 0.0), ("monitor", 0.5), ("pencil", 9.0))
    )
    observed = encoded(source, *objects, AnnotatedObject("d", "pencil")).instance_observed
    located = np.array([1, 1, 1, 0], dtype=bool)
    assert (observed[VERTICAL] == (located[:, None] & located & ~np.eye(4, dtype=bool))).all()
    assert np.argwhere(observed[LEFT]).tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize("source", ["sunrgbd_bedrooms_3d", "sunrgbd-bedroom-3d"])
def test_centres_tell_left_and_front_alone(source: str) -> None:
    objects = tuple(
        AnnotatedObject(str(x), label, position=(x, 0.0, 0.5))
        for label, x in (("desk", 0.0), ("monitor", 0.5), ("pencil", 9.0))
    )
    found = encoded(source, *objects)
    assert (found.instance_observed[LATERAL] == ~np.eye(3, dtype=bool)).all()
    assert not found.instance_observed[VERTICAL].any()
    assert np.argwhere(found.instance_holds).tolist() == [[FRONT, 0, 1]]


def test_virtualhome_lists_all_supports_and_no_sides() -> None:
    found = encoded("virtualhome", relations=((1, "on-top", 0),))
    pairs = ~np.eye(3, dtype=bool)
    assert np.argwhere(found.instance_holds).tolist() == [[ON_TOP, 1, 0]]
    assert (found.instance_observed[ON_TOP] == pairs).all()
    assert np.argwhere(found.instance_observed[LEFT]).tolist() == [[0, 1], [1, 0]]
    assert (found.instance_observed[INSIDE] == pairs).all()
    assert relation_of("virtualhome", "close") is None


def test_an_unlisted_class_of_a_coarse_source_is_unobserved() -> None:
    labels = ("table", "coffee table", "lamp")
    vocabulary = Vocabulary([ObjectClass(label) for label in labels])
    things = tuple(AnnotatedObject(label, label) for label in labels[:2])
    scenes = [AnnotatedScene("s", source, "g", None, things) for source in ("sunrgbd", "3dssg")]
    found = encode(scenes, vocabulary)
    assert [scene.evidence.classes.tolist() for scene in found] == [[0, 1]] * 2
    annotated = annotated_classes(found, vocabulary)
    assert annotated["sunrgbd"].tolist() == [True, False, True]
    assert annotated["3dssg"].tolist() == [True, True, False]
    # Without a class of its own, a coffee table is a table, which the source does annotate.
    tables = Vocabulary([ObjectClass("table", ("coffee table",))])
    assert annotated_classes(encode(scenes, tables), tables)["sunrgbd"].tolist() == [True]


def test_a_floor_plan_counts_as_a_few_scenes() -> None:
    things = (AnnotatedObject("0", "desk", count=4), AnnotatedObject("1", "pencil"))
    scenes = [AnnotatedScene(f"s{k}", "alfred", f"g{k // 6}", None, things) for k in range(8)]
    scenes += [AnnotatedScene(f"v{k}", "vsr", "g", None, things, ()) for k in range(5)]
    found = encode(scenes, VOCABULARY)
    assert [scene.weight for scene in found] == [0.5] * 6 + [1.0] * 2 + [1.0] * 5
    assert found[0].evidence.counts.tolist() == [4, 1]
    assert found[0].instance_classes.tolist() == [0, 2]
    tensors = scene_tensors(found, annotated_classes(found, VOCABULARY), len(VOCABULARY))
    assert tensors.source_names == ("alfred", "vsr")
    batch = tensors.batch(torch.tensor([12, 0]))
    assert batch.source.tolist() == [1, 0]
    assert batch.counts.tolist() == [[4, 1], [4, 1]]
    assert batch.rows(torch.tensor([False, True])).source.tolist() == [0]
    assert tensors.weight[[12, 0]].tolist() == [1.0, 0.5]
    assert tensors.complete[[12, 0]].tolist() == [False, True]


def test_sources_of_mentions_have_incomplete_object_lists() -> None:
    incomplete = {name for name in SOURCES if not meaning_of(name).complete_objects}
    mentions = {"vrd", "nr3d", "coco_captions", "reverie_text", "vsr", "bddl_goal"}
    assert incomplete == mentions | {"placing_priors"}
