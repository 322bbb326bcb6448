"""Query a score function or `app.questions` with test scenes, and return the answers as arrays.

Some cases are queried a second time in another order. If an answer changes with the order, the
score uses information outside the scene, and the evaluation stops. This check does not detect
memorised scenes. Splits by group keep near-duplicates of test scenes out of training.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from app import questions
from app.model import SceneModel, Sensitivity
from app.scene import CANONICAL, Scene, SceneObject, canonicalise, observe
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats
from training.datasets.cases import scene_of

Case = TypeVar("Case")

SENSITIVITIES: tuple[Sensitivity, ...] = get_args(Sensitivity)
"""Sensitivities of the outlier alarm; "medium" is the default."""

_PROBED_CASES, _PROBED_ROWS = 32, 64
_LEAK = "the answer for a scene depends on the order of the queries: the score leaks information"


class LeakError(ValueError):
    """A score uses information that is not part of the question."""


def ask_every(ask: Callable[[Case], Floats], cases: Sequence[Case]) -> list[Floats]:
    """Return the answers to all cases, in the order of the cases.

    Raises:
        LeakError: a case gets another answer when the cases are queried in another order.
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
    """Return the scores (N, ...) of N cases, computed in blocks of the rows of each column.

    Raises:
        LeakError: a case gets another score when it is queried in another block.
    """
    count = len(columns[0])
    blocks = [
        score(*(column[index] for column in columns))
        for index in torch.arange(count).split(block)
        if len(index)
    ]
    if not blocks:
        return torch.zeros_like(columns[0])
    scores = torch.cat(blocks)
    probed = torch.from_numpy(np.random.default_rng(0).permutation(count)[:_PROBED_ROWS])
    again = score(*(column[probed] for column in columns))
    if not torch.allclose(again, scores[probed], rtol=1e-3, atol=1e-3, equal_nan=True):
        raise LeakError(_LEAK)
    return scores


def labels_alone(encoded: EncodedScene, kept: Sequence[int] | None = None) -> Scene:
    """Return a scene of labels, without relations and poses, of the instances in `kept` or all."""
    instances = range(len(encoded.instance_classes)) if kept is None else kept
    return replace(scene_of(encoded, instances, ()), room_type=None)


def thing_instances(
    encoded: EncodedScene, structure: Flags, hidden: Collection[int] = ()
) -> list[int]:
    """Return the instances without structure, such as walls, and without hidden classes."""
    classes = encoded.instance_classes
    is_kept = ~structure[classes] & ~np.isin(classes, list(hidden))
    return np.flatnonzero(is_kept).tolist()


def of_classes(classes: Sequence[int]) -> Scene:
    """Return a scene with one object for each entry of `classes`."""
    return Scene(tuple(SceneObject(str(k), str(c), c) for k, c in enumerate(classes)))


def instances_of(classes: Tensor, counts: Tensor) -> tuple[Scene, Tensor]:
    """Return a scene with `counts` objects of each class, and the first object index per class."""
    copies = counts.clamp(min=1).long()
    return of_classes(classes.repeat_interleave(copies).tolist()), copies.cumsum(0) - copies


def with_intruder(artifact: SceneModel, scene: Scene, intruder: int) -> Scene:
    """Return the scene with one more object, of the class `intruder`."""
    thing = SceneObject("intruder", artifact.vocabulary.labels[intruder], intruder)
    return replace(scene, objects=(*scene.objects, thing))


def index_of_ids(scene: Scene) -> dict[str, int]:
    """Return the index of each object of a scene by its id."""
    return {thing.id: index for index, thing in enumerate(scene.objects)}


def canonical_triple(index: Mapping[str, int], entry: Mapping[str, Any]) -> tuple[int, int, int]:
    """Return (canonical relation, subject, object) of a relation in an answer about a scene.

    `index`: see `index_of_ids`.
    """
    return canonicalise(index[entry["subject"]], entry["relation"], index[entry["object"]])


def missing_probabilities(
    artifact: SceneModel, scene: Scene, at: tuple[str, int] | None = None
) -> Floats:
    """Return the probability that each class is missing, (V,).

    The value is -inf for classes that `/missing` cannot propose. All classes are candidates, so a
    class has a value beside a likelier one of its family.

    Args:
        at: place of the missing object: its relation to the object with an index.
    """
    p = np.full(len(artifact.vocabulary), -np.inf)
    every = range(len(p))
    answer = questions.missing(
        artifact, scene, top_k=len(p), candidates=every, at=at, details=False
    )
    for entry in answer["missing"]:
        p[artifact.vocabulary.index(entry["label"])] = entry["probability"]
    return p


def judge(artifact: SceneModel, scene: Scene, sensitivity: Sensitivity = "medium") -> Floats:
    """Return the answers of `/outliers` about the n objects of a scene, (n, 2).

    The columns are the probability that the object is an outlier, and 1 if the service reports the
    object as an outlier.
    """
    columns = np.zeros((len(scene.objects), 2))
    index = index_of_ids(scene)
    answer = questions.outliers(artifact, scene, sensitivity=sensitivity, details=False)
    for entry in answer["outliers"]:
        columns[index[entry["object"]]] = entry["probability"], entry["is_outlier"]
    return columns


def log_of(p: Floats) -> Tensor:
    """Return the log of probabilities; a finite value for 0 and for -inf."""
    return torch.from_numpy(np.log(np.maximum(p, np.finfo(np.float64).tiny)))


def score_missing(artifact: SceneModel, v: Tensor, room: Tensor | None = None) -> Tensor:
    """Return the log-probabilities of `/missing`, (B, V), for lists v (B, V).

    `room` (B,) are the room types to state. None states no room type.
    """
    types = [None] * len(v) if room is None else room.tolist()
    scenes = (replace(s, room_type=t) for s, t in zip(_scenes(v), types, strict=True))
    return log_of(np.stack([missing_probabilities(artifact, scene) for scene in scenes]))


def score_rooms(artifact: SceneModel, profiles: Sequence[str], v: Tensor, profile: str) -> Tensor:
    """Return the log-probabilities of `/rooms`, (B, room types), for lists v (B, V).

    The requests name the profile if it is one of the `profiles` of the model.
    """
    names = artifact.vocabulary.room_types
    index = profiles.index(profile) if profile in profiles else None
    p = np.zeros((len(v), artifact.spec.C))
    for row, scene in zip(p, _scenes(v), strict=True):
        scene = replace(scene, profile=index)
        answer = questions.rooms(artifact, scene, top_k=len(row), details=False)
        for entry in answer["room_types"]:
            row[names.index(entry["room_type"])] = entry["probability"]
    return log_of(p)


def score_suspicion(artifact: SceneModel, v: Tensor) -> Tensor:
    """Return the probabilities of `/outliers`, or -inf, (B, V), for lists v (B, V)."""
    return _judged(artifact, v, 0, "medium", -torch.inf)


def flag_outliers(artifact: SceneModel, v: Tensor, sensitivity: Sensitivity) -> Tensor:
    """Return the reported outliers, (B, V) bool, for lists v (B, V)."""
    return _judged(artifact, v, 1, sensitivity, 0.0) > 0


def _judged(
    artifact: SceneModel, v: Tensor, column: int, sensitivity: Sensitivity, unlisted: float
) -> Tensor:
    values = torch.full(v.shape, unlisted, dtype=torch.float64)
    for row, scene in enumerate(_scenes(v)):
        answers = judge(artifact, scene, sensitivity)[:, column]
        values[row, v[row] > 0] = torch.from_numpy(answers)
    return values


def _scenes(v: Tensor) -> Iterator[Scene]:
    return (of_classes(row.nonzero().squeeze(1).tolist()) for row in v)


def score_misplaced(artifact: SceneModel, scene: Scene) -> list[dict[str, Any]]:
    """Return the misplaced relations of a scene.

    Relations of scenes with poses follow from the poses, as in a request in viewer axes.
    """
    roles = None if artifact.places is None else artifact.places.roles
    observed = observe(scene, typical_sizes=artifact.vocabulary.sizes, roles=roles)
    return questions.misplaced(artifact, observed)


def relation_probabilities(
    artifact: SceneModel, scene: Scene, pairs: Sequence[tuple[int, int]] | None = None
) -> Floats:
    """Return the probability of each canonical relation, (relations, objects, objects).

    The value is 0 outside `pairs`, ordered pairs of object indices. None means all pairs.
    """
    n = len(scene.objects)
    p = np.zeros((len(CANONICAL), n, n))
    answer = questions.relations(artifact, scene, top_k=max(1, p.size), pairs=pairs)
    index = index_of_ids(scene)
    for entry in answer["relations"]:
        p[canonical_triple(index, entry)] = entry["probability"]
    return p
