"""T1 pairs: which relation holds between two classes, one of them on, under or in the other?

A question is a pair of different classes of a scene for which the scene lists a vertical relation
(on-top, under, above, below). The evidence is the labels of all objects of the scene, without
relations. The candidates are eight relations: the canonical relations without inside, in both
directions. A pair may have several listed relations; each of them is correct.

    accuracy   share of pairs whose most probable relation is listed (expectation over ties)
    log-loss   -log of the listed relations' share of the eight probabilities, in nats

A second set of questions are the pairs with a listed inside or contains, the inside pairs. Their
candidates are all ten relations. The metric is the accuracy.

Pairs with structure classes are excluded. Scenes without such a pair are skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray
from scipy.special import expit

from app.model import SceneModel
from app.scene.spatial_relations import INSIDE, LATERAL, VERTICAL
from training.datasets import EncodedScene
from training.datasets.batches import SceneTensors, seen_triples, subset
from training.evaluation.asking import ask_every, labels_alone, relation_probabilities
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.relation_tasks import with_observed
from training.evaluation.setting import Model, Outcome, RelationScore, Setting, Structure

RARE = 10  # A class is rare if training relates it to at most this many classes
SHIFTS = (0.0, -0.4, -0.8, -1.2)  # tested changes of the log-odds of left and front

_LEAST = 1e-9  # least share of the listed relations: the log-loss of a pair is at most 21 nats


@dataclass(frozen=True, eq=False)
class ScenePairs:
    """The questions about one scene."""

    scene_index: int
    scene: EncodedScene
    pairs: Int[NDArray, "P 2"]  # indices into the scene's classes, the smaller index first
    listed: Bool[NDArray, "P 2*A"]  # listed relations of the first to the second, then reversed


PairScore: TypeAlias = Callable[[ScenePairs], Float[NDArray, "P 2*A"]]
"""Function that returns the probabilities of the relations of the pairs of a scene."""


def listed_pairs(
    scenes: SceneTensors, structure: Structure, relations: Sequence[int] = VERTICAL
) -> list[ScenePairs]:
    """Return the pairs with one of these listed relations, for every scene that has such pairs."""
    questions = []
    for index, scene in enumerate(scenes.scenes):
        holds = scene.evidence.holds
        related = holds[[a for a in relations if a < len(holds)]].any(0)
        is_thing = ~structure.numpy()[scene.evidence.classes]
        is_pair = np.triu(related | related.T, 1) & is_thing[:, None] & is_thing
        if len(pairs := np.argwhere(is_pair)):
            questions.append(ScenePairs(index, scene, pairs, both_ways(holds, pairs)))
    return questions


def service_score(artifact: SceneModel) -> PairScore:
    """Return a score: probabilities of `/relations` between the first instances of both classes."""

    def score(question: ScenePairs) -> Float[NDArray, "P 2*A"]:
        scene, classes = question.scene, question.scene.evidence.classes
        first = np.array([np.flatnonzero(scene.instance_classes == c)[0] for c in classes])
        pairs = first[question.pairs]
        both = [tuple(pair) for pair in np.concatenate([pairs, pairs[:, ::-1]]).tolist()]
        return both_ways(relation_probabilities(artifact, labels_alone(scene), both), pairs)

    return score


def baseline_log_odds(scenes: SceneTensors, relations: RelationScore) -> PairScore:
    """Return a score: the log-odds of a relation score between the two classes of a pair."""

    @torch.no_grad()
    def score(question: ScenePairs) -> Float[NDArray, "P 2*A"]:
        batch = scenes.batch(torch.tensor([question.scene_index]))
        return both_ways(relations(with_observed(batch))[0].double().numpy(), question.pairs)

    return score


def lateral_shift(log_odds: PairScore, questions: Sequence[ScenePairs]) -> float:
    """Return the change of the log-odds of left and front for questions about stacked objects.

    It is the first one of `SHIFTS` with the highest accuracy of the likeliest relation, averaged
    over the data sources. Without questions, it is 0. The service and its rivals use the same
    rule: geometry finds left and front for most pairs, and annotators list them for few.
    """
    hits: dict[str, list[Float[NDArray, "P shifts"]]] = {}
    for question in questions:
        values = log_odds(question)
        rows = [accuracy(_shifted(values, shift), question.listed) for shift in SHIFTS]
        hits.setdefault(question.scene.source, []).append(np.stack(rows, 1))
    if not hits:
        return 0.0
    means = [np.concatenate(rows).mean(0) for rows in hits.values()]
    return SHIFTS[int(np.mean(means, axis=0).argmax())]


def _shifted(log_odds: Float[NDArray, "P 2*A"], shift: float) -> Float[NDArray, "P 2*A"]:
    """Add a shift to the columns of left and front."""
    relation = np.arange(log_odds.shape[1]) % (log_odds.shape[1] // 2)
    return log_odds + shift * np.isin(relation, LATERAL)


def both_ways(
    table: Shaped[NDArray, "A n n"], pairs: Int[NDArray, "P 2"]
) -> Shaped[NDArray, "P 2*A"]:
    """Return the entries of a table for pairs in both directions."""
    x, y = pairs.T
    return np.concatenate([table[:, x, y], table[:, y, x]]).T


def accuracy(p: Float[NDArray, "N k"], listed: Bool[NDArray, "N k"]) -> Float[NDArray, " N"]:
    """Return the share of listed relations among the most probable ones: 0 or 1 without ties."""
    is_best = p == p.max(1, keepdims=True)
    return (is_best & listed).sum(1) / is_best.sum(1)


def log_loss(p: Float[NDArray, "N k"], listed: Bool[NDArray, "N k"]) -> Float[NDArray, " N"]:
    """Return -log(L / T) in nats: sums of p over the listed relations L, and over all relations T.

    If T is 0, all relations count as equally probable.
    """
    total = p.sum(1)
    share = np.divide((p * listed).sum(1), total, where=total > 0, out=listed.mean(1))
    return -np.log(np.maximum(share, _LEAST))


def without_inside(columns: Shaped[NDArray, "P 2*A"]) -> Shaped[NDArray, "P 8"]:
    """Return the columns of the eight relations without inside and contains."""
    relation = np.arange(columns.shape[1]) % (columns.shape[1] // 2)
    return columns[:, relation != INSIDE]


def pairs_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure T1 pairs; the primary metric is the accuracy over all vertical pairs."""
    metrics: dict[str, Metric] = {}
    count = 0
    if answers := _ask(model, setting, VERTICAL):
        p, listed = without_inside(answers.p), without_inside(answers.listed)
        values = {"accuracy": accuracy(p, listed), "log-loss": log_loss(p, listed)}
        every = {"": np.ones(len(p), np.bool_)} | _hard_pairs(answers.classes, setting)
        for kind, mask in every.items():
            if mask.any():
                metrics |= {name + kind: answers.mean(x, mask) for name, x in values.items()}
        count = len(answers.scenes)
    if answers := _ask(model, setting, (INSIDE,)):
        hits = accuracy(answers.p, answers.listed)
        metrics["accuracy of ten, inside pairs"] = answers.mean(hits)
        count = max(count, len(answers.scenes))
    return Outcome(metrics, count, 0) if metrics else None


@dataclass(frozen=True, eq=False)
class _Answers:
    """The answers about N pairs: scene, classes, probabilities and listed relations."""

    scenes: SceneTensors
    scene: Int[NDArray, " N"]
    classes: Int[NDArray, "N 2"]
    p: Float[NDArray, "N 2*A"]
    listed: Bool[NDArray, "N 2*A"]

    def mean(
        self, values: Float[NDArray, " N"], mask: Bool[NDArray, " N"] | slice = slice(None)
    ) -> Ratio:
        """Return the mean of the values of pairs in `mask`, with one value for each group."""
        ratio = Ratio.of_items(self.scene[mask], values[mask], len(self.scenes))
        return ratio.by(self.scenes.group_ids)


def _ask(model: Model, setting: Setting, relations: Sequence[int]) -> _Answers | None:
    """Ask about the pairs with one of these listed relations, or return None without pairs."""
    pairs = listed_pairs(setting.scenes, setting.structure, relations)
    if not pairs:
        return None
    index = torch.tensor([question.scene_index for question in pairs])
    scenes = replace(setting, scenes=subset(setting.scenes, index)).some()
    questions = listed_pairs(scenes, setting.structure, relations)
    if model.scene_model is not None:
        score = service_score(model.scene_model)
    elif model.relations is not None:
        log_odds = baseline_log_odds(scenes, model.relations)
        score = lambda question: expit(_shifted(log_odds(question), model.lateral))  # noqa: E731
    else:
        return None
    return _Answers(
        scenes,
        np.repeat([q.scene_index for q in questions], [len(q.pairs) for q in questions]),
        np.concatenate([q.scene.evidence.classes[q.pairs] for q in questions]),
        np.concatenate(ask_every(score, questions)),
        np.concatenate([q.listed for q in questions]),
    )


def _hard_pairs(classes: Int[NDArray, "N 2"], setting: Setting) -> dict[str, Bool[NDArray, " N"]]:
    """Return masks of unseen pairs and of rare classes; empty without training scenes.

    "unseen pairs": training lists no relation of the two classes. "rare classes": training relates
    one of the two classes to at most `RARE` classes, in any source.
    """
    V, triples = setting.scenes.v.shape[1], setting.seen
    if triples is None:
        if setting.train is None:
            return {}
        triples = seen_triples(setting.train.scenes, V)
    related = np.unique(np.sort(triples.numpy()[:, 1:].astype(np.int64), axis=1), axis=0)
    partners = np.bincount(related.ravel(), minlength=V)
    key = np.array([V, 1])  # i V + j is the key of the classes i < j
    is_unseen = ~np.isin(classes @ key, related @ key)
    is_rare = np.any(partners[classes] <= RARE, axis=1)
    return {", unseen pairs": is_unseen, ", rare classes": is_rare}
