"""Alarms of `/outliers` in untouched parts of scenes, against the promise of each sensitivity.

A part lists two to twelve random classes without structure, and their relations. Each alarm in it
is false. A model is refused only if its share of parts with an alarm is certainly too large: the
exact 95 % lower bound must exceed `EXCESS` times the promise.

Source: Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case of
the binomial" (1934).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray
from scipy.special import betaincinv

from app import questions
from app.model import SceneModel, Sensitivity
from app.scene import Scene
from training.datasets import EncodedScene
from training.datasets.array_types import Rng
from training.datasets.cases import draw_true_relations, scene_of
from training.evaluation.asking import thing_instances
from training.evaluation.parts import LONGEST

ALARMS: dict[Sensitivity, float] = {"low": 0.02, "medium": 0.1, "high": 0.2}
"""Promised maximum share of parts with an alarm about an object, and about a relation."""

EXCESS = 1.5

_GROUPS = 30  # minimum number of groups of a source with its own count of alarms


@dataclass(frozen=True)
class Alarms:
    """Number of scenes of a source, one of each group, and of those with an alarm."""

    source: str
    about: str  # "objects" or "relations"
    sensitivity: Sensitivity
    scenes: int
    alarms: int

    @property
    def at_least(self) -> float:
        """Exact 95 % lower bound of the share of scenes with an alarm."""
        if self.alarms == 0:
            return 0.0
        return float(betaincinv(self.alarms, self.scenes - self.alarms + 1, 0.05))

    def objection(self) -> str | None:
        """Return the reason against the model, or None if the share may agree with the promise."""
        promise = ALARMS[self.sensitivity]
        if self.at_least <= EXCESS * promise:
            return None
        return (
            f"/outliers raises alarms about {self.about} in {self.alarms} of {self.scenes} "
            f"untouched scenes of {self.source} at {self.sensitivity} sensitivity, which promises "
            f"at most {promise:.0%}. Check the labels and relations, or provide more scenes"
        )


def untouched_alarms(artifact: SceneModel, scenes: Sequence[EncodedScene]) -> Iterator[Alarms]:
    """Count the scenes with an alarm about an untouched part, one random scene of each group.

    Objects count only if the object list is complete. Sources of few groups count together.
    """
    rng = np.random.default_rng(0)
    scene_of_group: dict[tuple[str, str], EncodedScene] = {}
    for k in rng.permutation(len(scenes)).tolist():
        scene_of_group.setdefault((scenes[k].source, scenes[k].group), scenes[k])
    groups = Counter(source for source, _ in scene_of_group)
    cases: dict[str, list[tuple[Scene, bool]]] = {}
    for scene in scene_of_group.values():
        listed = _random_part(scene, artifact.vocabulary.structure, rng)
        is_small = len(groups) > 1 and groups[scene.source] < _GROUPS
        source = "the smaller sources" if is_small else scene.source
        cases.setdefault(source, []).append((listed, scene.complete))
    for source, sensitivity in product(sorted(cases), ALARMS):
        alarms = [_alarms(artifact, *case, sensitivity) for case in cases[source]]
        for about, flags in zip(("objects", "relations"), zip(*alarms, strict=True), strict=True):
            yield Alarms(source, about, sensitivity, len(flags), sum(flags))


def _random_part(encoded: EncodedScene, structure: Bool[NDArray, " V"], rng: Rng) -> Scene:
    """Return the instances of two to `LONGEST` random classes, with their relations."""
    classes = encoded.evidence.classes
    order = rng.permutation(classes[~structure[classes]])
    hidden = order[rng.integers(2, min(LONGEST, max(len(order), 2)) + 1) :]
    kept = thing_instances(encoded, structure, hidden)
    index_of = {instance: index for index, instance in enumerate(kept)}
    triples = [
        (a, index_of[i], index_of[j])
        for a, i, j in draw_true_relations(encoded, structure, rng) or ()
        if i in index_of and j in index_of
    ]
    return replace(scene_of(encoded, kept, triples), room_type=None)


def _alarms(
    artifact: SceneModel, scene: Scene, complete: bool, sensitivity: Sensitivity
) -> tuple[bool, bool]:
    """Return whether the model raises an alarm about an object, and about a relation."""
    answer = questions.outliers(artifact, scene, sensitivity=sensitivity, details=False)
    of_objects = complete and any(entry["is_outlier"] for entry in answer["outliers"])
    return of_objects, any(entry["is_misplaced"] for entry in answer["misplaced"])
