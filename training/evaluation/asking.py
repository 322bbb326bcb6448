"""Query a score or `app.questions` with requests like those of a robot, and return arrays.

Some cases are queried a second time in another order. If an answer changes with the order, the
score uses information outside the scene, and the evaluation stops. This check does not detect
memorised scenes. Splits by group keep near-duplicates of test scenes out of training.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app import questions
from app.questions import Sensitivity
from app.registry import Artifact
from app.scene import CANONICAL, Scene, SceneObject
from training.cases import scene_of
from training.datasets import EncodedScene

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Case = TypeVar("Case")

SENSITIVITIES: tuple[Sensitivity, ...] = get_args(Sensitivity)
"""Sensitivities of the outlier alarm; "medium" is the default."""

_PROBED_CASES, _PROBED_ROWS = 32, 64
_LEAK = "the answer for a scene depends on the order of the queries: the score leaks information"


class LeakError(ValueError):
    """A score uses information that is not part of the question."""


def ask_every(ask: Callable[[Case], Floats], cases: Sequence[Case]) -> list[Floats]:
    """Return the answers to all cases in order.

    Raises:
        LeakError: a second query of a case in another order gives another answer.
        FloatingPointError: an answer is NaN.
    """
    answers = [ask(case) for case in cases]
    if any(np.isnan(answer).any() for answer in answers):
        raise FloatingPointError("the score of a case is NaN")
    for k in np.random.default_rng(0).permutation(len(cases))[:_PROBED_CASES].tolist():
        if not np.allclose(ask(cases[k]), answers[k], rtol=1e-3, atol=1e-9):
            raise LeakError(_LEAK)
    return answers


@torch.no_grad()
def ask_rows(score: Callable[..., Tensor], *columns: Tensor, block: int = 256) -> Tensor:
    """Return the scores (N, ...) of N rows, computed in blocks.

    Args:
        score: function of the rows of each column.
        columns: tensors (N, ...).

    Raises:
        LeakError: a second query of some rows, in another block, gives other scores.
    """
    count = len(columns[0])
    blocks = [
        score(*(column[index] for column in columns))
        for index in torch.arange(count).split(block)
        if len(index)
    ]
    if not blocks:
        return torch.zeros_like(columns[0])
    found = torch.cat(blocks)
    probed = torch.from_numpy(np.random.default_rng(0).permutation(count)[:_PROBED_ROWS])
    again = score(*(column[probed] for column in columns))
    if not torch.allclose(again, found[probed], rtol=1e-3, atol=1e-3, equal_nan=True):
        raise LeakError(_LEAK)
    return found


def labels_alone(encoded: EncodedScene, kept: Sequence[int] | None = None) -> Scene:
    """Return a scene of the instances at the indices `kept` (default: all), with labels only."""
    places = range(len(encoded.instance_classes)) if kept is None else kept
    return replace(scene_of(encoded, places, ()), room_type=None)


def of_classes(classes: Sequence[int]) -> Scene:
    """Return a scene with one object for each entry of `classes`."""
    return Scene(tuple(SceneObject(str(k), str(c), c) for k, c in enumerate(classes)))


def with_intruder(artifact: Artifact, scene: Scene, intruder: int) -> Scene:
    """Return the scene with one more object, of an absent class."""
    thing = SceneObject("intruder", artifact.vocabulary.labels[intruder], intruder)
    return replace(scene, objects=(*scene.objects, thing))


def things(scene: Scene, structure: Flags) -> Flags:
    """Return a mask (n,) of the objects that are not structure."""
    classes = [-1 if thing.class_index is None else thing.class_index for thing in scene.objects]
    found: Flags = ~structure[classes]
    return found


def missing_probabilities(
    artifact: Artifact,
    scene: Scene,
    coverage: float | None = None,
    at: tuple[str, int] | None = None,
) -> Floats:
    """Return the probability of every class that `/missing` may propose, (V,); -inf elsewhere.

    Args:
        coverage: coverage of the request; None means the default of the model.
        at: the place in question: a relation and the index of its anchor object.
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
    """Answers of `/outliers` about the n objects of a scene, in the order of the objects.

    Attributes:
        probability, log_odds: (n,).
        is_outlier: (n,) bool.
    """

    probability: Floats
    log_odds: Floats
    is_outlier: Flags


def judge(artifact: Artifact, scene: Scene, sensitivity: Sensitivity = "medium") -> Verdict:
    """Query `/outliers` for a scene at one of `SENSITIVITIES`."""
    n = len(scene.objects)
    probability, log_odds, flagged = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.bool_)
    found = questions.outliers(artifact, scene, sensitivity=sensitivity, details=False).outliers
    for answer in found:
        probability[answer.object] = answer.probability
        log_odds[answer.object] = answer.log_odds
        flagged[answer.object] = answer.is_outlier
    return Verdict(probability, log_odds, flagged)


def relation_probabilities(
    artifact: Artifact, scene: Scene, pairs: Sequence[tuple[int, int]] | None = None
) -> Floats:
    """Return probabilities (A, n, n) of the canonical relations of n objects; 0 if not answered.

    Args:
        pairs: ordered pairs of object indices to query; all pairs by default.
    """
    n = len(scene.objects)
    found = np.zeros((len(CANONICAL), n, n))
    most = max(1, len(CANONICAL) * n * n)
    for answer in questions.relations(artifact, scene, top_k=most, pairs=pairs)[0]:
        found[CANONICAL.index(answer.relation), answer.subject, answer.object] = answer.probability
    return found
