"""From log-odds to the probabilities the service promises, fitted on validation scenes.

    missing    softmax(log-odds / T): the class that was taken away, given that exactly one was
    placed     softmax(log-odds / T + w·log p(relation to the anchor)): given where it stood as well
    outlier    the object is an intruder, where half of the scenes are clean
    relation   an annotator would list this relation for this pair of instances; fitted apart for
               scenes of which nothing is said, and for those of which half of the pairs are told
    placement  the same for a pair of which one was taken away
    misplaced  the relation is false, where one triple in half of the scenes was altered

Temperatures minimise the negative log-likelihood; the others are logistic regressions (Platt
scaling).

Sources: Platt, "Probabilistic outputs for support vector machines" (1999); Guo, Pleiss, Sun and
Weinberger, "On calibration of modern neural networks" (2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from sklearn.linear_model import LogisticRegression

from app.reasoning import misplaced
from app.reasoning.placements import PLACES
from app.reasoning.posterior import posterior
from app.reasoning.units import NO_UNIT
from app.registry import Artifact, Calibration, CountSlope, PairSlope, Slope
from app.scene import CANONICAL, Scene, SceneObject
from training.batches import SceneTensors
from training.datasets import EncodedScene
from training.evaluation.alarms import alarm_threshold, judged_scenes
from training.evaluation.missing import ObjectScore, machine_score, removed_objects
from training.evaluation.outliers import IntruderScores, intruder_scores
from training.trainer import subset

Triple: TypeAlias = tuple[int, int, int]

_SCENES = 1500
# An answer lists the best 20 relations by default.
_LISTED = 20
_OF_THE_REST = 0.02
_ROUNDS = 3
# Columns of an example, the scene first.
_RELATION, _LOGIT, _TRUTH = 1, 2, 5
# Cases a scene: with one of some 300 scenes, the weight moved by a third from draw to draw.
_PLACED_CASES = 2
_PLACEMENT_CASES = 4
_MISPLACED_SCENES = 300


def calibrate(artifact: Artifact, scenes: SceneTensors, seed: int = 0) -> Calibration:
    """Fit every entry of the calibration.

    Args:
        artifact: with the neutral calibration.
        scenes: validation scenes.
    """
    generator = torch.Generator().manual_seed(seed)
    pick = torch.randperm(len(scenes), generator=generator)
    sample = judged_scenes(scenes, seed)
    annotated = [k for k in pick.tolist() if scenes.scenes[k].evidence.holds.any()]
    related = subset(scenes, torch.tensor(annotated[:_SCENES], dtype=torch.int64))
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    score = machine_score(artifact.machine)
    outlier, threshold = fit_outlier(
        intruder_scores(sample, structure, score, seed=seed), sample, seed
    )
    calibration = Calibration.neutral(artifact.machine.spec.A).model_copy(
        update={
            "missing_temperature": fit_missing(sample, structure, score),
            "outlier": outlier,
            "outlier_threshold": threshold,
        }
    )
    if not len(related):
        return calibration
    temperature, weight = fit_placed(artifact, related.scenes, seed)
    return calibration.model_copy(
        update={
            "placed_temperature": temperature,
            "placed_relation_weight": weight,
            "relation": fit_relations(artifact, related.scenes),
            "placement": fit_placements(artifact, related.scenes, seed),
            "relation_given": fit_relations(artifact, related.scenes, np.random.default_rng(seed)),
            "misplaced": fit_misplaced(artifact, related.scenes[:_MISPLACED_SCENES], seed),
        }
    )


def fit_missing(scenes: SceneTensors, structure: torch.Tensor, score: ObjectScore) -> float:
    """The temperature of least negative log-likelihood of the removed class."""

    found_rows = list(removed_objects(scenes, structure, score))
    target = torch.cat([block[1] for block in found_rows]).unsqueeze(1)
    values = torch.cat([block[2] for block in found_rows])

    def nll(log_temperature: float) -> float:
        log_p = (values / float(np.exp(log_temperature))).log_softmax(1)
        return -float(log_p.gather(1, target).mean())

    found = minimize_scalar(nll, bounds=(-1.0, 1.5), method="bounded", options={"xatol": 0.02})
    return float(np.exp(found.x))


def fit_outlier(
    scores: IntruderScores, scenes: SceneTensors, seed: int = 0
) -> tuple[CountSlope, float]:
    """Logistic regression of "is the intruder", half of the scenes clean, and the alarm threshold.

    Args:
        scenes: those that were scored.
    """
    rng = np.random.default_rng(seed)
    clean_scene = rng.random(int(scores.scene.max()) + 1) < 0.5
    used = scores.clean == clean_scene[scores.scene]
    features = np.stack([scores.log_odds, np.log(scores.size)], 1)
    slope, size, intercept = _logistic(features[used], scores.intruder[used])
    entry = CountSlope(intercept=intercept, slope=slope, log_count=size)
    logits = intercept + features @ np.array([slope, size])
    return entry, _sigmoid(alarm_threshold(logits, scores, scenes, rng))


def fit_relations(
    artifact: Artifact, scenes: Sequence[EncodedScene], rng: np.random.Generator | None = None
) -> tuple[PairSlope, ...]:
    """Per canonical relation, from class-level log-odds to instance pairs.

    Args:
        rng: says which pairs of a scene are told about, and only the others are asked; without it
            nothing is given, and all are asked.
    """
    blocks: list[NDArray[np.float64]] = []
    for number, encoded in enumerate(scenes):
        asked = np.ones((len(encoded.instance_classes),) * 2, dtype=np.bool_)
        told: list[Triple] = []
        if rng is not None:
            asked, told = told_pairs(encoded, artifact.vocabulary.structure, rng)
            if not told:
                continue
        scene = replace(scene_of(encoded, range(len(asked)), told), room_type=None)
        values = posterior(artifact, scene).relation_log_odds()
        structure = artifact.vocabulary.structure
        blocks.append(_instance_pairs(number, encoded, values, structure, asked))
    return _fit_listed(blocks, artifact.machine.spec.A, _LISTED)


def fit_placements(
    artifact: Artifact, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[PairSlope, ...]:
    """The same for the relations of an object that was taken away to those that stayed."""
    rng = np.random.default_rng(seed)
    structure = artifact.vocabulary.structure
    blocks: list[NDArray[np.float64]] = []
    for number, encoded in enumerate([*scenes] * _PLACEMENT_CASES):
        taken = taken_away(encoded, structure, rng)
        if taken is None:
            continue
        target, kept = taken
        gone = int(rng.choice(np.flatnonzero(encoded.instance_classes == target)))
        given = posterior(artifact, replace(scene_of(encoded, kept, ()), room_type=None))
        present = given.present
        anchors = np.flatnonzero(~structure[present.classes])
        both = given.placement_log_odds(np.array([target]), anchors)
        other = np.array(kept)[present.first[anchors]]
        holds = encoded.instance_holds
        truths = (holds[:, gone, other], holds[:, other, gone])
        for values, truth in zip(both, truths, strict=True):
            a, place = (part.ravel() for part in np.indices(truth.shape))
            size = np.full(len(a), np.log(len(present.classes) + 1))
            count = np.log(present.counts[anchors])[place]
            columns = (np.full(len(a), number), a, values[0].ravel(), count, size, truth.ravel())
            blocks.append(np.stack(columns, 1).astype(np.float64))
    return _fit_listed(blocks, artifact.machine.spec.A, PLACES)


def taken_away(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[int, list[int]] | None:
    """(a class drawn from those that may be missing, the instances of all others)."""
    classes = encoded.evidence.classes
    removable = classes[~structure[classes]]
    if len(removable) < 2:
        return None
    target = int(rng.choice(removable))
    return target, [k for k, c in enumerate(encoded.instance_classes) if c != target]


def _fit_listed(
    blocks: list[NDArray[np.float64]], relations: int, listed: int
) -> tuple[PairSlope, ...]:
    """Fits of all relations to examples of which an answer lists the best so many of each scene.

    These decide: what is chosen for its high log-odds is listed by annotators less often than
    log-odds alike among all pairs. The others count a little.
    """
    examples = np.concatenate(blocks or [np.zeros((0, _TRUTH + 1))])
    # A relation that has no unit in the machine tells nothing of how log-odds are to be read.
    examples = examples[examples[:, _LOGIT] > NO_UNIT]
    slopes = _fit_each(examples, relations, np.ones(len(examples)))
    for _ in range(_ROUNDS):
        weight = np.where(_among_best(examples, slopes, listed), 1.0, _OF_THE_REST)
        slopes = _fit_each(examples, relations, weight)
    return slopes


def _among_best(
    examples: NDArray[np.float64], slopes: tuple[PairSlope, ...], listed: int
) -> NDArray[np.bool_]:
    """Which of the examples are among the best so many of their scene."""
    table = np.array([(s.slope, s.log_count, s.log_classes, s.intercept) for s in slopes])
    weights = table[examples[:, _RELATION].astype(np.int64)]
    logits = (examples[:, _LOGIT:_TRUTH] * weights[:, :3]).sum(1) + weights[:, 3]
    order = np.lexsort((-logits, examples[:, 0]))
    scene = examples[order, 0]
    rank = np.arange(len(order)) - np.searchsorted(scene, scene)
    found = np.zeros(len(order), dtype=np.bool_)
    found[order] = rank < listed
    return found


def _fit_each(
    examples: NDArray[np.float64], relations: int, weight: NDArray[np.float64]
) -> tuple[PairSlope, ...]:
    fitted = []
    for a in range(relations):
        own = examples[:, _RELATION] == a
        fitted.append(_fit_relation(examples[own], weight[own]))
    return tuple(fitted)


def told_pairs(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.bool_], list[Triple]]:
    """Half of the pairs of a scene are told about: those left to ask (N, N), and what is told.

    Which ones is decided without looking at what holds between them: had half of the relations been
    given, a pair of which nothing is said would be likelier to have none.
    """
    size = len(encoded.instance_classes)
    half = np.triu(rng.random((size, size)) < 0.5, 1)
    told = half | half.T
    plain = ~structure[encoded.instance_classes]
    triples = np.argwhere(encoded.instance_holds & told & plain[:, None] & plain).tolist()
    return ~told, [(int(a), int(x), int(y)) for a, x, y in triples]


def _instance_pairs(
    number: int,
    scene: EncodedScene,
    values: NDArray[np.floating[Any]],
    structure: NDArray[np.bool_],
    asked: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """(examples, 6): scene, relation, class log-odds, log n_i + log n_j, log of all classes,
    and whether it was listed.
    """
    evidence = scene.evidence
    place = np.searchsorted(evidence.classes, scene.instance_classes)
    logs = np.log(evidence.counts[place])
    usable = ~structure[scene.instance_classes]
    pair = asked & usable[:, None] & usable[None, :] & ~np.eye(len(place), dtype=np.bool_)
    both = (logs[:, None] + logs[None, :])[pair]
    columns = []
    for a in range(len(values)):
        logit = values[a][place[:, None], place[None, :]][pair]
        size = np.full(len(logit), np.log(len(evidence.classes)))
        # What is not listed is off, left open by geometry or not: a listing is what is promised.
        truth = scene.instance_holds[a][pair]
        which = (np.full(len(logit), number), np.full(len(logit), a))
        columns.append(np.stack([*which, logit, both, size, truth], 1))
    return np.concatenate(columns)


def _fit_relation(examples: NDArray[np.float64], weight: NDArray[np.float64]) -> PairSlope:
    truth = examples[:, _TRUTH] > 0
    if len(np.unique(truth)) < 2:
        return PairSlope()
    slope, count, classes, intercept = _logistic(examples[:, _LOGIT:_TRUTH], truth, weight)
    return PairSlope(intercept=intercept, slope=slope, log_count=count, log_classes=classes)


@torch.no_grad()
def fit_placed(
    artifact: Artifact, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[float, float]:
    """Temperature and relation weight for the missing object with a known place."""
    rng = np.random.default_rng(seed)
    structure = artifact.vocabulary.structure
    cases: list[tuple[torch.Tensor, torch.Tensor, int]] = []
    for encoded in [*scenes] * _PLACED_CASES:
        case = placed_case(encoded, structure, rng)
        if case is None:
            continue
        scene, relation, anchor, target = case
        given = posterior(artifact, scene)
        absent = np.setdiff1d(np.flatnonzero(~structure), given.present.classes)
        row = int(given.present.row[anchor])
        odds = given.absent_log_odds(absent).astype(np.float64)
        log_p = given.placed_log_p(absent, relation, row, outgoing=True).astype(np.float64)
        where = int(np.flatnonzero(absent == target)[0])
        cases.append((torch.from_numpy(odds), torch.from_numpy(log_p), where))
    if len(cases) < 10:
        return 1.0, 1.0

    def nll(x: NDArray[np.float64]) -> float:
        losses = [
            -(odds / float(np.exp(x[0])) + float(x[1]) * log_p).log_softmax(0)[target]
            for odds, log_p, target in cases
        ]
        return float(torch.stack(losses).mean())

    found = minimize(nll, np.array([0.0, 1.0]), method="Nelder-Mead", options={"maxiter": 80})
    return float(np.exp(found.x[0])), float(found.x[1])


def placed_case(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Scene, int, int, int] | None:
    """A scene with one class taken out that stood in a relation to something that stayed.

    Returns:
        The scene, the canonical relation, the position of its object, and the class taken out.
    """
    evidence = encoded.evidence
    usable = ~structure[evidence.classes]
    pairs = evidence.holds & usable[:, None] & usable[None, :]
    pairs &= ~np.eye(len(usable), dtype=np.bool_)
    found = np.argwhere(pairs)
    if usable.sum() < 3 or not len(found):
        return None
    a, x, y = found[rng.integers(len(found))]
    kept = [k for k, c in enumerate(encoded.instance_classes) if c != evidence.classes[x]]
    scene = scene_of(encoded, kept, triples=())
    anchor = next(
        p for p, k in enumerate(kept) if encoded.instance_classes[k] == evidence.classes[y]
    )
    return scene, int(a), anchor, int(evidence.classes[x])


def fit_misplaced(artifact: Artifact, scenes: Sequence[EncodedScene], seed: int = 0) -> Slope:
    """Logistic regression of "this relation is false" on its log-odds given the rest."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, bool]] = []
    for encoded in scenes:
        case = altered_case(encoded, artifact.vocabulary.structure, rng)
        if case is None:
            continue
        scene, false = case
        for answer in misplaced(artifact, scene):
            p = np.clip(answer.probability, 1e-9, 1 - 1e-9)
            triple = (CANONICAL.index(answer.relation), answer.subject, answer.object)
            rows.append((float(np.log(p / (1 - p))), triple == false))
    examples = np.array(rows)
    if len(examples) < 20 or len(np.unique(examples[:, 1])) < 2:
        return Slope()
    slope, intercept = _logistic(examples[:, :1], examples[:, 1] > 0)
    return Slope(intercept=intercept, slope=slope)


def altered_case(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Scene, tuple[int, int, int] | None] | None:
    """A scene with its triples; in half of them one was replaced by one that is not true there."""
    usable = ~structure[encoded.instance_classes]
    holds = encoded.instance_holds & usable[:, None] & usable[None, :]
    triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(holds)]
    if len(triples) < 2:
        return None
    if len(triples) > 40:
        chosen = sorted(rng.choice(len(triples), 40, replace=False).tolist())
        triples = [triples[k] for k in chosen]
    everything = range(len(encoded.instance_classes))
    if rng.random() < 0.5:
        return scene_of(encoded, everything, triples), None
    place = int(rng.integers(len(triples)))
    for _ in range(50):
        a, i, j = triples[place]
        if rng.random() < 0.5:
            a = int(rng.integers(len(CANONICAL)))
        else:
            j = int(rng.integers(len(usable)))
        if i == j or not usable[j] or holds[a, i, j] or holds[a, j, i]:
            continue
        altered = [*triples[:place], (a, i, j), *triples[place + 1 :]]
        return scene_of(encoded, everything, altered), (a, i, j)
    return None


def scene_of(
    encoded: EncodedScene,
    kept: Sequence[int],
    triples: Sequence[tuple[int, int, int]],
) -> Scene:
    """The instances at the given positions as a request would give them."""
    objects = tuple(
        SceneObject(id=str(k), label=str(c), class_index=int(c))
        for k, c in enumerate(encoded.instance_classes[list(kept)])
    )
    room = encoded.room_type
    return Scene(objects, tuple(triples) or None, room_type=room if room >= 0 else None)


def _logistic(
    features: NDArray[np.float64],
    truth: NDArray[np.bool_],
    weight: NDArray[np.float64] | None = None,
) -> list[float]:
    """Coefficients and intercept of an (almost) unpenalised logistic regression."""
    fit = LogisticRegression(C=1e6, max_iter=1000).fit(features, truth, weight)
    return [float(x) for x in (*fit.coef_[0], fit.intercept_[0])]


def _sigmoid(x: float) -> float:
    return float(1 / (1 + np.exp(-x)))
