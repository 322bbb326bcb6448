"""The calibration of what is said of objects: unlisted classes, intruders, and weights of evidence.

    coverage   the default and the share of the partial posterior, by the rank of hidden classes
    missing    p(there | not listed), on scenes of which 25, 50 and 75 % and all but one were shown;
               a source counts by its scenes, near-duplicates by their weight
    outlier    p(intruder), where half of the scenes are clean, and its thresholds
    evidence   the pull of relations on what is said of objects

The prior of an intruder is proportional to popularity^alpha. Alpha and the logistic regression see
intruders of three kinds alike: uniform, drawn by popularity, and typical of another room type.

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
# At .5 the share of uniform intruders that is caught on sunrgbd falls from .47 to .35.
ALPHAS = (0.0, 0.125, 0.25, 0.375)
PULLS = (0.0, 0.1, 0.2, 0.5, 1.0)
ALARMS = {"low": 0.02, "medium": 0.1, "high": 0.2}
"""Shares of untouched scenes of the hardest large source that raise an alarm."""

# Lists of up to so many classes have thresholds of their own, where so many scenes tell them.
_SHORT_LISTS = 4
_SHORT_LIST_SCENES = 30
_NEVER = Thresholds(low=1.0, medium=1.0, high=1.0)
# Scenes of a source.
_PARTIAL_SCENES = 120
# Classes of a scene that are hidden in turn, where all but one are shown.
_DRAWS_OF_ONE = 4
# Real rooms that are smaller than what is drawn, and scenes of a room type that tell.
_SMALL = 0.1
_UNSUITED = 0.15
_ROOM_SCENES = 20
_EVIDENCE_SCENES = 400
# A machine without a closed form draws its answers, at a hundred times the cost.
_EVIDENCE_SCENES_OF_DRAWS = 100
# For the sake of others: what uniform intruders may lose of hit@1 and of the share caught, and what
# nearly complete lists may lose of MRR.
_UNIFORM_LOSS = np.array([0.04, 0.06])
_COMPLETE_LOSS = 0.002
_NEARLY_COMPLETE = ("75 %", "all but one")
# Pulls within so much of the best are as good: the least of them is taken.
_AS_GOOD = 0.006
# An answer lists ten classes by default; what is listed decides.
_LISTED = 10


def complete_scenes(scenes: SceneTensors, seed: int = 0) -> SceneTensors:
    """Scenes with complete object lists, or all where there are none.

    Of near-duplicates as many as their weight says.
    """
    rng = np.random.default_rng(seed)
    complete = scenes.complete.numpy()
    # A model of photographs alone has no others to be calibrated on.
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
    """The artifact's calibration with every entry of objects fitted.

    Args:
        validation: scenes that training has not seen.
        train: what popularity and signatures of room types are counted in.
        structure: (V,) bool.
        chosen: has what was chosen on other validation scenes (coverage and its weight, weights of
            evidence, alpha); without it they are chosen here.
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
    """The artifact with some entries of its calibration replaced."""
    return replace(artifact, calibration=artifact.calibration.model_copy(update=entries))


def popularity(train: SceneTensors) -> Floats:
    """Log-odds of finding each class in a complete training scene, (V,); 1/2 smooths both sides."""
    weight = train.weight * (train.complete if bool(train.complete.any()) else 1.0)
    count = (train.v * weight.unsqueeze(1)).sum(0).double().numpy()
    total = float(weight.sum())
    found: Floats = np.log((count + 0.5) / (total - count + 0.5))
    return found


def smallest_scenes(train: SceneTensors, structure: Tensor, rooms: int) -> tuple[int, ...]:
    """Classes that 90 % of the scenes of each room type have at least, and of all scenes, (C + 1,).

    A type of fewer than 20 scenes takes the entry of all.
    """
    sizes = ((train.v > 0) & ~structure).sum(1).numpy()
    every = int(np.quantile(sizes, _SMALL))
    of = [sizes[train.room.numpy() == t] for t in range(rooms)]
    found = [int(np.quantile(n, _SMALL)) if len(n) >= _ROOM_SCENES else every for n in of]
    return (*found, every)


def room_limits(artifact: Artifact, train: SceneTensors) -> tuple[float, ...]:
    """What 85 % of the scenes of each room type exceed of `room_fit`, (C,); -1e9 for few scenes."""
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
    """One scene of which a part is shown: log-odds (n,) of the unlisted classes, closed and by
    coverage; which of them are hidden; how many are listed; the share's name; its source; and how
    many scenes of that it stands for.
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
    """`coverage`, `coverage_weight` and `missing`."""
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
    """Coverage and weight of the best MRR, that nearly keep that of nearly complete lists."""
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
    # One hidden class of each scene alone would leave the choice to chance.
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
    """Mean over hidden classes of 1 / rank among the classes that are not hidden; sources alike."""
    found: dict[int, list[Floats]] = {}
    for case in cases:
        z = _mixed(case, coverage, weight)
        others = np.sort(z[~case.hidden])
        above = len(others) - np.searchsorted(others, z[case.hidden], side="right")
        found.setdefault(case.source, []).append(1.0 / (1.0 + above.astype(np.float64)))
    return float(np.mean([np.concatenate(own).mean() for own in found.values()]))


def _rows(case: _Shown, coverage: float, weight: float) -> Floats:
    """(n, 3) of the first so many classes: log-odds, log of the listed classes, hidden or not."""
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
    """`popularity_weight`, `outlier`, `outlier_thresholds` and `short_list_thresholds`.

    A robot that has just begun to look lists few classes of a scene. The probability is fitted to
    whole scenes and is too high there: in a procedural room a lone stove is rare. So such lists
    have thresholds of their own, by the same rule, on parts of the same scenes: no lower than those
    of whole scenes, and no higher than those of shorter lists.
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
    """The scenes of more classes than so many, and presence (N, V) of so many of them.

    Structure is listed as it was and does not count.
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
    """The alpha of the best mean of hit@1 and share caught, over kinds of intruders.

    An alpha is allowed if uniform intruders lose at most .04 of hit@1 and .06 of the share caught,
    against alpha 0.
    """
    found = {
        alpha: {name: _found(scores.with_prior(alpha * prior)) for name, scores in kinds.items()}
        for alpha in ALPHAS
    }
    floor = found[0.0].get("uniform", np.zeros(2)) - _UNIFORM_LOSS
    allowed = [alpha for alpha in ALPHAS if (found[alpha].get("uniform", floor) >= floor).all()]
    return max(allowed, key=lambda alpha: (sum(map(np.sum, found[alpha].values())), -alpha))


def _found(scores: IntruderScores) -> Floats:
    """(2,): hit@1, and the share caught where a tenth of untouched scenes raises an alarm."""
    worst = np.full(scores.scenes, np.inf)
    np.minimum.at(worst, scores.scene[scores.clean], scores.log_odds[scores.clean])
    limit = np.quantile(worst[np.isfinite(worst)], ALARMS["medium"])
    caught = (scores.log_odds[scores.intruder] <= limit).mean()
    return np.array([scores.hit_at_1().figure().value, caught])


# -------------------------------------------------------------------------------------- evidence


def fit_evidence(
    artifact: Artifact, validation: SceneTensors, structure: Tensor, seed: int = 0
) -> EvidenceWeights:
    """The pull of relations and poses on objects under which hidden classes rank best."""
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
    """The least pull that is as good as the best: what brings nothing may do harm elsewhere."""
    enough = max(scores.values()) - _AS_GOOD
    return min(pull for pull, score in scores.items() if score >= enough)


def _rank(artifact: Artifact, scene: Scene, target: int, structure: NDArray[np.bool_]) -> int:
    given = posterior(artifact, scene)
    absent = np.setdiff1d(np.flatnonzero(~structure), given.present.classes)
    z = given.absent_posterior(absent, artifact.calibration.coverage)
    return 1 + int((z > z[absent == target]).sum())
