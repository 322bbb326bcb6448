"""The table of supporters by hand: what is counted, and who is suspicious."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from app.scene import CANONICAL, ObjectClass, PoseRelations, Vocabulary
from app.scene.relations import INSIDE, LEFT, ON_TOP
from training.datasets import AnnotatedObject, AnnotatedScene, annotated_classes, encode
from training.datasets.batches import scene_tensors
from training.datasets.cases import scene_of
from training.datasets.moved import posed_scene
from training.evaluation.baselines.fitting import named_moved
from training.research.baselines import BASELINES
from training.research.baselines.supporters import SupporterTable, supporter_table

VOCABULARY = Vocabulary(
    [*map(ObjectClass, ("table", "cup", "bed")), ObjectClass("floor", structure=True)], []
)
TABLE, CUP, BED, FLOOR = range(4)
NOTHING = len(VOCABULARY)
STRUCTURE = torch.from_numpy(VOCABULARY.structure.copy())
BOXES = {
    "table": ((2.0, 0.0, 0.35), (1.0, 1.0, 0.7)),
    "cup": ((2.0, 0.0, 0.75), (0.1, 0.1, 0.1)),
    "bed": ((2.0, 4.0, 0.25), (2.0, 2.0, 0.5)),
    "floor": ((2.0, 2.0, -0.05), (8.0, 8.0, 0.1)),
}


def bare(number, source="virtualhome", relations=((1, "on-top", 0),)):
    things = tuple(AnnotatedObject(str(k), x) for k, x in enumerate(("table", "cup", "bed")))
    return AnnotatedScene(f"{source} {number}", source, f"g{number}", None, things, relations)


def posed(number, labels=tuple(BOXES)):
    things = tuple(
        AnnotatedObject(str(k), label, position=BOXES[label][0], size=BOXES[label][1])
        for k, label in enumerate(labels)
    )
    return AnnotatedScene(
        f"posed {number}", "procthor", f"p{number}", None, things, viewer_frame=True
    )


def tensors(*scenes):
    encoded = encode(scenes, VOCABULARY)
    return scene_tensors(encoded, annotated_classes(encoded, VOCABULARY), len(VOCABULARY))


def tables(*scenes):
    """The suspicion by (alpha, gamma)."""
    proposals = supporter_table(tensors(*scenes), STRUCTURE, 0)
    return {(p["alpha"], p["gamma"]): table.suspicion for p, table in proposals}


def test_supporters_are_counted():
    scenes = (
        *(bare(k) for k in range(3)),
        bare(3, relations=((1, "inside", 2),)),
        # Captions mention some supports only: tables and beds may stand on anything.
        bare(4, "coco_captions"),
        # A support of structure is the floor.
        posed(5),
    )
    count = np.zeros((4, 5))
    count[CUP, [TABLE, BED]] = 5, 1
    count[TABLE, NOTHING] = count[BED, NOTHING] = 5
    prior = (count.sum(0) + 0.5) / (count.sum() + 2.5)
    p = (count + 3 * prior) / (count.sum(1, keepdims=True) + 3)
    found = tables(*scenes)
    assert len(found) == 24
    assert found[3.0, 0.0] == pytest.approx(-np.log(p))
    assert found[3.0, 0.5] == pytest.approx(0.5 * np.log(prior) - np.log(p))


SUSPICION = np.full((4, 5), 9.0)
SUSPICION[CUP, [TABLE, BED, NOTHING]] = 1.0, 2.0, 3.0
SUSPICION[[TABLE, BED], NOTHING] = 0.0, -1.0
JUDGE = SupporterTable(SUSPICION, VOCABULARY.structure)


def judged(scene):
    """Suspicion by id, in the order of the entries."""
    entries = JUDGE(scene)
    assert all(entry["moved"] == entry["subject"] for entry in entries)
    logit = [np.log(p / (1 - p)) for p in (entry["probability"] for entry in entries)]
    assert logit == sorted(logit, reverse=True)
    return {entry["moved"]: round(z, 6) for entry, z in zip(entries, logit, strict=True)}


def test_objects_are_judged_by_their_supporters():
    (whole,) = encode([posed(0)], VOCABULARY)
    assert judged(posed_scene(whole)) == {"1": 1.0, "0": 0.0, "2": -1.0}
    # On two objects, the less suspicious counts. The supporters of the others are not stated.
    (listed,) = encode([bare(0)], VOCABULARY)
    assert judged(scene_of(listed, range(3), [(ON_TOP, 1, 0), (INSIDE, 1, 2)])) == {"1": 1.0}
    assert judged(scene_of(listed, range(3), [(LEFT, 1, 0)])) == {}


def test_an_undecided_supporter_is_unknown():
    """Boxes that reach into each other leave open whether the smaller is on top of the larger."""
    scene = posed_scene(encode([posed(0, ("table", "cup"))], VOCABULARY)[0])
    holds, observed = np.zeros((2, len(CANONICAL), 2, 2), dtype=np.bool_)
    observed[:] = ~np.eye(2, dtype=np.bool_)
    poses = PoseRelations(holds, observed)
    alone = replace(scene, relations=(), poses=poses)
    assert judged(alone) == {"1": 3.0, "0": 0.0}
    observed[ON_TOP, 1, 0] = False
    assert judged(alone) == {"0": 0.0}


def test_the_fitted_table_names_moved_objects():
    baseline = BASELINES["frequency table of supporters"]
    train, validation = tensors(*map(posed, range(20))), tensors(*map(posed, range(20, 50)))
    model = baseline.fit(train, validation, STRUCTURE)
    assert named_moved(validation, STRUCTURE, model.misplaced) > 0.9
    assert len(model.trials) == 24
    # Only centres: no object can move.
    flat = tensors(bare(0, relations=((1, "left", 0),)))
    assert named_moved(flat, STRUCTURE, model.misplaced) == 0
