"""Baseline of T3c: a frequency table of supporters, p(supporter class | class).

The supporter of an object is the object that it stands on or in. In scenes with poses, an object
without supporter has the supporter "nothing". In other scenes, its supporter is unknown.

    suspicion of an object of class i with supporter s = γ log p(s) - log p(s | i)
    p(s | i) = (n(i, s) + α p(s)) / (n(i) + α)

n(i, s) is the number of objects of class i with supporter s, n(i) their sum over s, and p(s) the
share of s among all supporters. With several supporters, the least suspicion counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.special import expit

from app.scene import Scene, observe
from app.scene.spatial_relations import SUPPORTS
from training.datasets import EncodedScene
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_of
from training.datasets.moved import has_boxes, posed_scene
from training.evaluation.baselines.fitting import Proposals
from training.evaluation.model import MisplacedScore
from training.evaluation.setting import Structure

_ALPHA: Final = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
_GAMMA: Final = (0.0, 0.25, 0.5, 1.0)


def supporter_score(
    suspicion: Float[NDArray, "V V+1"],  # of class i with supporter s; the last s is "nothing"
    structure: Bool[NDArray, " V"],
) -> MisplacedScore:
    """Return a score with an entry for each object whose supporter is observed, likeliest first."""

    def score(scene: Scene) -> list[dict[str, Any]]:
        entries = [
            {"subject": name, "moved": name, "probability": float(expit(values.min()))}
            for index, object_class, supporters in _supporters(scene, structure)
            for name, values in [(scene.objects[index].id, suspicion[object_class, supporters])]
        ]
        return sorted(entries, key=lambda entry: -entry["probability"])

    return score


def _supporters(
    scene: Scene, structure: Bool[NDArray, " V"]
) -> Iterator[tuple[int, int, Int[NDArray, " supporters"]]]:
    """Yield each object whose supporter is observed, its class, and those of its supporters.

    Structure classes are neither object nor supporter.
    """
    observed = observe(scene)
    classes = np.array([-1 if x.class_index is None else x.class_index for x in scene.objects])
    is_thing = (classes >= 0) & ~structure[classes]
    supports = np.zeros((len(classes), len(classes)), dtype=np.bool_)
    for a, i, j in observed.triples:
        supports[i, j] |= a in SUPPORTS
    for i in np.flatnonzero(is_thing).tolist():
        of_object = np.unique(classes[supports[i] & is_thing])
        if len(of_object):
            yield i, int(classes[i]), of_object
        elif observed.has_boxes or supports[i].any():
            yield i, int(classes[i]), np.array([len(structure)])


def _annotated(encoded: EncodedScene) -> Scene:
    """Return a training scene with its poses, or with its annotated relations."""
    if has_boxes(encoded):
        return posed_scene(encoded)
    triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(encoded.instance_holds)]
    return scene_of(encoded, range(len(encoded.instance_classes)), triples)


def supporter_table(
    train: SceneTensors, structure: Structure, _seed: int
) -> Proposals[MisplacedScore]:
    """Yield a score for each smoothing α and weight γ. Relations are needed, else ValueError."""
    if not any(encoded.evidence.observed.any() for encoded in train.scenes):
        raise ValueError(f"the {len(train)} training scenes contain no observed relation")
    is_structure = structure.numpy()
    V = len(is_structure)
    count = np.zeros((V, V + 1))
    for encoded in train.scenes:
        for _, object_class, supporters in _supporters(_annotated(encoded), is_structure):
            count[object_class, supporters] += encoded.weight
    prior = (count.sum(0) + 0.5) / (count.sum() + 0.5 * (V + 1))
    for alpha in _ALPHA:
        p = (count + alpha * prior) / (count.sum(1, keepdims=True) + alpha)
        for gamma in _GAMMA:
            suspicion = gamma * np.log(prior) - np.log(p)
            yield {"alpha": alpha, "gamma": gamma}, supporter_score(suspicion, is_structure)
