"""Relations that a person has confirmed, although the model reports them as misplaced.

The new model never reports a confirmed relation of two classes (`app.model.Misplaced.confirmed`).
The relation also counts like `_SCENES` training scenes in the places of the model
(`app.model.Places`), so the place becomes a usual one for missing objects.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from app.model import SceneModel
from app.questions.misplaced import THE_FLOOR
from app.scene import Vocabulary
from app.scene.spatial_relations import STACKED
from training.datasets import AnnotatedScene, encode
from training.datasets.cases import scene_of
from training.datasets.moved import has_boxes, posed_scene
from training.evaluation.asking import canonical_triple, index_of_ids, score_misplaced

_SCENES: Final = 20.0

Triple = tuple[int, int, int]


def reported_relations(model: SceneModel, recorded: Sequence[AnnotatedScene]) -> set[Triple]:
    """Return the stacked relations (a, i, j) of classes that the model reports in confirmed scenes.

    The model judges each scene as stated and with its boxes, which also show where objects stand.
    """
    if model.places is None:
        return set()
    reported: set[Triple] = set()
    confirmed = [scene for scene in recorded if scene.confirmed]
    words = [_canonical(scene, model.vocabulary) for scene in confirmed]
    for encoded in encode(words, model.vocabulary, model.places.roles):
        holds = encoded.instance_holds
        triples = [(a, i, j) for a in STACKED for i, j in np.argwhere(holds[a]).tolist()]
        scenes = [scene_of(encoded, range(len(encoded.instance_classes)), triples)]
        if has_boxes(encoded):
            scenes.append(posed_scene(encoded))
        for scene in scenes if triples else ():
            index = index_of_ids(scene)
            for entry in score_misplaced(model, scene):
                if entry["is_misplaced"] and entry["object"] != THE_FLOOR:
                    a, i, j = canonical_triple(index, entry)
                    subject, other = encoded.instance_classes[[i, j]].tolist()
                    reported |= {(a, subject, other)} if a in STACKED else set()
    return reported


def _canonical(scene: AnnotatedScene, vocabulary: Vocabulary) -> AnnotatedScene:
    """Return the scene with the label of the class in place of each name of it."""
    matches = (vocabulary.look_up(thing.label) for thing in scene.objects)
    objects = tuple(
        thing if match is None else replace(thing, label=vocabulary.labels[match.entry])
        for thing, match in zip(scene.objects, matches, strict=True)
    )
    return replace(scene, objects=objects)


def with_confirmed(artifact: SceneModel, triples: Iterable[Triple]) -> SceneModel:
    """Return the model, which never reports these relations of classes."""
    places, V, triples = artifact.places, len(artifact.vocabulary), sorted(triples)
    if places is None:
        return artifact
    misplaced = artifact.calibration.misplaced.model_copy(update={"confirmed": tuple(triples)})
    calibration = artifact.calibration.model_copy(update={"misplaced": misplaced})
    new = np.array([(a * V + i) * V + j for a, i, j in triples], places.triple.dtype)
    keys, index = np.unique(np.concatenate([places.triple, new]), return_inverse=True)
    scenes = np.bincount(index, np.concatenate([places.triple_scenes, np.full(len(new), _SCENES)]))
    places = replace(places, triple=keys, triple_scenes=scenes.astype(places.triple_scenes.dtype))
    return replace(artifact, places=places, calibration=calibration)
