"""Baseline of T3c: a frequency table of supporters, p(supporter class | class).

The supporter of an object is the object that it stands on or in. Objects without supporter have the
supporter "nothing": they stand on the floor or hang on a wall. The supporter is unknown in two
cases: boxes leave it undecided, or a scene without poses states no support of the object.

    suspicion of an object of class i with supporter s = γ log p(s) - log p(s | i)
    p(s | i) = (n(i, s) + α p(s)) / (n(i) + α)

n(i, s) is the number of objects of class i with supporter s, n(i) their sum over s, and p(s) the
share of s among all supporters. With several supporters, the least suspicion counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.special import expit
from torch import Tensor

from app.scene import Scene, observe
from app.scene.relations import SUPPORTS
from app.scene.stands import FLOOR, HANGS, Heights, stands_of
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.batches import SceneTensors
from training.datasets.moved import has_boxes, posed_scene
from training.datasets.sources import meaning_of
from training.evaluation.baselines.fitting import Proposals
from training.evaluation.model import MisplacedScore

_ALPHA: Final = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
_GAMMA: Final = (0.0, 0.25, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class SupporterTable:
    """The suspicion (V, V + 1) of class i with supporter s; the last column is "nothing".

    Structure, (V,), is neither object nor supporter.
    """

    suspicion: Floats
    structure: Flags

    def __call__(self, scene: Scene) -> list[dict[str, Any]]:
        """Return an entry for each object with a known supporter, the most suspicious first."""
        things = scene.objects
        classes = np.array([-1 if t.class_index is None else t.class_index for t in things])
        entries = [
            {
                "subject": things[i].id,
                "moved": things[i].id,
                "probability": float(expit(self.suspicion[classes[i], supporters].min())),
            }
            for i, supporters in _supporters(classes, *_evidence(scene), self.structure)
        ]
        return sorted(entries, key=lambda entry: -entry["probability"])


def _evidence(scene: Scene) -> tuple[Flags, Flags]:
    """Return which objects support an object (n, n), and which objects have no supporter (n,)."""
    n = len(scene.objects)
    observed_scene = observe(scene)
    poses = observed_scene.poses
    if poses is None:
        supports = np.zeros((n, n), dtype=np.bool_)
        for a, i, j in scene.relations or ():
            supports[i, j] |= a in SUPPORTS
        return supports, np.zeros(n, dtype=np.bool_)
    supports = np.any(poses.holds[[*SUPPORTS]], axis=0)
    unknown = (np.nan,) * 3
    centres = np.array([thing.position or unknown for thing in scene.objects])
    heights = Heights.of(centres, np.array([thing.size or unknown for thing in scene.objects]))
    floor = float(np.fmin.reduce(heights.bottoms))
    stands = stands_of(poses.holds, poses.observed, heights, floor)
    return supports, np.isin(stands, (FLOOR, HANGS))


def _annotated(encoded: EncodedScene) -> tuple[Flags, Flags]:
    """Return the values of `_evidence` for a training scene."""
    if has_boxes(encoded):
        return _evidence(posed_scene(encoded))
    holds = encoded.instance_holds
    supports: Flags = np.any(holds[[a for a in SUPPORTS if a < len(holds)]], axis=0)
    is_complete = meaning_of(encoded.source).on_top == "off" and encoded.instance_observed.any()
    is_apart = np.isin(encoded.instance_stands, (FLOOR, HANGS))
    return supports, ~np.any(supports, axis=1) & (is_apart | is_complete)


def _supporters(
    classes: Ints, supports: Flags, unsupported: Flags, structure: Flags
) -> Iterator[tuple[int, Ints]]:
    """Yield the objects with a known supporter, and their distinct supporters as columns."""
    is_thing = (classes >= 0) & ~structure[classes]
    for i in np.flatnonzero(is_thing).tolist():
        of_object = np.unique(classes[supports[i] & is_thing])
        if len(of_object):
            yield i, of_object
        elif unsupported[i] or supports[i].any():
            yield i, np.array([len(structure)])


def supporter_table(
    train: SceneTensors, structure: Tensor, _seed: int
) -> Proposals[MisplacedScore]:
    """Yield a score for each smoothing α and weight γ. Relations are needed, else ValueError."""
    if not any(encoded.evidence.observed.any() for encoded in train.scenes):
        raise ValueError(f"the {len(train)} training scenes contain no observed relation")
    is_structure: Flags = structure.numpy()
    V = len(is_structure)
    count = np.zeros((V, V + 1))
    for encoded in train.scenes:
        classes = encoded.instance_classes
        for i, supporters in _supporters(classes, *_annotated(encoded), is_structure):
            count[classes[i], supporters] += encoded.weight
    prior = (count.sum(0) + 0.5) / (count.sum() + 0.5 * (V + 1))
    for alpha in _ALPHA:
        p = (count + alpha * prior) / (count.sum(1, keepdims=True) + alpha)
        for gamma in _GAMMA:
            suspicion = gamma * np.log(prior) - np.log(p)
            yield {"alpha": alpha, "gamma": gamma}, SupporterTable(suspicion, is_structure)
