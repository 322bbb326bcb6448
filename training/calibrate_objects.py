"""The calibration of what is said of objects: unlisted classes, intruders, and weights of evidence.

    coverage   the default and the share of the partial posterior, by the rank of hidden classes
    missing    p(there | not listed), on scenes of which 25, 50 and 75 % and all but one were shown
    placed     p(there and standing so to the anchor | not listed)
    outlier    p(intruder), where half of the scenes are clean, and its thresholds
    evidence   the pull of relations on what is said of objects

The prior of an intruder is proportional to popularity^alpha. Alpha and the logistic regression see
intruders of three kinds alike: uniform, drawn by popularity, and typical of another room type.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.reasoning.placements import place_log_p
from app.reasoning.plausible import room_fit
from app.reasoning.posterior import posterior
from app.registry import Artifact, Calibration, CountSlope, EvidenceWeights, PlacedSlope, Thresholds
from app.scene import Scene, SceneObject
from training.batches import SceneTensors
from training.cases import logistic, placed_case
from training.evaluation.alarms import alarm_threshold
from training.evaluation.evidence import removals
from training.evaluation.missing import machine_score
from training.evaluation.outliers import IntruderScores, by_popularity, intruder_scores
from training.evaluation.partial import SHARES, hide
from training.evaluation.signature import by_signature
from training.trainer import subset

Floats = NDArray[np.float64]

COVERAGES = (0.3, 0.5, 0.7)
WEIGHTS = (0.3, 0.5, 0.7, 1.0)
ALPHAS = (0.0, 0.125, 0.25, 0.375, 0.5)
PULLS = (0.0, 0.1, 0.2, 0.5, 1.0)
ALARMS = {"low": 0.02, "medium": 0.1, "high": 0.2}
"""Shares of untouched scenes of the hardest large source that raise an alarm."""

# Scenes of a source.
_PARTIAL_SCENES = 120
_PLACED_SCENES = 600
# Real rooms that are smaller than what is drawn, and scenes of a room type that tell.
_SMALL = 0.1
_UNSUITED = 0.15
_ROOM_SCENES = 20
_EVIDENCE_SCENES = 150
# How far uniform intruders may fall, and what all but one may lose, for the sake of the others.
_UNIFORM_LOSS = 0.04
_COMPLETE_LOSS = 0.006
# Pulls within so much of the best are as good: the least of them is taken.
_AS_GOOD = 0.003
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
) -> Calibration:
    """The artifact's calibration with every entry of objects fitted.

    Args:
        validation: scenes that training has not seen.
        train: what popularity and signatures of room types are counted in.
        structure: (V,) bool.
    """
    scenes = complete_scenes(validation, seed)
    if not len(scenes):
        return artifact.calibration
    every = validation.complete if bool(validation.complete.any()) else ~validation.complete
    every_scene = subset(validation, every.nonzero().squeeze(1))
    learnt = complete_scenes(train, seed)
    calibration = artifact.calibration.model_copy(
        update={"popularity": tuple(np.round(popularity(train), 4).tolist())}
    )
    calibration = calibration.model_copy(
        update=fit_coverage(artifact, every_scene, structure, seed)
    )
    artifact = replace(artifact, calibration=calibration)
    weights = fit_evidence(artifact, validation, structure, seed)
    calibration = calibration.model_copy(update={"evidence": weights})
    artifact = replace(artifact, calibration=calibration)
    update = fit_outliers(artifact, scenes, learnt, structure, seed)
    update |= {"smallest": smallest_scenes(learnt, structure, artifact.machine.spec.C)}
    update |= {"room_fit": room_limits(artifact, learnt)}
    return calibration.model_copy(update=update)


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
    for t in range(artifact.machine.spec.C):
        own = train.v[train.room == t].numpy()
        limit = -1e9
        if len(own) >= _ROOM_SCENES:
            limit = float(np.quantile(room_fit(artifact.machine, own, t), _UNSUITED))
        found.append(round(limit, 4))
    return tuple(found)


# ------------------------------------------------------------------------------ unlisted classes


@dataclass(frozen=True, eq=False)
class _Shown:
    """One scene of which a part is shown: log-odds (n,) of the unlisted classes, closed and by
    coverage; which of them are hidden; how many are listed; the share's name.
    """

    closed: Floats
    partial: dict[float, Floats]
    hidden: NDArray[np.bool_]
    listed: int
    share: str


def fit_coverage(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, seed: int = 0
) -> dict[str, Any]:
    """`coverage`, `coverage_weight` and `missing`."""
    cases = list(_shown(artifact, scenes, structure, seed))
    if not cases:
        return {}
    best, chosen = -np.inf, (artifact.calibration.coverage, 0.0)
    alone = _mrr([case for case in cases if case.share == "all but one"], 0.5, 0.0)
    for coverage in COVERAGES if artifact.completions is not None else ():
        for weight in WEIGHTS:
            nearly = [case for case in cases if case.share == "all but one"]
            if _mrr(nearly, coverage, weight) < alone - _COMPLETE_LOSS:
                continue
            score = _mrr(cases, coverage, weight)
            if score > best:
                best, chosen = score, (coverage, weight)
    coverage, weight = chosen
    rows = [_rows(case, coverage, weight) for case in cases]
    examples = np.concatenate(rows)
    entry = CountSlope()
    if len(np.unique(examples[:, 2])) == 2:
        slope, count, intercept = logistic(examples[:, :2], examples[:, 2] > 0)
        entry = CountSlope(intercept=intercept, slope=slope, log_count=count)
    return {"coverage": coverage, "coverage_weight": weight, "missing": entry}


def _shown(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, seed: int
) -> Iterable[_Shown]:
    order = torch.randperm(len(scenes), generator=torch.Generator().manual_seed(seed))
    source = scenes.source[order]
    place = torch.zeros(len(order), dtype=torch.int64)
    for one in source.unique():
        place[source == one] = torch.arange(int((source == one).sum()))
    some = subset(scenes, order[place < _PARTIAL_SCENES])
    whole = replace(
        artifact, calibration=artifact.calibration.model_copy(update={"coverage_weight": 1.0})
    )
    for name, share in SHARES.items():
        cases = hide(some, structure, share, seed)
        for v, hidden in zip(cases.v.numpy(), cases.hidden.numpy(), strict=True):
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
            yield _Shown(closed, partial, hidden[absent], listed, name)


def _labels(classes: NDArray[np.int64]) -> Scene:
    return Scene(tuple(SceneObject(str(c), str(c), int(c)) for c in classes))


def _mixed(case: _Shown, coverage: float, weight: float) -> Floats:
    closed = case.closed + np.log1p(-coverage)
    if not weight:
        return closed
    mixed: Floats = (1 - weight) * closed + weight * case.partial[coverage]
    return mixed


def _mrr(cases: Sequence[_Shown], coverage: float, weight: float) -> float:
    """Mean over hidden classes of 1 / rank among the classes that are not hidden."""
    found: list[Floats] = []
    for case in cases:
        z = _mixed(case, coverage, weight)
        others = np.sort(z[~case.hidden])
        above = len(others) - np.searchsorted(others, z[case.hidden], side="right")
        found.append(1.0 / (1.0 + above.astype(np.float64)))
    return float(np.concatenate(found).mean())


def _rows(case: _Shown, coverage: float, weight: float) -> Floats:
    """(n, 3) of the first so many classes: log-odds, log of the listed classes, hidden or not."""
    z = _mixed(case, coverage, weight)
    first = np.argsort(-z, kind="stable")[:_LISTED]
    size = np.full(len(first), np.log(case.listed))
    return np.stack([z[first], size, case.hidden[first]], 1)


def fit_placed(artifact: Artifact, validation: SceneTensors, seed: int = 0) -> PlacedSlope:
    """A class that was taken away, with a relation to what stayed, against all others there."""
    rng = np.random.default_rng(seed)
    structure = artifact.vocabulary.structure
    rows: list[Floats] = []
    related = [s for s in validation.scenes if s.evidence.holds.any()]
    for place in rng.permutation(len(related))[:_PLACED_SCENES]:
        case = placed_case(related[place], structure, rng)
        if case is None:
            continue
        scene, relation, anchor, target = case
        given = posterior(artifact, replace(scene, room_type=None))
        absent = np.setdiff1d(np.flatnonzero(~structure), given.present.classes)
        z = given.absent_posterior(absent, artifact.calibration.coverage).astype(np.float64)
        row = int(given.present.row[anchor])
        log_p = place_log_p(artifact, given, absent, relation, row, outgoing=True)
        first = np.argsort(-(z + log_p), kind="stable")[:_LISTED]
        size = np.log(max(1, int(np.count_nonzero(~structure[given.present.classes]))))
        truth = absent[first] == target
        rows.append(np.stack([z[first], np.full(len(first), size), log_p[first], truth], 1))
    examples = np.concatenate(rows or [np.zeros((0, 4))])
    if len(examples) < 50 or len(np.unique(examples[:, 3])) < 2:
        return PlacedSlope()
    slope, count, relation_slope, intercept = logistic(examples[:, :3], examples[:, 3] > 0)
    return PlacedSlope(
        intercept=intercept, slope=slope, log_count=count, log_relation=relation_slope
    )


# ------------------------------------------------------------------------------------- intruders


def fit_outliers(
    artifact: Artifact,
    scenes: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    seed: int = 0,
) -> dict[str, Any]:
    """`popularity_weight`, `outlier` and `outlier_thresholds`."""
    score = machine_score(artifact.machine)
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
    alpha = choose_alpha(kinds, prior)
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
    logits = intercept + slope * untouched.log_odds + size * np.log(untouched.size)
    limits = {
        name: float(1 / (1 + np.exp(-alarm_threshold(logits, untouched, scenes, rng, share))))
        for name, share in ALARMS.items()
    }
    return {
        "popularity_weight": alpha,
        "outlier": entry,
        "outlier_thresholds": Thresholds(**limits),
    }


def choose_alpha(kinds: dict[str, IntruderScores], prior: Floats) -> float:
    """The alpha of the best mean hit@1 over kinds of intruders that keeps the uniform ones."""
    hits = {
        alpha: {
            name: found.with_prior(alpha * prior).hit_at_1().figure().value
            for name, found in kinds.items()
        }
        for alpha in ALPHAS
    }
    floor = hits[0.0].get("uniform", 0.0) - _UNIFORM_LOSS
    allowed = [alpha for alpha in ALPHAS if hits[alpha].get("uniform", 1.0) >= floor]
    return max(allowed, key=lambda alpha: (sum(hits[alpha].values()), -alpha))


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
    chosen = rng.permutation(related)[:_EVIDENCE_SCENES].astype(np.int64)
    some = subset(scenes, torch.from_numpy(chosen))
    if not len(some):
        return found
    for kind, name in (("relations", "relations_on_objects"), ("poses", "poses_on_objects")):
        cases = list(removals(some, plain, kind, seed))
        if not cases:
            continue
        scores = {}
        for pull in PULLS:
            weights = found.model_copy(update={name: pull})
            asked = replace(
                artifact,
                calibration=artifact.calibration.model_copy(update={"evidence": weights}),
            )
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
