from dataclasses import replace

import numpy as np
import torch

from app.scene import ObjectClass, Vocabulary
from app.scene.spatial_relations import INSIDE, LEFT, ON_TOP
from tests.training.scenes import scene
from training.datasets import annotated_classes, encode
from training.datasets.batches import scene_tensors
from training.datasets.cases import scene_of
from training.datasets.moved import posed_scene
from training.evaluation.selection import named_moved
from training.research.baselines import BASELINES
from training.research.baselines.count_models import supporter_score, supporter_table

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


def bare(number, relations=((1, "on-top", 0),)):
    listed = scene(f"bare {number}", "table", "cup", "bed", relations=relations)
    return replace(listed, source="virtualhome")


def posed(number):
    positions, sizes = zip(*BOXES.values(), strict=True)
    whole = scene(f"posed {number}", *BOXES, position=positions, size=sizes)
    return replace(whole, source="procthor", viewer_frame=True)


def tensors(*scenes):
    encoded = encode(scenes, VOCABULARY)
    return scene_tensors(encoded, annotated_classes(encoded, VOCABULARY), VOCABULARY)


SUSPICION = np.full((4, 5), 9.0)
SUSPICION[CUP, [TABLE, BED, NOTHING]] = 1.0, 2.0, 3.0
SUSPICION[[TABLE, BED], NOTHING] = 0.0, -1.0


def judged(asked):
    entries = supporter_score(SUSPICION, VOCABULARY.structure)(asked)
    assert all(entry["moved"] == entry["subject"] for entry in entries)
    logit = [np.log(p / (1 - p)) for p in (entry["probability"] for entry in entries)]
    assert logit == sorted(logit, reverse=True)
    return {entry["moved"]: round(z, 6) for entry, z in zip(entries, logit, strict=True)}


def test_objects_are_judged_by_their_supporters():
    """A support of structure is the floor, which is nothing."""
    (whole,) = encode([posed(0)], VOCABULARY)
    assert judged(posed_scene(whole)) == {"1": 1.0, "0": 0.0, "2": -1.0}
    # On two objects, the less suspicious counts. The supporters of the others are not stated.
    (listed,) = encode([bare(0)], VOCABULARY)
    assert judged(scene_of(listed, range(3), [(ON_TOP, 1, 0), (INSIDE, 1, 2)])) == {"1": 1.0}
    assert judged(scene_of(listed, range(3), [(LEFT, 1, 0)])) == {}


def test_supporters_are_counted():
    """Of six cups, five are on a table and one is on a bed."""
    scenes = tensors(*map(bare, range(3)), bare(3, relations=((1, "inside", 2),)), posed(5))
    scores = [score for _, score in supporter_table(scenes, STRUCTURE, 0)]
    assert len(scores) == 24
    (listed,) = encode([bare(0)], VOCABULARY)
    for score in scores:
        usual, unusual = (
            score(scene_of(listed, range(3), [(ON_TOP, 1, other)]))[0]["probability"]
            for other in (0, 2)
        )
        assert usual < unusual


def test_the_fitted_table_names_moved_objects():
    baseline = BASELINES["frequency table of supporters"]
    train, validation = tensors(*map(posed, range(20))), tensors(*map(posed, range(20, 50)))
    model = baseline.fit(train, validation, STRUCTURE)
    assert named_moved(validation, STRUCTURE, model.misplaced) > 0.9
    # Only centres: no object can move.
    flat = tensors(bare(0, relations=((1, "left", 0),)))
    assert named_moved(flat, STRUCTURE, model.misplaced) == 0
