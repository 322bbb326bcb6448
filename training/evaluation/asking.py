"""Query a score function or a trained model with test scenes, and return the answers as arrays.

Some cases are queried a second time in another order. If an answer changes with the order, the
score uses information outside the scene, and the evaluation stops. This check does not detect
memorised scenes. Splits by group keep near-duplicates of test scenes out of training.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app import questions
from app.inference.elementary import log_softmax
from app.model import SceneModel, Sensitivity
from app.questions.doubt import believed, room_odds
from app.questions.misplaced import wrong_relations
from app.questions.posterior import Posterior, calibrated_missing
from app.scene import CANONICAL, OPPOSITES, RelationTable, Scene, SceneObject, canonicalise, observe
from app.scene.relation_table import Triple
from training.datasets import EncodedScene
from training.datasets.batches import Batch
from training.datasets.cases import scene_of
from training.evaluation.generation_task import machine_scenes
from training.evaluation.parts import of_classes
from training.evaluation.setting import Model, Places
from training.machines import machine_of

Case = TypeVar("Case")

SENSITIVITIES: tuple[Sensitivity, ...] = get_args(Sensitivity)
"""Sensitivities of the outlier alarm; "medium" is the default."""

_PROBED_CASES, _PROBED_ROWS = 32, 64
_LEAST_P = np.finfo(np.float64).tiny
_LEAK = "the answer for a scene depends on the order of the queries: the score leaks information"


class LeakError(ValueError):
    """A score uses information that is not part of the question."""


def ask_every(ask: Callable[[Case], NDArray[Any]], cases: Sequence[Case]) -> list[NDArray[Any]]:
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
def ask_rows(
    score: Callable[..., Tensor], *columns: Tensor, block: int = 256
) -> Float[Tensor, N * scores]:
    """Return the scores of N cases, computed in blocks of the rows of each column.

    Raises:
        LeakError: a case gets another score when it is queried in another block.
    """
    count = len(columns[0])
    if not count:
        return torch.zeros_like(columns[0])
    blocks = torch.arange(count).split(block)
    scores = torch.cat([score(*(column[index] for column in columns)) for index in blocks])
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
    encoded: EncodedScene, structure: Bool[NDArray, " V"], hidden: Collection[int] = ()
) -> list[int]:
    """Return the instances without structure, such as walls, and without hidden classes."""
    classes = encoded.instance_classes
    return np.flatnonzero(~structure[classes] & ~np.isin(classes, list(hidden))).tolist()


def instances_of(
    classes: Int[Tensor, " n"], counts: Float[Tensor, " n"] | Int[Tensor, " n"]
) -> tuple[Scene, Int[Tensor, " n"]]:
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
    """Return (canonical relation, subject, object) of an answer, with `index_of_ids` as index."""
    return canonicalise(index[entry["subject"]], entry["relation"], index[entry["object"]])


def missing_log_p(artifact: SceneModel, scene: Scene) -> Float[NDArray, " V"]:
    """Return the log-probability of `/missing` that each class is missing; else -inf.

    All classes are candidates, so a class has a value beside a likelier one of its family.
    """
    posterior, vocabulary = believed(artifact, scene), artifact.vocabulary
    listed, calibration = posterior.present.classes, artifact.calibration
    raw = posterior.absent_log_odds(np.arange(len(vocabulary)), calibration.coverage)
    log_odds = calibrated_missing(calibration, raw.astype(np.float64), posterior.listed, None)
    log_p = -np.logaddexp(0.0, -log_odds)
    log_p[vocabulary.structure | vocabulary.broader[listed].any(0)] = -np.inf
    log_p[listed] = -np.inf
    return log_p


def missing_log_p_at(
    artifact: SceneModel, scene: Scene, relation: str, anchor: int
) -> Float[NDArray, " V"]:
    """Return log p of `/missing` for each class with the relation to object `anchor`; else -inf."""
    vocabulary, place = artifact.vocabulary, (relation, anchor)
    every = range(len(vocabulary))
    answer = questions.missing(
        artifact, scene, top_k=len(every), candidates=every, at=place, details=False
    )
    log_p = np.full(len(every), -np.inf)
    for entry in answer["missing"]:
        log_p[vocabulary.index(entry["label"])] = np.log(max(entry["probability"], _LEAST_P))
    return log_p


def judge(
    artifact: SceneModel, scene: Scene, sensitivity: Sensitivity = "medium"
) -> Float[NDArray, "objects 2"]:
    """Return the probability of `/outliers` for each object, and 1 if it reports the object."""
    columns = np.zeros((len(scene.objects), 2))
    index = index_of_ids(scene)
    answer = questions.outliers(artifact, scene, sensitivity=sensitivity, details=False)
    for entry in answer["outliers"]:
        columns[index[entry["object"]]] = entry["probability"], entry["is_outlier"]
    return columns


def score_missing(
    artifact: SceneModel, v: Float[Tensor, "B V"], room: Int[Tensor, " B"] | None = None
) -> Float[Tensor, "B V"]:
    """Return the log-probabilities of `/missing` for lists, with the room types or without any."""
    types = [None] * len(v) if room is None else room.tolist()
    scenes = (replace(s, room_type=t) for s, t in zip(_scenes(v), types, strict=True))
    return torch.from_numpy(np.stack([missing_log_p(artifact, scene) for scene in scenes]))


def score_rooms(
    artifact: SceneModel, profiles: Sequence[str], v: Float[Tensor, "B V"], profile: str
) -> Float[Tensor, "B C"]:
    """Return log p of `/rooms` for lists. The requests name the profile if the model has it."""
    index = profiles.index(profile) if profile in profiles else None
    log_p = np.zeros((len(v), artifact.spec.C))
    for row, scene in zip(log_p, _scenes(v), strict=True):
        posterior, of_types, _ = room_odds(artifact, replace(scene, profile=index))
        sharpness = artifact.calibration.rooms.of(posterior.listed)  # exponent of p
        row[:] = log_softmax(sharpness * of_types)
    return torch.from_numpy(log_p)


def score_suspicion(artifact: SceneModel, v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
    """Return the probabilities of `/outliers` for lists; -inf for unlisted classes."""
    values = torch.full(v.shape, -torch.inf, dtype=torch.float64)
    for row, scene in enumerate(_scenes(v)):
        values[row, v[row] > 0] = torch.from_numpy(judge(artifact, scene)[:, 0])
    return values


def flag_outliers(
    artifact: SceneModel, v: Float[Tensor, "B V"], sensitivity: Sensitivity
) -> Bool[Tensor, "B V"]:
    """Return the listed classes that `/outliers` reports as outliers."""
    flags = torch.zeros(v.shape, dtype=torch.bool)
    for row, scene in enumerate(_scenes(v)):
        # Column 1 of each class, in ascending order, is 1 if it is an outlier.
        flags[row, v[row] > 0] = torch.from_numpy(judge(artifact, scene, sensitivity)[:, 1] > 0)
    return flags


def _scenes(v: Float[Tensor, "B V"]) -> Iterator[Scene]:
    return (of_classes(row.nonzero().squeeze(1).tolist()) for row in v)


def score_misplaced(artifact: SceneModel, scene: Scene) -> list[dict[str, Any]]:
    """Return the misplaced relations of a scene; poses are read as in viewer axes."""
    sizes, spread, roles = artifact.vocabulary.sizes, artifact.spread, artifact.roles
    observed = observe(scene, typical_sizes=sizes, spread=spread, roles=roles)
    return questions.misplaced(artifact, observed)


def relation_probabilities(
    artifact: SceneModel, scene: Scene, pairs: Sequence[tuple[int, int]] | None = None
) -> Float[NDArray, "A objects objects"]:
    """Return the probability of each canonical relation; 0 outside `pairs` of object indices."""
    n = len(scene.objects)
    p = np.zeros((len(CANONICAL), n, n))
    answer = questions.relations(artifact, scene, top_k=max(1, p.size), pairs=pairs)
    index = index_of_ids(scene)
    for entry in answer["relations"]:
        p[canonical_triple(index, entry)] = entry["probability"]
    return p


def artifact_model(artifact: SceneModel, *, profiles: Sequence[str] = ()) -> Model:
    """Return the answers of a trained model. Requests about rooms may name the `profiles`."""
    judges_relations = artifact.calibration.misplaced.judges_relations
    return Model(
        missing=partial(score_missing, artifact),
        suspicion=partial(score_suspicion, artifact),
        flags=partial(flag_outliers, artifact),
        at_place=partial(score_placed, artifact),
        relations=partial(score_relations, artifact, given=False),
        completion=partial(score_relations, artifact, given=True),
        false_relations=partial(score_false_relations, artifact),
        misplaced=partial(score_misplaced, artifact) if judges_relations else None,
        rooms=partial(score_rooms, artifact, profiles) if artifact.spec.C else None,
        generate=partial(machine_scenes, artifact),
        parameters=machine_of(artifact.weights).parameter_count,
        scene_model=artifact,
    )


def score_relations(artifact: SceneModel, batch: Batch, *, given: bool) -> Float[Tensor, "B A n n"]:
    """Return the log-odds of each relation between two present classes.

    With `given`, the other observed relations that hold are evidence, never the relation itself.
    """
    log_odds = torch.full(batch.holds.shape, -torch.inf)
    for row, (scene, _) in enumerate(_scenes_of(batch, given)):
        values = Posterior(artifact, scene).relation_log_odds()
        a, n, _ = values.shape
        log_odds[row, :a, :n, :n] = torch.from_numpy(values)
    return log_odds


def score_false_relations(artifact: SceneModel, batch: Batch) -> Float[Tensor, "B A n n"]:
    """Return the log-odds by which `/outliers` ranks observed relations; other relations: -inf."""
    log_odds = torch.full(batch.holds.shape, -torch.inf)
    for row, (scene, triples) in enumerate(_scenes_of(batch)):
        wrong = wrong_relations(artifact, scene)
        for triple, of_instances in triples.items():
            log_odds[(row, *triple)] = -wrong.get(of_instances, 0.0)
    return log_odds


def _scenes_of(batch: Batch, given: bool = True) -> Iterator[tuple[Scene, dict[Triple, Triple]]]:
    """Generate the scenes of a batch, and a map from relations of classes to those of instances.

    With `given`, a scene has the observed relations that hold. a(x, y) and a(y, x) can both hold
    between classes, but for different instances.
    """
    evidence = batch.holds * batch.observed * given
    for classes, counts, holds in zip(batch.classes, batch.counts, evidence, strict=True):
        is_class = classes >= 0
        counts = counts[is_class]
        scene, first = instances_of(classes[is_class], counts)
        observed = set(map(tuple, holds.nonzero().tolist()))
        last = first + counts.clamp(min=1) - 1
        triples: dict[Triple, Triple] = {}
        for a, x, y in sorted(observed):
            index = last if (a, y, x) in observed and x > y else first
            triples[a, x, y] = (a, int(index[x]), int(index[y]))
        table = RelationTable.stated(triples.values()) if triples else None
        yield Scene(scene.objects, table), triples


def score_placed(artifact: SceneModel, places: Places) -> Float[Tensor, "B V"]:
    """Return the log-probability of `/missing` for each class at B places; else -inf."""
    log_p = torch.empty_like(places.v)
    for row, v in enumerate(places.v):
        classes = v.nonzero().squeeze(1)
        scene, first = instances_of(classes, places.counts[row, classes])
        if places.relation[row] >= artifact.spec.A:
            # A model without this relation cannot use the place.
            log_p[row] = torch.from_numpy(missing_log_p(artifact, scene))
            continue
        relation = CANONICAL[int(places.relation[row])]
        # The request names the relation from the missing object to the anchor.
        name = relation if places.outgoing[row] else OPPOSITES[relation]
        anchor = int(first[classes == places.anchor[row]])
        log_p[row] = torch.from_numpy(missing_log_p_at(artifact, scene, name, anchor))
    return log_p
