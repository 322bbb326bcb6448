"""Fit the calibration of answers about objects.

    coverage   Assumed share of the objects that a scene lists, and the weight of the posterior for
               partly listed scenes. Both are chosen by the rank of hidden classes.
    missing    Probability that an unlisted class is present, fitted to scenes that show 25 %, 50 %,
               75 % or all but one of their classes. Near-duplicate scenes have a lower weight.
    outlier    Probability that a class is an intruder, with thresholds. Half of the scenes contain
               an intruder.
    evidence   See `fit_evidence`.

The prior of an intruder class is proportional to (frequency of the class)^alpha. Alpha and the
logistic regression are fitted to three kinds of intruders with equal weights. Intruders are drawn
uniformly, by the frequency of classes, or from the typical classes of another room type.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from app.questions.generate import room_fit
from app.questions.posterior import calibrated, posterior_of
from app.registry import NEVER, Artifact, Calibration, CountSlope, EvidenceWeights, Thresholds
from app.scene import Scene
from training.datasets.array_types import Flags, Floats, Rng
from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import RIDGE, logistic, scene_rng
from training.evaluation.alarms import ALARMS
from training.evaluation.asking import of_classes
from training.evaluation.evidence_tasks import removals
from training.evaluation.intruders import by_popularity, by_signature
from training.fit.intruder_scores import (
    IntruderScores,
    alarm_threshold,
    clean_scores,
    intruder_scores,
)
from training.fit.machine_scores import MachineScore
from training.machines.arrays import machine_of

SHARES: dict[str, float | None] = {"50 %": 0.5, "25 %": 0.25, "75 %": 0.75, "all but one": None}
"""Share of the classes that a partial list shows. None hides one class."""
COVERAGES = (0.3, 0.4, 0.5, 0.6, 0.7)
WEIGHTS = (0.3, 0.4, 0.5, 0.6, 0.7, 1.0)
# Tested exponents alpha. With 0.5, the detected share of uniformly drawn intruders in sunrgbd falls
# from .47 to .35.
ALPHAS = (0.0, 0.125, 0.25, 0.375)
EVIDENCE_WEIGHTS = (0.0, 0.1, 0.2, 0.5, 1.0)
# Minimum thresholds. If the scores of intruders and other objects do not overlap, as in scenes that
# hardly vary, the target shares would need alarms for objects that probably belong to the scene.
LEAST = {"low": 0.5, "medium": 0.3, "high": 0.2}
# Lists of up to `_SHORT_LISTS` classes have separate thresholds, until the threshold of whole
# scenes raises alarms in at most `_ENOUGH` times the target share of the shortened lists. Each
# threshold is fitted to at least `_SHORTENED` lists; few scenes are shortened several times.
_SHORT_LISTS = 8
_ENOUGH = 1.5
_SHORTENED = 200
_PARTIAL_SCENES = 120  # scenes used from each source
# Number of times that the hidden class is drawn, for scenes that show all but one class.
_DRAWS_OF_ONE = 4
# Quantiles over real rooms of a room type. A generated scene is too small if its number of classes
# is below quantile `_SMALL`. A generated scene does not suit its room type if its `room_fit` is
# below quantile `_UNSUITED`. A room type needs `_ROOM_SCENES` scenes for separate limits.
_SMALL = 0.1
_UNSUITED = 0.15
_ROOM_SCENES = 20
_EVIDENCE_SCENES = 400
# Number of scenes for a machine whose log-odds have no closed form. Sampling the log-odds takes a
# hundred times longer than a closed form.
_EVIDENCE_SCENES_OF_DRAWS = 100
# Maximum accepted losses. `_UNIFORM_LOSS`: hit@1 and detected share of uniformly drawn intruders.
# `_COMPLETE_LOSS`: mean reciprocal rank (MRR) of hidden classes in nearly complete lists.
_UNIFORM_LOSS = np.array([0.04, 0.06])
_COMPLETE_LOSS = 0.002
_NEARLY_COMPLETE = ("75 %", "all but one")
# Weights whose MRR differs from the best MRR by at most this value count as equal. The smallest of
# these weights is used.
_AS_GOOD = 0.006
_LISTED = 10  # classes in the fit of each scene; an answer of the service lists ten by default


def complete_scenes(scenes: SceneTensors, seed: int = 0) -> SceneTensors:
    """Return the scenes with complete object lists, or all scenes if no list is complete.

    A near-duplicate scene is kept with a probability equal to its weight.
    """
    rng = np.random.default_rng(seed)
    complete = scenes.complete.numpy()
    # Photographs have no complete object lists. If all scenes are photographs, use all of them.
    complete = complete if complete.any() else ~complete
    mask = complete & (rng.random(len(scenes)) < scenes.weight.numpy())
    return subset(scenes, torch.from_numpy(np.flatnonzero(mask)))


def calibrate_objects(
    artifact: Artifact,
    validation: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    seed: int = 0,
    chosen: Calibration | None = None,
) -> Calibration:
    """Return the model's calibration with newly fitted entries about objects.

    The training scenes give the frequency of each class, and limits for room types. The coverage,
    coverage weight, weights of evidence and alpha of a `chosen` calibration are copied.
    """
    scenes = complete_scenes(validation, seed)
    if not len(scenes):
        return artifact.calibration
    is_used = validation.complete if bool(validation.complete.any()) else ~validation.complete
    used_scenes = subset(validation, is_used.nonzero().squeeze(1))
    learnt = complete_scenes(train, seed)
    popular = tuple(np.round(popularity(train), 4).tolist())
    artifact = recalibrated(artifact, popularity=popular)
    coverage = fit_coverage(artifact, used_scenes, structure, seed, chosen)
    artifact = recalibrated(artifact, **coverage)
    weights = chosen.evidence if chosen else fit_evidence(artifact, validation, structure, seed)
    artifact = recalibrated(artifact, evidence=weights)
    return recalibrated(
        artifact,
        **fit_outliers(artifact, scenes, learnt, structure, seed, chosen),
        smallest=smallest_scenes(learnt, structure, artifact.spec.C),
        room_fit=room_limits(artifact, learnt),
    ).calibration


def recalibrated(artifact: Artifact, **entries: Any) -> Artifact:
    """Return a copy of the model in which some entries of the calibration are replaced."""
    return replace(artifact, calibration=artifact.calibration.model_copy(update=entries))


def popularity(train: SceneTensors) -> Floats:
    """Return the smoothed log-odds that a complete training scene contains a class, (classes,)."""
    weight = train.weight * (train.complete if bool(train.complete.any()) else 1.0)
    count = (train.v * weight.unsqueeze(1)).sum(0).double().numpy()
    total = float(weight.sum())
    return np.log((count + 0.5) / (total - count + 0.5))


def smallest_scenes(train: SceneTensors, structure: Tensor, rooms: int) -> tuple[int, ...]:
    """Return the 10 % quantile of the number of classes in a scene, for each room type.

    The last value is the quantile over all scenes. It also replaces the quantile of a room type
    with fewer than 20 scenes.
    """
    sizes = ((train.v > 0) & ~structure).sum(1).numpy()
    limit = int(np.quantile(sizes, _SMALL))
    by_room = [sizes[train.room.numpy() == t] for t in range(rooms)]
    quantiles = [int(np.quantile(n, _SMALL)) if len(n) >= _ROOM_SCENES else limit for n in by_room]
    return (*quantiles, limit)


def room_limits(artifact: Artifact, train: SceneTensors) -> tuple[float, ...]:
    """Return the 15 % quantile of `room_fit` for each room type, (room types,).

    The value is -1e9 for a room type with fewer than 20 scenes.
    """
    limits = []
    for t in range(artifact.spec.C):
        room_scenes = train.v[train.room == t].numpy()
        limit = -1e9
        if len(room_scenes) >= _ROOM_SCENES:
            limit = float(np.quantile(room_fit(artifact.weights, room_scenes, t), _UNSUITED))
        limits.append(round(limit, 4))
    return tuple(limits)


@dataclass(frozen=True, eq=False)
class _PartialList:
    """A scene that lists only some of its classes. The remaining classes are hidden.

    Attributes:
        closed: log-odds of the unlisted classes if the list were complete, (unlisted classes,).
        partial: log-odds that allow for an incomplete list, (unlisted classes,), by assumed
            coverage.
        hidden: True for unlisted classes that are in the scene, (unlisted classes,) bool.
        share: share of listed classes as text, such as "75 %".
        weight: number of scenes of the data source that this sampled scene represents.
    """

    closed: Floats
    partial: dict[float, Floats]
    hidden: Flags
    listed: int
    share: str
    source: int
    weight: float


def fit_coverage(
    artifact: Artifact,
    scenes: SceneTensors,
    structure: Tensor,
    seed: int = 0,
    chosen: Calibration | None = None,
) -> dict[str, Any]:
    """Fit the entries `coverage`, `coverage_weight` and `missing` of the calibration."""
    cases = list(_draw_partial_lists(artifact, scenes, structure, seed))
    if not cases:
        return {}
    if artifact.completions is None:
        coverage, weight = artifact.calibration.coverage, 0.0
    else:
        coverage, weight = (
            (chosen.coverage, chosen.coverage_weight) if chosen else _choose_coverage(cases)
        )
    rows = [_example_rows(case, coverage, weight) for case in cases]
    examples = np.concatenate(rows)
    weights = np.repeat([case.weight for case in cases], [len(case_rows) for case_rows in rows])
    entry = CountSlope()
    if len(np.unique(examples[:, 2])) == 2:
        slope, count, intercept = logistic(examples[:, :2], examples[:, 2] > 0, weights)
        entry = CountSlope(intercept=intercept, slope=slope, log_count=count)
    return {"coverage": coverage, "coverage_weight": weight, "missing": entry}


@dataclass(frozen=True, eq=False)
class Partial:
    """N scenes with their index in the set (N,), shown and hidden classes (N, V)."""

    scene: Tensor
    v: Tensor
    hidden: Tensor
    scenes: int


def hide(scenes: SceneTensors, structure: Tensor, share: float | None, seed: int = 0) -> Partial:
    """Hide classes of each scene with at least two: all but a share of them, or one (None)."""
    is_thing = ~structure.numpy()
    rows: list[int] = []
    hidden = torch.zeros_like(scenes.v, dtype=torch.bool)
    for k, scene in enumerate(scenes.scenes):
        classes = scene.evidence.classes[is_thing[scene.evidence.classes]]
        if len(classes) < 2:
            continue
        order = scene_rng(scene, seed).permutation(classes)
        hidden[k, torch.from_numpy(order[shown_classes(len(order), share) :])] = True
        rows.append(k)
    index = torch.tensor(rows, dtype=torch.int64)
    v = scenes.v.masked_fill(hidden | structure, 0.0)
    return Partial(index, v[index], hidden[index], len(scenes))


def shown_classes(classes: int, share: float | None) -> int:
    """Return the number of shown classes; at least one class is shown and one hidden."""
    if share is None:
        return classes - 1
    return min(max(int(share * classes + 0.5), 1), classes - 1)


def _choose_coverage(cases: Sequence[_PartialList]) -> tuple[float, float]:
    """Return the coverage and the coverage weight with the best MRR of hidden classes.

    On nearly complete lists, their MRR must be at most `_COMPLETE_LOSS` below the MRR of weight 0.
    """
    parts = [[case for case in cases if case.share == share] for share in _NEARLY_COMPLETE]
    limits = [_mrr(part, 0.5, 0.0) - _COMPLETE_LOSS for part in parts]
    candidates = [(0.5, 0.0)] + [
        pair
        for pair in itertools.product(COVERAGES, WEIGHTS)
        if all(_mrr(part, *pair) >= limit for part, limit in zip(parts, limits, strict=True))
    ]
    return max(candidates, key=lambda pair: _mrr(cases, *pair))


def _draw_partial_lists(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, seed: int
) -> Iterable[_PartialList]:
    """Hide classes of up to `_PARTIAL_SCENES` scenes of each data source, by each of `SHARES`."""
    order = torch.randperm(len(scenes), generator=torch.Generator().manual_seed(seed))
    source = scenes.source[order]
    rank = torch.zeros(len(order), dtype=torch.int64)
    stands_for = torch.zeros(len(order))
    for index in source.unique():
        in_source = source == index
        count = int(in_source.sum())
        rank[in_source] = torch.arange(count)
        total = scenes.weight[order][in_source].sum()
        stands_for[in_source] = total / min(count, _PARTIAL_SCENES)
    is_drawn = rank < _PARTIAL_SCENES
    sample, weight = subset(scenes, order[is_drawn]), stands_for[is_drawn].tolist()
    source_of = source[is_drawn].tolist()
    whole = recalibrated(artifact, coverage_weight=1.0)
    # If only one class is hidden, several hidden classes are tried to reduce the effect of chance.
    draws = [
        (name, share, seed + draw)
        for name, share in SHARES.items()
        for draw in range(1 if share else _DRAWS_OF_ONE)
    ]
    for name, share, draw in draws:
        cases = hide(sample, structure, share, draw)
        for k, v, hidden in zip(cases.scene, cases.v.numpy(), cases.hidden.numpy(), strict=True):
            classes = np.flatnonzero(v)
            absent = np.flatnonzero((v == 0) & ~structure.numpy())
            posterior = posterior_of(whole, of_classes(classes.tolist()))
            partial = {}
            if whole.completions is not None:
                partial = {
                    coverage: posterior.absent_posterior(absent, coverage).astype(np.float64)
                    for coverage in COVERAGES
                }
            closed = posterior.absent_log_odds(absent).astype(np.float64)
            listed = max(1, int((~structure.numpy()[classes]).sum()))
            yield _PartialList(
                closed=closed,
                partial=partial,
                hidden=hidden[absent],
                listed=listed,
                share=name,
                source=source_of[int(k)],
                weight=weight[int(k)] / (1 if share else _DRAWS_OF_ONE),
            )


def _mixed_log_odds(case: _PartialList, coverage: float, weight: float) -> Floats:
    closed = case.closed + np.log1p(-coverage)
    return (1 - weight) * closed + weight * case.partial[coverage] if weight else closed


def _mrr(cases: Sequence[_PartialList], coverage: float, weight: float) -> float:
    """Return the mean reciprocal rank of hidden classes. All data sources have the same weight."""
    reciprocal: dict[int, list[Floats]] = {}
    for case in cases:
        z = _mixed_log_odds(case, coverage, weight)
        others = np.sort(z[~case.hidden])
        above = len(others) - np.searchsorted(others, z[case.hidden], side="right")
        reciprocal.setdefault(case.source, []).append(1.0 / (1.0 + above.astype(np.float64)))
    return float(np.mean([np.concatenate(ranks).mean() for ranks in reciprocal.values()]))


def _example_rows(case: _PartialList, coverage: float, weight: float) -> Floats:
    """Return the data for the fit, one row for each of the best classes, (classes, 3).

    The columns are the log-odds, the log of the number of listed classes, and 1 for a hidden class.
    """
    z = _mixed_log_odds(case, coverage, weight)
    first = np.argsort(-z, kind="stable")[:_LISTED]
    size = np.full(len(first), np.log(case.listed))
    return np.stack([z[first], size, case.hidden[first]], 1)


def fit_outliers(
    artifact: Artifact,
    scenes: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    seed: int = 0,
    chosen: Calibration | None = None,
) -> dict[str, Any]:
    """Fit `popularity_weight`, `outlier`, `outlier_thresholds` and `short_list_thresholds`.

    A robot that starts to explore a room lists few classes. The probability of an intruder is
    fitted to whole scenes and is too high for short lists. For example, a stove without other
    objects is rare in a generated room. Short lists therefore have separate thresholds, fitted by
    the same rule to parts of the same scenes. The threshold never falls when the list gets shorter.
    """
    score = MachineScore(machine_of(artifact.weights))
    prior = np.array(artifact.calibration.popularity)
    laws = {
        "uniform": None,
        "popularity": by_popularity(scenes, train),
        "signature": by_signature(scenes, train),
    }
    kinds = {
        name: intruder_scores(scenes, structure, score, weights=weights, seed=seed)
        for name, weights in laws.items()
    }
    kinds = {name: scores for name, scores in kinds.items() if scores.intruder.any()}
    if not kinds:
        return {}
    alpha = chosen.popularity_weight if chosen else choose_alpha(kinds, prior)
    all_scores = [scores.with_prior(alpha * prior) for scores in kinds.values()]
    rng = np.random.default_rng(seed)
    parts = []
    for scores in all_scores:
        clean_scene = rng.random(scores.scenes) < 0.5
        used = scores.clean == clean_scene[scores.scene]
        columns = scores.log_odds, np.log(scores.size), scores.intruder
        parts.append(np.column_stack(columns)[used])
    examples = np.concatenate(parts)
    slope, size, intercept = logistic(examples[:, :2], examples[:, 2] > 0, C=RIDGE)
    if slope >= 0:
        return {}
    entry = CountSlope(intercept=intercept, slope=slope, log_count=size)
    whole = [(all_scores[0], scenes)]
    limits = thresholds(partial(limit_of, whole, entry, rng))
    short: list[Thresholds] = []
    for listed in range(1, _SHORT_LISTS + 1):
        lists = [listing(scenes, structure, listed, rng)]
        if not len(lists[0][0]):
            break
        while len(lists) * len(lists[0][0]) < _SHORTENED:
            lists.append(listing(scenes, structure, listed, rng))
        shortened = [
            (clean_scores(lists_of, structure, score).with_prior(alpha * prior), sample)
            for sample, lists_of in lists
        ]
        share = _ENOUGH * ALARMS["medium"]
        if limit_of(shortened, entry, np.random.default_rng(seed), share) <= limits.medium:
            break
        length_limits = thresholds(partial(limit_of, shortened, entry, rng))
        short.append(_clamp_thresholds(limits, length_limits, short[-1] if short else NEVER))
    return {
        "popularity_weight": alpha,
        "outlier": entry,
        "outlier_thresholds": limits,
        "short_list_thresholds": tuple(short),
    }


def listing(
    scenes: SceneTensors, structure: Tensor, listed: int, rng: Rng
) -> tuple[SceneTensors, Tensor]:
    """Return the scenes with more than `listed` classes, and shortened object lists.

    A shortened list contains `listed` random classes and all structure classes of the scene. The
    lists have the shape (scenes, classes).
    """
    is_thing = (scenes.v > 0) & ~structure
    large = (is_thing.sum(1) > listed).nonzero().squeeze(1)
    order = torch.from_numpy(rng.random(is_thing[large].shape)).masked_fill(~is_thing[large], 2.0)
    drawn = order.argsort(1)[:, :listed]
    structure_lists = scenes.v[large] * structure
    return subset(scenes, large), structure_lists.scatter(1, drawn, 1.0)


Scored = Sequence[tuple[IntruderScores, SceneTensors]]
"""Scores of untouched scenes, and these scenes: one entry for each shortening of the scenes."""


def thresholds(limit: Callable[[float], float]) -> Thresholds:
    """Return the limits of the target shares of alarms, each at least the minimum."""
    return Thresholds(**{name: max(LEAST[name], limit(share)) for name, share in ALARMS.items()})


def limit_of(untouched: Scored, entry: CountSlope, rng: Rng, share: float) -> float:
    """Return the probability that raises alarms in a share of the untouched scenes.

    The function averages over the shortenings, because several shortenings of a scene are not
    several scenes for `alarm_threshold`.
    """
    logits = [
        alarm_threshold(
            calibrated(entry, scores.log_odds, scores.size).astype(np.float64),
            *(scores, scenes, rng, share),
        )
        for scores, scenes in untouched
    ]
    return float(1 / (1 + np.exp(-np.mean(logits))))


def _clamp_thresholds(low: Thresholds, middle: Thresholds, high: Thresholds) -> Thresholds:
    """Raise each threshold of `middle` to that of `low`, then lower it to that of `high`."""
    raised = {name: max(getattr(middle, name), getattr(low, name)) for name in ALARMS}
    return Thresholds(**{name: min(raised[name], getattr(high, name)) for name in ALARMS})


def choose_alpha(kinds: dict[str, IntruderScores], prior: Floats) -> float:
    """Return the alpha with the best mean of hit@1 and detected share over all intruder kinds.

    For uniformly drawn intruders, hit@1 may be at most .04 lower than with alpha 0, and the
    detected share at most .06 lower.
    """
    rates = {
        alpha: {name: _detection(s.with_prior(alpha * prior)) for name, s in kinds.items()}
        for alpha in ALPHAS
    }
    floor = rates[0.0].get("uniform", np.zeros(2)) - _UNIFORM_LOSS
    allowed = [alpha for alpha in ALPHAS if (rates[alpha].get("uniform", floor) >= floor).all()]
    return max(allowed, key=lambda alpha: (sum(map(np.sum, rates[alpha].values())), -alpha))


def _detection(scores: IntruderScores) -> Floats:
    """Return hit@1 and the share of intruders that an alarm in 10 % of unaltered scenes detects."""
    worst = np.full(scores.scenes, np.inf)
    np.minimum.at(worst, scores.scene[scores.clean], scores.log_odds[scores.clean])
    limit = np.quantile(worst[np.isfinite(worst)], ALARMS["medium"])
    detected = (scores.log_odds[scores.intruder] <= limit).mean()
    return np.array([scores.hit_at_1().figure().value, detected])


def fit_evidence(
    artifact: Artifact, validation: SceneTensors, structure: Tensor, seed: int = 0
) -> EvidenceWeights:
    """Choose the weights of relations and poses in answers about objects.

    The criterion is the mean reciprocal rank (MRR) of removed objects. Evidence without validation
    scenes has no effect on answers about objects.
    """
    mask = structure.numpy()
    weights = EvidenceWeights(relations_on_objects=0.0, poses_on_objects=0.0)
    scenes = complete_scenes(validation, seed)
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
    rng = np.random.default_rng(seed)
    count = _EVIDENCE_SCENES if artifact.oracle is None else _EVIDENCE_SCENES_OF_DRAWS
    index = rng.permutation(related)[:count].astype(np.int64)
    sample = subset(scenes, torch.from_numpy(index))
    for kind, name in (("relations", "relations_on_objects"), ("poses", "poses_on_objects")):
        cases = list(removals(sample, mask, kind, seed)) if len(sample) else []
        if not cases:
            continue
        scores = {}
        for weight in EVIDENCE_WEIGHTS:
            tested = recalibrated(artifact, evidence=weights.model_copy(update={name: weight}))
            ranks = [_rank(tested, case.scenes[1], case.target, mask) for case in cases]
            scores[weight] = float(np.mean([1 / rank for rank in ranks]))
        weights = weights.model_copy(update={name: smallest_good_weight(scores)})
    return weights


def smallest_good_weight(scores: dict[float, float]) -> float:
    """Return the smallest weight whose score is at most `_AS_GOOD` below the best score."""
    least = max(scores.values()) - _AS_GOOD
    return min(weight for weight, score in scores.items() if score >= least)


def _rank(artifact: Artifact, scene: Scene, target: int, structure: Flags) -> int:
    posterior = posterior_of(artifact, scene)
    absent = np.setdiff1d(np.flatnonzero(~structure), posterior.present.classes)
    z = posterior.absent_posterior(absent, artifact.calibration.coverage)
    return 1 + int((z > z[absent == target]).sum())
