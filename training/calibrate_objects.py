"""Fit the calibration of answers about objects.

    coverage   the default coverage and the weight of the partial posterior, chosen by the rank of
               hidden classes
    missing    p(present | not listed), fitted to scenes that show 25 %, 50 %, 75 % or all but one
               of their classes. The weight of a source is the sum of its scene weights, so
               near-duplicates count less
    outlier    p(intruder) and its thresholds; half of the scenes have no intruder
    evidence   the weight of relations and poses in answers about objects

The prior of an intruder is proportional to popularity^alpha. Alpha and the logistic regression are
fitted to three kinds of intruders, equally weighted: drawn uniformly, drawn by popularity, and
typical of another room type.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.questions.generate import room_fit
from app.questions.posterior import posterior
from app.registry import Artifact, Calibration, CountSlope, EvidenceWeights, Thresholds
from app.scene import Scene, SceneObject
from training.batches import SceneTensors, subset
from training.cases import logistic
from training.evaluation.evidence import removals
from training.evaluation.intruders import (
    IntruderScores,
    by_popularity,
    by_signature,
    clean_scores,
    intruder_scores,
)
from training.evaluation.missing import SHARES, MachineScore, hide
from training.evaluation.outliers import alarm_threshold
from training.machines.arrays import machine_of

Floats = NDArray[np.float64]

COVERAGES = (0.3, 0.4, 0.5, 0.6, 0.7)
WEIGHTS = (0.3, 0.4, 0.5, 0.6, 0.7, 1.0)
# At alpha .5 the share of uniform intruders that is detected in sunrgbd falls from .47 to .35.
ALPHAS = (0.0, 0.125, 0.25, 0.375)
PULLS = (0.0, 0.1, 0.2, 0.5, 1.0)
ALARMS = {"low": 0.02, "medium": 0.1, "high": 0.2}
"""Shares of untouched scenes of the hardest large source that raise an alarm."""

# Lists of up to `_SHORT_LISTS` classes have their own thresholds if there are enough scenes.
_SHORT_LISTS = 4
_SHORT_LIST_SCENES = 30
_NEVER = Thresholds(low=1.0, medium=1.0, high=1.0)
# Number of scenes used from each source.
_PARTIAL_SCENES = 120
# Number of draws of the hidden class, for scenes that show all but one class.
_DRAWS_OF_ONE = 4
# Quantiles of real rooms. A generated scene is too small if its size is below quantile `_SMALL`. It
# does not suit its room type if its `room_fit` is below quantile `_UNSUITED`. A room type needs
# `_ROOM_SCENES` scenes for its own limits.
_SMALL = 0.1
_UNSUITED = 0.15
_ROOM_SCENES = 20
_EVIDENCE_SCENES = 400
# Number of scenes for a machine without a closed form: it samples its answers, which takes a
# hundred times longer.
_EVIDENCE_SCENES_OF_DRAWS = 100
# Accepted losses: of hit@1 and of the detected share for uniform intruders, and of MRR for nearly
# complete lists.
_UNIFORM_LOSS = np.array([0.04, 0.06])
_COMPLETE_LOSS = 0.002
_NEARLY_COMPLETE = ("75 %", "all but one")
# Weights whose MRR is within this distance of the best count as equal; the least of them is used.
_AS_GOOD = 0.006
# An answer lists ten classes by default, so the fit uses the ten best classes.
_LISTED = 10


def complete_scenes(scenes: SceneTensors, seed: int = 0) -> SceneTensors:
    """Return scenes with complete object lists, or all scenes if no list is complete.

    Near-duplicates are sampled by their weight.
    """
    rng = np.random.default_rng(seed)
    complete = scenes.complete.numpy()
    # A model trained on photographs only has no complete scenes. Its calibration uses all scenes.
    complete = complete if complete.any() else ~complete
    kept = complete & (rng.random(len(scenes)) < scenes.weight.numpy())
    return subset(scenes, torch.from_numpy(np.flatnonzero(kept)))


def calibrate_objects(
    artifact: Artifact,
    validation: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    seed: int = 0,
    chosen: Calibration | None = None,
) -> Calibration:
    """Return the artifact's calibration with every entry about objects fitted.

    Args:
        validation: scenes that were not used in training.
        train: scenes that give the popularity of classes and the signatures of room types.
        structure: (V,) bool, true for structure classes.
        chosen: a calibration with values chosen on other validation scenes: coverage and its
            weight, weights of evidence, alpha. Without it, these values are chosen here.
    """
    scenes = complete_scenes(validation, seed)
    if not len(scenes):
        return artifact.calibration
    every = validation.complete if bool(validation.complete.any()) else ~validation.complete
    every_scene = subset(validation, every.nonzero().squeeze(1))
    learnt = complete_scenes(train, seed)
    popular = tuple(np.round(popularity(train), 4).tolist())
    artifact = recalibrated(artifact, popularity=popular)
    coverage = fit_coverage(artifact, every_scene, structure, seed, chosen)
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
    """Return the artifact with some entries of its calibration replaced."""
    return replace(artifact, calibration=artifact.calibration.model_copy(update=entries))


def popularity(train: SceneTensors) -> Floats:
    """Return the log-odds (V,) of each class in a complete training scene, smoothed by 1/2."""
    weight = train.weight * (train.complete if bool(train.complete.any()) else 1.0)
    count = (train.v * weight.unsqueeze(1)).sum(0).double().numpy()
    total = float(weight.sum())
    found: Floats = np.log((count + 0.5) / (total - count + 0.5))
    return found


def smallest_scenes(train: SceneTensors, structure: Tensor, rooms: int) -> tuple[int, ...]:
    """Return the 10 % quantile of the class counts of each room type and of all scenes, (C + 1,).

    For a room type with fewer than 20 scenes, the quantile over all scenes is used.
    """
    sizes = ((train.v > 0) & ~structure).sum(1).numpy()
    every = int(np.quantile(sizes, _SMALL))
    of = [sizes[train.room.numpy() == t] for t in range(rooms)]
    found = [int(np.quantile(n, _SMALL)) if len(n) >= _ROOM_SCENES else every for n in of]
    return (*found, every)


def room_limits(artifact: Artifact, train: SceneTensors) -> tuple[float, ...]:
    """Return the 15 % quantile of `room_fit` of each room type, (C,); -1e9 for under 20 scenes."""
    found = []
    for t in range(artifact.spec.C):
        own = train.v[train.room == t].numpy()
        limit = -1e9
        if len(own) >= _ROOM_SCENES:
            limit = float(np.quantile(room_fit(artifact.weights, own, t), _UNSUITED))
        found.append(round(limit, 4))
    return tuple(found)


# ------------------------------------------------------------------------------ unlisted classes


@dataclass(frozen=True, eq=False)
class _Shown:
    """A scene that shows some of its classes and hides the others.

    Attributes:
        closed: (n,) log-odds of the unlisted classes in closed form.
        partial: log-odds (n,) of the unlisted classes in the partial posterior, by coverage.
        hidden: (n,) bool, True where an unlisted class is in the scene but hidden.
        listed: number of listed classes.
        share: share of shown classes as text, such as "75 %".
        source: index of the scene's source.
        weight: weight of the scene: the number of scenes for which it stands.
    """

    closed: Floats
    partial: dict[float, Floats]
    hidden: NDArray[np.bool_]
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
    """Fit `coverage`, `coverage_weight` and `missing`."""
    cases = list(_shown(artifact, scenes, structure, seed))
    if not cases:
        return {}
    if artifact.completions is None:
        coverage, weight = artifact.calibration.coverage, 0.0
    elif chosen:
        coverage, weight = chosen.coverage, chosen.coverage_weight
    else:
        coverage, weight = _choose_coverage(cases)
    rows = [_rows(case, coverage, weight) for case in cases]
    examples = np.concatenate(rows)
    weights = np.repeat([case.weight for case in cases], [len(own) for own in rows])
    entry = CountSlope()
    if len(np.unique(examples[:, 2])) == 2:
        slope, count, intercept = logistic(examples[:, :2], examples[:, 2] > 0, weights)
        entry = CountSlope(intercept=intercept, slope=slope, log_count=count)
    return {"coverage": coverage, "coverage_weight": weight, "missing": entry}


def _choose_coverage(cases: Sequence[_Shown]) -> tuple[float, float]:
    """Return the coverage and weight with the best MRR.

    Their MRR on nearly complete lists may be at most `_COMPLETE_LOSS` below the best one.
    """
    nearly = [[case for case in cases if case.share == share] for share in _NEARLY_COMPLETE]
    least = [_mrr(some, 0.5, 0.0) - _COMPLETE_LOSS for some in nearly]
    allowed = [(0.5, 0.0)] + [
        pair
        for pair in itertools.product(COVERAGES, WEIGHTS)
        if all(_mrr(some, *pair) >= limit for some, limit in zip(nearly, least, strict=True))
    ]
    return max(allowed, key=lambda pair: _mrr(cases, *pair))


def _shown(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, seed: int
) -> Iterable[_Shown]:
    order = torch.randperm(len(scenes), generator=torch.Generator().manual_seed(seed))
    source = scenes.source[order]
    place = torch.zeros(len(order), dtype=torch.int64)
    stands_for = torch.zeros(len(order))
    for one in source.unique():
        own = source == one
        count = int(own.sum())
        place[own] = torch.arange(count)
        stands_for[own] = scenes.weight[order][own].sum() / min(count, _PARTIAL_SCENES)
    chosen = place < _PARTIAL_SCENES
    some, weight = subset(scenes, order[chosen]), stands_for[chosen].tolist()
    source_of = source[chosen].tolist()
    whole = recalibrated(artifact, coverage_weight=1.0)
    # With a single draw of the one hidden class, the choice would depend too much on chance.
    draws = [
        (name, share, seed + draw)
        for name, share in SHARES.items()
        for draw in range(1 if share else _DRAWS_OF_ONE)
    ]
    for name, share, draw in draws:
        cases = hide(some, structure, share, draw)
        for k, v, hidden in zip(cases.scene, cases.v.numpy(), cases.hidden.numpy(), strict=True):
            classes = np.flatnonzero(v)
            absent = np.flatnonzero((v == 0) & ~structure.numpy())
            given = posterior(whole, _labels(classes))
            partial = {}
            if whole.completions is not None:
                partial = {
                    coverage: given.absent_posterior(absent, coverage).astype(np.float64)
                    for coverage in COVERAGES
                }
            closed = given.absent_log_odds(absent).astype(np.float64)
            listed = max(1, int((~structure.numpy()[classes]).sum()))
            own = weight[int(k)] / (1 if share else _DRAWS_OF_ONE)
            yield _Shown(closed, partial, hidden[absent], listed, name, source_of[int(k)], own)


def _labels(classes: NDArray[np.int64]) -> Scene:
    return Scene(tuple(SceneObject(str(c), str(c), int(c)) for c in classes))


def _mixed(case: _Shown, coverage: float, weight: float) -> Floats:
    closed = case.closed + np.log1p(-coverage)
    if not weight:
        return closed
    mixed: Floats = (1 - weight) * closed + weight * case.partial[coverage]
    return mixed


def _mrr(cases: Sequence[_Shown], coverage: float, weight: float) -> float:
    """Return the mean of 1 / rank of hidden classes; all sources have the same weight."""
    found: dict[int, list[Floats]] = {}
    for case in cases:
        z = _mixed(case, coverage, weight)
        others = np.sort(z[~case.hidden])
        above = len(others) - np.searchsorted(others, z[case.hidden], side="right")
        found.setdefault(case.source, []).append(1.0 / (1.0 + above.astype(np.float64)))
    return float(np.mean([np.concatenate(own).mean() for own in found.values()]))


def _rows(case: _Shown, coverage: float, weight: float) -> Floats:
    """Return rows (n, 3) of the best classes: log-odds, log of the list's length, 1 if hidden."""
    z = _mixed(case, coverage, weight)
    first = np.argsort(-z, kind="stable")[:_LISTED]
    size = np.full(len(first), np.log(case.listed))
    return np.stack([z[first], size, case.hidden[first]], 1)


# ------------------------------------------------------------------------------------- intruders


def fit_outliers(
    artifact: Artifact,
    scenes: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    seed: int = 0,
    chosen: Calibration | None = None,
) -> dict[str, Any]:
    """Fit `popularity_weight`, `outlier`, `outlier_thresholds` and `short_list_thresholds`.

    At the start of a tour, a robot lists few classes. The probability is fitted to whole scenes and
    is too high for short lists. For example, a stove alone is rare in a procedural room. Short
    lists therefore have their own thresholds, fitted by the same rule to parts of the same scenes.
    A threshold for short lists is at least the threshold for whole scenes. It is at most the
    threshold for shorter lists.
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
    kinds = {name: found for name, found in kinds.items() if found.intruder.any()}
    if not kinds:
        return {}
    alpha = chosen.popularity_weight if chosen else choose_alpha(kinds, prior)
    judged = {name: found.with_prior(alpha * prior) for name, found in kinds.items()}
    rng = np.random.default_rng(seed)
    parts = []
    for found in judged.values():
        clean_scene = rng.random(found.scenes) < 0.5
        used = found.clean == clean_scene[found.scene]
        features = np.stack([found.log_odds, np.log(found.size)], 1)[used]
        parts.append(np.column_stack([features, found.intruder[used]]))
    examples = np.concatenate(parts)
    slope, size, intercept = logistic(examples[:, :2], examples[:, 2] > 0)
    entry = CountSlope(intercept=intercept, slope=slope, log_count=size)
    untouched = next(iter(judged.values()))
    limits = _limits(untouched, scenes, entry, rng)
    fitted: dict[str, Any] = {
        "popularity_weight": alpha,
        "outlier": entry,
        "outlier_thresholds": limits,
    }
    short: list[Thresholds] = []
    for listed in range(1, _SHORT_LISTS + 1):
        some, parts_of = listing(scenes, structure, listed, rng)
        if len(some) < _SHORT_LIST_SCENES:
            break
        found = clean_scores(parts_of, structure, score).with_prior(alpha * prior)
        own = _between(limits, _limits(found, some, entry, rng), short[-1] if short else _NEVER)
        if own == limits:
            break
        short.append(own)
    return fitted | {"short_list_thresholds": tuple(short)}


def listing(
    scenes: SceneTensors, structure: Tensor, listed: int, rng: np.random.Generator
) -> tuple[SceneTensors, Tensor]:
    """Return the scenes with more than `listed` classes, and their shortened lists (N, V).

    A shortened list contains `listed` classes of the scene, drawn at random. It also contains the
    structure classes of the scene, which are not counted.
    """
    plain = (scenes.v > 0) & ~structure
    large = (plain.sum(1) > listed).nonzero().squeeze(1)
    order = torch.from_numpy(rng.random(plain[large].shape)).masked_fill(~plain[large], 2.0)
    kept = order.argsort(1)[:, :listed]
    shown = scenes.v[large] * structure
    return subset(scenes, large), shown.scatter(1, kept, 1.0)


def _limits(
    untouched: IntruderScores, scenes: SceneTensors, entry: CountSlope, rng: np.random.Generator
) -> Thresholds:
    logits = entry.log_odds(untouched.log_odds, untouched.size).astype(np.float64)
    limits = {
        name: float(1 / (1 + np.exp(-alarm_threshold(logits, untouched, scenes, rng, share))))
        for name, share in ALARMS.items()
    }
    return Thresholds(**limits)


def _between(low: Thresholds, found: Thresholds, high: Thresholds) -> Thresholds:
    return Thresholds(
        **{
            name: min(max(getattr(found, name), getattr(low, name)), getattr(high, name))
            for name in ALARMS
        }
    )


def choose_alpha(kinds: dict[str, IntruderScores], prior: Floats) -> float:
    """Return the alpha with the best mean of hit@1 and detected share over all intruder kinds.

    Uniform intruders may lose at most .04 of hit@1 and .06 of the detected share compared with
    alpha 0.
    """
    found = {
        alpha: {name: _found(scores.with_prior(alpha * prior)) for name, scores in kinds.items()}
        for alpha in ALPHAS
    }
    floor = found[0.0].get("uniform", np.zeros(2)) - _UNIFORM_LOSS
    allowed = [alpha for alpha in ALPHAS if (found[alpha].get("uniform", floor) >= floor).all()]
    return max(allowed, key=lambda alpha: (sum(map(np.sum, found[alpha].values())), -alpha))


def _found(scores: IntruderScores) -> Floats:
    """Return hit@1 and the detected share when 10 % of the untouched scenes raise an alarm."""
    worst = np.full(scores.scenes, np.inf)
    np.minimum.at(worst, scores.scene[scores.clean], scores.log_odds[scores.clean])
    limit = np.quantile(worst[np.isfinite(worst)], ALARMS["medium"])
    caught = (scores.log_odds[scores.intruder] <= limit).mean()
    return np.array([scores.hit_at_1().figure().value, caught])


# -------------------------------------------------------------------------------------- evidence


def fit_evidence(
    artifact: Artifact, validation: SceneTensors, structure: Tensor, seed: int = 0
) -> EvidenceWeights:
    """Choose the weights of relations and poses in answers about objects, by MRR."""
    plain = structure.numpy()
    found = artifact.calibration.evidence
    scenes = complete_scenes(validation, seed)
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
    rng = np.random.default_rng(seed)
    count = _EVIDENCE_SCENES if artifact.oracle is None else _EVIDENCE_SCENES_OF_DRAWS
    chosen = rng.permutation(related)[:count].astype(np.int64)
    some = subset(scenes, torch.from_numpy(chosen))
    if not len(some):
        return found
    for kind, name in (("relations", "relations_on_objects"), ("poses", "poses_on_objects")):
        cases = list(removals(some, plain, kind, seed))
        if not cases:
            continue
        scores = {}
        for pull in PULLS:
            asked = recalibrated(artifact, evidence=found.model_copy(update={name: pull}))
            ranks = [_rank(asked, case.scenes[1], case.target, plain) for case in cases]
            scores[pull] = float(np.mean([1 / rank for rank in ranks]))
        found = found.model_copy(update={name: least_of_the_best(scores)})
    return found


def least_of_the_best(scores: dict[float, float]) -> float:
    """Return the least weight whose score is within `_AS_GOOD` of the best score."""
    enough = max(scores.values()) - _AS_GOOD
    return min(pull for pull, score in scores.items() if score >= enough)


def _rank(artifact: Artifact, scene: Scene, target: int, structure: NDArray[np.bool_]) -> int:
    given = posterior(artifact, scene)
    absent = np.setdiff1d(np.flatnonzero(~structure), given.present.classes)
    z = given.absent_posterior(absent, artifact.calibration.coverage)
    return 1 + int((z > z[absent == target]).sum())
