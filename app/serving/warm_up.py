"""Warm-up: ask a model one real question of each kind before it serves requests."""

from __future__ import annotations

import math
from dataclasses import replace

from app import questions
from app.questions.ranking import significant
from app.registry import Artifact
from app.scene.observe import observe
from app.scene.scene import Scene, SceneObject
from app.scene.vocabulary import Vocabulary

STEPS = 1
"""Gibbs sweeps per generated scene; one sweep is enough to compile the kernels."""


def warm_up(artifact: Artifact) -> None:
    """Ask all questions once, with observed relations, without them, and with poses.

    The first call of a kernel compiles it.

    Raises:
        ValueError: an answer is not finite.
        Exception: any exception of the model.
    """
    scene = _scene(artifact.vocabulary)
    bare = replace(scene, relations=None)
    seen = observe(bare, typical_sizes=artifact.vocabulary.sizes)
    scenes = scene, bare, seen
    stand = [questions.relations(artifact, one) for one in scenes]
    missing = [entry for one in scenes for entry in questions.missing(artifact, one)]
    if len(scene.objects) > 1:
        questions.missing(artifact, bare, at=("on-top", 0))
        questions.missing(artifact, scene, at=("under", 0))
    # With threshold 0 every object is an outlier, so its explanation is computed as well.
    _, outliers, misplaced = questions.outliers(artifact, scene, threshold=0.0)
    for one in scenes[1:]:
        outliers += questions.outliers(artifact, one).outliers
    generated = questions.generate(artifact, scene, count=2, seed=0, steps=STEPS)
    numbers = [entry.probability for both in stand for found in both for entry in found]
    numbers += [number for entry in missing for number in (entry.probability, entry.log_odds)]
    numbers += [cause.log_odds_change for entry in missing for cause in entry.because]
    numbers += [number for entry in outliers for number in (entry.probability, entry.log_odds)]
    numbers += [entry.probability for entry in misplaced]
    numbers += [entry.log_score for entry in generated]
    if not all(map(math.isfinite, significant(numbers))):
        raise ValueError("an answer of the model is not finite")


def _scene(vocabulary: Vocabulary) -> Scene:
    """Return a scene of up to three classes in a row, with one observed relation."""
    proposable = [i for i, entry in enumerate(vocabulary.objects) if not entry.structure]
    objects = tuple(
        SceneObject(str(place), vocabulary.labels[index], index, position=(1.0, 0.5 * place, 0.5))
        for place, index in enumerate((proposable or [0])[:3])
    )
    return Scene(objects, ((2, 1, 0),) if len(objects) > 1 else None)
