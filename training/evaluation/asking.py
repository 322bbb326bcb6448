"""Questions put to `app.questions` as a robot puts them, the answers as columns.

A sample of the cases is asked once more in another order: an answer that follows the order of the
questions knows more than its scene, and the evaluation stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from app import questions
from app.questions import Sensitivity
from app.registry import Artifact
from app.scene import CANONICAL, Scene, SceneObject
from training.cases import scene_of
from training.datasets import EncodedScene
from training.evaluation.missing import LeakError

Floats = NDArray[np.float64]
Case = TypeVar("Case")

_PROBED = 32

SENSITIVITIES: tuple[Sensitivity, ...] = get_args(Sensitivity)
"""Presets of the alarm; "medium" is the default."""


def ask_every(ask: Callable[[Case], Floats], cases: Sequence[Case]) -> list[Floats]:
    """The answers to all cases, in their order.

    Raises:
        LeakError: a case that is asked again, in another order, has another answer.
        FloatingPointError: an answer is nan.
    """
    answers = [ask(case) for case in cases]
    if any(np.isnan(answer).any() for answer in answers):
        raise FloatingPointError("an answer is not a number")
    for k in np.random.default_rng(0).permutation(len(cases))[:_PROBED].tolist():
        again = ask(cases[k])
        if not np.allclose(again, answers[k], rtol=1e-3, atol=1e-9):
            raise LeakError("the same scene in another order gets other answers: something leaks")
    return answers


def labels_alone(encoded: EncodedScene, kept: Sequence[int] | None = None) -> Scene:
    """The instances at the given positions, all by default; no relation, pose or room type."""
    places = range(len(encoded.instance_classes)) if kept is None else kept
    return replace(scene_of(encoded, places, ()), room_type=None)


def of_classes(classes: Sequence[int]) -> Scene:
    """One object of each entry."""
    return Scene(tuple(SceneObject(str(k), str(c), c) for k, c in enumerate(classes)))


def things(scene: Scene, structure: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) bool of its objects: those that are no structure."""
    classes = [-1 if thing.class_index is None else thing.class_index for thing in scene.objects]
    found: NDArray[np.bool_] = ~structure[classes]
    return found


def missing_probabilities(
    artifact: Artifact,
    scene: Scene,
    coverage: float | None = None,
    at: tuple[str, int] | None = None,
) -> Floats:
    """Probability of every class that `/missing` may propose, (V,); -inf for the others.

    Args:
        coverage: as the question has it; the model's default for None.
        at: a relation and the object that it leads to, of the place that is asked about.
    """
    vocabulary = artifact.vocabulary
    found = np.full(len(vocabulary), -np.inf)
    for answer in questions.missing(
        artifact, scene, top_k=len(vocabulary), coverage=coverage, at=at, details=False
    ):
        found[vocabulary.index(answer.label)] = answer.probability
    return found


@dataclass(frozen=True, eq=False)
class Verdict:
    """What `/outliers` says of the n objects of a scene, by their position.

    Attributes:
        probability, log_odds: (n,); is_outlier: (n,) bool.
    """

    probability: Floats
    log_odds: Floats
    is_outlier: NDArray[np.bool_]


def judge(artifact: Artifact, scene: Scene, sensitivity: Sensitivity = "medium") -> Verdict:
    """Every object of a scene at one of `SENSITIVITIES`."""
    found = questions.outliers(artifact, scene, sensitivity=sensitivity, details=False).outliers
    n = len(scene.objects)
    probability, log_odds, flagged = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.bool_)
    for answer in found:
        probability[answer.object] = answer.probability
        log_odds[answer.object] = answer.log_odds
        flagged[answer.object] = answer.is_outlier
    return Verdict(probability, log_odds, flagged)


def relation_probabilities(
    artifact: Artifact, scene: Scene, pairs: Sequence[tuple[int, int]] | None = None
) -> Floats:
    """Probabilities (A, n, n) of the canonical relations between n objects; 0 if not answered.

    Args:
        pairs: the ordered pairs of positions that are asked; all by default.
    """
    n = len(scene.objects)
    found = np.zeros((len(CANONICAL), n, n))
    most = max(1, len(CANONICAL) * n * n)
    for answer in questions.relations(artifact, scene, top_k=most, pairs=pairs)[0]:
        found[CANONICAL.index(answer.relation), answer.subject, answer.object] = answer.probability
    return found
