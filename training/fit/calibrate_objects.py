"""Fit the calibration of answers about objects to short lists: random parts of validation scenes.

    coverage   Listed share that the answers assume: the share with the best rank of hidden classes.
    missing    Probability that an unlisted class is present, fitted to the first classes of parts
               of each number of classes. Written places have far more things than a person or a
               detector lists, so these parts are not written, unless all scenes are.
    covered    The same in parts of a stated share of the scene, written scenes included.
    outlier    Probability that a class is an intruder. Half of the parts contain an intruder.
    lines      An object is an outlier if its log-odds of being an intruder are above a line in the
               log of the number of listed classes. Each line raises alarms in a given share of the
               untouched parts (`ALARMS`), with and without the room type.

The prior of an intruder class is proportional to (frequency of the class)^alpha. Alpha and the
logistic regression are fitted to three kinds of intruders with equal weights. Intruders are drawn
uniformly, by the frequency of classes, or from the typical classes of another room type.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app.model import AlarmLine, AlarmLines, Calibration, CountSlope, CoverageFit, SceneModel
from app.model.calibration import LEAST_COVERAGE, LONGEST_JUDGED
from app.questions.posterior import Posterior, calibrated
from training.datasets.array_types import ClassMask
from training.datasets.batches import SceneTensors, TrainingData, subset
from training.evaluation.outlier_tasks import ALARMS, draw_intruders, intruder_weights
from training.evaluation.parts import (
    Parts,
    Size,
    all_but_one,
    draw_parts,
    exactly,
    share_of,
    up_to_longest,
)
from training.fit.calibrate_doubt import fit_doubt
from training.fit.calibrate_rooms import (
    calibrate_rooms,
    limits,
    listed_scene,
    of_sources,
    posterior_of,
)
from training.fit.calibrate_where import fit_where
from training.fit.configuration import ObjectsConfig
from training.fit.regression import (
    LEAST_SCENES,
    RIDGE,
    fit_count_slope,
    logistic,
    quantile_of,
    recalibrated,
    structure_of,
)

COVERAGES = (0.15, 0.3, 0.45, 0.6, 0.8)
# Tested exponents alpha of the prior of intruders.
ALPHAS = (0.0, 0.125, 0.25, 0.375, 0.5)
LENGTHS = (1, 2, 3, 4, 5, 6, 8, 10, 12)  # numbers of listed classes to which `missing` is fitted
JUDGED_LENGTHS = (*LENGTHS[1:], 16, 24, LONGEST_JUDGED)
"""Numbers of listed classes to which the alarm lines are fitted: a single class is not judged."""
COVERED = (0.15, 0.25, 0.5, 0.75, 0.9)
"""Shares of a scene to which `covered` is fitted, besides all classes but one."""
MARGIN = 0.65
"""Share of the permitted alarms at which the lines aim, because foreign sources raise up to half as
many alarms again as the sources of the fit."""

_SEEDS = (0, 1, 2)
_LISTED = 10  # classes in the fit of each part; an answer of the service lists ten by default
_SOURCE_SCENES = 200  # maximum scenes of each source


def calibrate_objects(
    artifact: SceneModel,
    validation: SceneTensors,
    train: SceneTensors,  # gives the intruders, and limits for room types
    popularity: Float[Tensor, "V"],  # log-odds in the served mix; NaN without training scenes
    sources: Collection[str],  # see `calibration_scenes`
    seed: int = 0,
    chosen: Calibration | None = None,  # coverage and alpha are copied
) -> Calibration:
    """Return the model's calibration with newly fitted entries about objects."""
    scenes = calibration_scenes(validation, sources)
    learnt = complete_scenes(train, seed)
    rounded = tuple(None if math.isnan(x) else round(x, 4) for x in popularity.double().tolist())
    artifact = recalibrated(artifact, popularity=rounded)
    artifact = recalibrated(artifact, **fit_outliers(artifact, scenes, learnt, chosen))
    artifact = recalibrated(artifact, **fit_doubt(artifact, scenes.scenes, seed))
    # Other answers weight the listed objects by the doubt about them.
    entries = fit_missing(artifact, scenes, chosen) | calibrate_rooms(artifact, scenes, learnt)
    artifact = recalibrated(artifact, **entries)
    return recalibrated(artifact, where=fit_where(artifact, validation.scenes, seed)).calibration


def complete_scenes(scenes: SceneTensors, seed: int = 0) -> SceneTensors:
    """Keep complete scenes (without any, all), each with its weight as the probability."""
    rng = np.random.default_rng(seed)
    complete = scenes.complete.numpy()
    complete = complete if complete.any() else ~complete
    mask = complete & (rng.random(len(scenes)) < scenes.weight.numpy())
    return subset(scenes, torch.from_numpy(mask))


def calibration_scenes(scenes: SceneTensors, sources: Collection[str]) -> SceneTensors:
    """Return 20 to 200 scenes of each of the `sources`; without these, complete scenes of all."""
    names, size = scenes.source_names, scenes.source.bincount(minlength=len(scenes.source_names))
    chosen = [
        index for index, name in enumerate(names) if name in sources and size[index] >= LEAST_SCENES
    ]
    if not chosen:
        scenes = complete_scenes(scenes)
        chosen = scenes.source.unique().tolist()
    kept: list[int] = []
    for source in chosen:
        index = np.flatnonzero(scenes.source.numpy() == source)
        kept += np.random.default_rng(0).permutation(index)[:_SOURCE_SCENES].tolist()
    return subset(scenes, torch.tensor(sorted(kept), dtype=torch.int64))


def fit_missing(
    artifact: SceneModel, scenes: SceneTensors, chosen: Calibration | None = None
) -> dict[str, Any]:
    """Fit the entries `coverage`, `missing` and `covered` of the calibration."""
    structure = structure_of(artifact)
    seen = subset(scenes, ~of_sources(scenes, "written"))
    used = seen if len(seen) >= LEAST_SCENES else scenes
    lists = _draw_lists(used, structure, map(exactly, LENGTHS))
    if not len(lists.v):
        return {}
    coverages = COVERAGES if chosen is None else (chosen.coverage,)
    log_odds = unlisted_log_odds(artifact, lists.v, coverages)
    best = int(np.argmax([_mean_reciprocal_rank(values, lists) for values in log_odds]))
    first_log_odds, row, truth = _first_classes(log_odds[best], lists)
    log_n = np.log(np.maximum(lists.v.sum(1).numpy(), 1))  # of the listed classes
    entries: dict[str, Any] = {"coverage": coverages[best]}
    if (missing := fit_count_slope(first_log_odds, log_n[row], truth)) is not None:
        entries["missing"] = missing
    parts = _draw_lists(scenes, structure, (*map(share_of, COVERED), all_but_one))
    if len(parts.v):
        entries["covered"] = _fit_covered(artifact, parts)
    return entries


def _fit_covered(artifact: SceneModel, parts: _Lists) -> CoverageFit:
    """Fit `covered` to the first classes of parts, given the share of the scene that they list."""
    n, hidden = parts.v.sum(1).numpy(), parts.hidden.sum(1)  # numbers of classes of each part
    # The model's base rates for a complete list are those of all classes but one.
    share = np.where(hidden == 1, 1.0, n / (n + hidden))
    every = np.arange(artifact.spec.V)
    lists = zip(parts.v, share.tolist(), strict=True)
    rows = [posterior_of(artifact, v).absent_log_odds(every, s) for v, s in lists]
    log_odds, row, truth = _first_classes(np.array(rows, np.float64), parts)
    if len(np.unique(truth)) < 2:
        return CoverageFit()
    log_n, log_s = np.log(n)[row], np.log(np.maximum(share, LEAST_COVERAGE))[row]
    features = np.stack([log_odds, log_n, log_s, log_n * log_s, share[row] == 1], 1)
    *slopes, intercept = logistic(features, truth, C=RIDGE)
    names = ("slope", "log_count", "log_share", "both", "last")
    return CoverageFit(intercept=intercept, **dict(zip(names, slopes, strict=True)))


class _Lists(NamedTuple):
    """N parts of scenes."""

    v: Float[Tensor, "N V"]  # 1 for listed classes
    hidden: Bool[NDArray, "N V"]
    candidates: Bool[NDArray, "N V"]  # classes that an answer may list
    annotated: Bool[NDArray, "N V"]  # classes that the data source of the scene can show


def _draw_lists(
    scenes: SceneTensors, structure: Bool[Tensor, "V"], sizes: Iterable[Size]
) -> _Lists:
    """Draw a part of each scene for each size. Relatives of listed classes are no candidates."""
    drawn = [draw_parts(scenes, structure, size) for size in sizes]
    v, hidden, related, scene = (
        torch.cat([getattr(parts, name) for parts in drawn])
        for name in ("v", "hidden", "related", "scene")
    )
    candidates = (v == 0) & ~structure & ~related
    annotated = scenes.annotated_classes[scenes.source[scene]]
    return _Lists(v, (hidden & ~related).numpy(), candidates.numpy(), annotated.numpy())


def unlisted_log_odds(
    artifact: SceneModel, v: Float[Tensor, "N V"], coverages: Sequence[float]
) -> Float[NDArray, "coverages N V"]:
    """Return the log-odds of every class given the listed classes v, for each coverage."""
    every, posteriors = np.arange(artifact.spec.V), (posterior_of(artifact, row) for row in v)
    rows = [[posterior.absent_log_odds(every, c) for c in coverages] for posterior in posteriors]
    return np.stack(rows, 1)


def _mean_reciprocal_rank(log_odds: Float[NDArray, "N V"], parts: _Lists) -> float:
    """Return the mean reciprocal rank of hidden classes among candidates that are not hidden."""
    means = []
    for row, usable, hidden in zip(log_odds, parts.candidates, parts.hidden, strict=True):
        if not hidden.any():
            continue
        others = np.sort(row[usable & ~hidden])
        above = len(others) - np.searchsorted(others, row[hidden], side="right")
        means.append((1.0 / (1.0 + above)).mean())
    return float(np.mean(means))


def _first_classes(
    log_odds: Float[NDArray, "N V"], parts: _Lists
) -> tuple[Float[NDArray, "k"], Int[NDArray, "k"], Bool[NDArray, "k"]]:
    """Return log-odds, part and truth (hidden) of the `_LISTED` likeliest candidates of parts."""
    keys = np.where(parts.candidates, -log_odds, np.inf)
    first = np.argsort(keys, axis=1, kind="stable")[:, :_LISTED]
    rows = np.broadcast_to(np.arange(len(log_odds))[:, None], first.shape)
    # With few candidates, other classes fill the list. Unannotated classes have no known truth.
    usable = (parts.candidates & parts.annotated)[rows, first]
    row, classes = rows[usable], first[usable]
    return log_odds[row, classes].astype(np.float64), row, parts.hidden[row, classes]


@dataclass(frozen=True, eq=False)
class ListScores:
    """Log-odds of the n listed classes of N lists."""

    row: Int[NDArray, "n"]  # list of each listed class
    log_odds: Float[NDArray, "n"]  # of each listed class given the rest of its list
    popularity: Float[NDArray, "n"]  # log-odds of each class in the served mix
    intruder: Bool[NDArray, "n"]
    can_alarm: Bool[NDArray, "n"]  # False for classes without alarms (`SceneModel.rarely_shown`)
    size: Int[NDArray, "N"]  # number of listed classes of each list

    def score(self, alpha: float) -> Float[NDArray, "n"]:
        """Return log-odds with the prior of intruders; low values mean intruders."""
        return self.log_odds - alpha * self.popularity

    def largest(self, values: Float[NDArray, "n"]) -> Float[NDArray, "N"]:
        worst = np.full(len(self.size), -np.inf)
        np.maximum.at(worst, self.row, values)
        return worst


def fit_outliers(
    artifact: SceneModel,
    scenes: SceneTensors,
    train: SceneTensors,
    chosen: Calibration | None = None,
) -> dict[str, Any]:
    """Fit the calibration of outliers on random parts of scenes, with and without an intruder."""
    if len(scenes) < LEAST_SCENES:
        return {}
    untouched = score_untouched(artifact, scenes)
    laws = intruder_weights(scenes, train).values()
    scored = (score_intruders(artifact, scenes, weights) for weights in laws)
    with_intruder = [scores for scores in scored if len(scores.size)]
    if not untouched or not with_intruder:
        return {}
    alpha = chosen.popularity_weight if chosen else choose_alpha(untouched.values(), with_intruder)
    entry = _fit_intruders(untouched.values(), with_intruder, alpha)
    lines = fit_lines(artifact, scenes, entry, alpha) if entry else {}
    return {"popularity_weight": alpha, "outlier": entry, **lines}


def refitted(artifact: SceneModel, data: TrainingData, config: ObjectsConfig) -> SceneModel:
    """Return the model with new limits of generated scenes, and new alarm lines if it has any."""
    scenes = calibration_scenes(data.validation, config.calibrated_sources)
    entry, alpha = artifact.calibration.outlier, artifact.calibration.popularity_weight
    if entry is not None:
        artifact = recalibrated(artifact, **fit_lines(artifact, scenes, entry, alpha))
    return recalibrated(artifact, **limits(artifact, complete_scenes(data.train)))


def judged_classes(artifact: SceneModel) -> ClassMask:
    """Return the classes that can be intruders and that training shows."""
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    return artifact.vocabulary.judged & ~np.isnan(popularity)


def score_lists(
    artifact: SceneModel,
    parts: Parts,
    intruders: Int[Tensor, "N"] | None = None,
    rooms: Sequence[int] | None = None,
) -> ListScores:
    """Return the scores of N parts of scenes, with an intruder and a room type of each part."""
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    v = parts.v.numpy() > 0
    is_intruder = np.zeros_like(v)
    if intruders is not None:
        is_intruder[np.arange(len(v)), intruders.numpy()] = True
        v = v | is_intruder
    log_odds = np.zeros(v.shape)
    for k, (row, values) in enumerate(zip(v, log_odds, strict=True)):
        room = None if rooms is None else rooms[k]
        # The log-odds of each listed class given the other listed classes.
        values[row] = Posterior(artifact, listed_scene(torch.from_numpy(row), room)).given_rest()[0]
    row, classes = at = np.nonzero(v & judged_classes(artifact))
    can_alarm = ~artifact.rarely_shown[classes]
    return ListScores(row, log_odds[at], popularity[classes], is_intruder[at], can_alarm, v.sum(1))


def score_untouched(
    artifact: SceneModel, scenes: SceneTensors, *, in_room: bool = False
) -> dict[int, ListScores]:
    """Return the scores of random parts by length; with `in_room`, given the room type."""
    if in_room:
        scenes = subset(scenes, scenes.room >= 0)
    scores: dict[int, ListScores] = {}
    for n in JUDGED_LENGTHS:
        parts = draw_parts(scenes, structure_of(artifact), exactly(n), _SEEDS)
        if len(parts.v) >= LEAST_SCENES:
            rooms = scenes.room[parts.scene].tolist() if in_room else None
            scores[n] = score_lists(artifact, parts, rooms=rooms)
    return scores


def score_intruders(
    artifact: SceneModel, scenes: SceneTensors, weights: Tensor | None
) -> ListScores:
    """Return the scores of random parts of scenes, each with an intruder drawn by the weights."""
    intruders = draw_intruders(scenes, torch.from_numpy(~judged_classes(artifact)), weights)
    kept = (intruders >= 0).nonzero().squeeze(1)
    parts = draw_parts(subset(scenes, kept), structure_of(artifact), up_to_longest, _SEEDS)
    return score_lists(artifact, parts, intruders[kept][parts.scene])


def choose_alpha(untouched: Collection[ListScores], altered: Collection[ListScores]) -> float:
    """Return the alpha with the best mean of hit@1 and detected share over the intruder kinds."""

    def rate(alpha: float) -> float:
        worst = [scores.largest(-scores.score(alpha)) for scores in untouched]
        limit = float(np.mean([np.quantile(values, 1 - ALARMS["medium"]) for values in worst]))
        return float(np.mean([_detection(scores, alpha, limit) for scores in altered]))

    return max(ALPHAS, key=lambda alpha: (rate(alpha), -alpha))


def _detection(scores: ListScores, alpha: float, limit: float) -> float:
    """Return the mean of hit@1 and of the share of intruders above a limit."""
    values = -scores.score(alpha)
    first = values >= scores.largest(values)[scores.row]
    return float(first[scores.intruder].mean() + (values > limit)[scores.intruder].mean()) / 2


def _fit_intruders(
    untouched: Collection[ListScores], altered: Collection[ListScores], alpha: float
) -> CountSlope | None:
    """Fit the log-odds of being an intruder, with half of the lists altered."""
    columns = [
        (
            scores.score(alpha),
            np.log(scores.size[scores.row]),
            scores.intruder,
            np.full(len(scores.row), 1 / (len(group) * len(scores.size))),
        )
        for group in (untouched, altered)
        for scores in group
    ]
    score, log_size, truth, weight = map(np.concatenate, zip(*columns, strict=True))
    return fit_count_slope(score, log_size, truth, weight * (len(weight) / weight.sum()))


def fit_lines(
    artifact: SceneModel, scenes: SceneTensors, entry: CountSlope, alpha: float
) -> dict[str, AlarmLines | None]:
    """Return the lines of a `Calibration` without and with the room type; None with few lists."""
    fields: dict[str, AlarmLines | None] = {}
    for name, in_room in (("outlier_lines", False), ("room_lines", True)):
        untouched = score_untouched(artifact, scenes, in_room=in_room)
        worst = worst_log_odds(untouched, entry, alpha)
        lines = {level: fit_line(worst, share) for level, share in ALARMS.items() if worst}
        fields[name] = AlarmLines(**lines) if lines else None
    return fields


def fit_line(worst: Mapping[int, Float[NDArray, "N"]], share: float) -> AlarmLine:
    """Return a line above which about `MARGIN` times the share of the lists has an object.

    `worst` has the largest log-odds of each list by length. The shape is the weighted parabola in
    the log of the length through the quantiles of medium sensitivity, so two lines never cross:
    short lists say little, and long ones contain rare things. Below five lengths it is a straight
    line, below three a constant. The intercept makes the mean share over the lengths right.
    """
    sizes, lists = np.log(list(worst)), list(worst.values())
    quantiles = [np.quantile(values, 1 - MARGIN * ALARMS["medium"]) for values in lists]
    numbers = np.sqrt([len(values) for values in lists])
    fit = np.polyfit(sizes, quantiles, min(2, (len(sizes) - 1) // 2), w=numbers)
    curve, slope, _ = (0.0, 0.0, *fit.tolist())[-3:]
    line = (curve * sizes + slope) * sizes  # height of the shape at each length
    above = np.concatenate([values - height for values, height in zip(lists, line, strict=True)])
    weight = np.concatenate([np.full(len(values), 1 / len(values)) for values in lists])
    limit = quantile_of(above, weight, 1 - MARGIN * share)
    return AlarmLine(intercept=limit, log_count=slope, curve=curve)


def worst_log_odds(
    untouched: Mapping[int, ListScores], entry: CountSlope, alpha: float
) -> dict[int, Float[NDArray, "N"]]:
    """Return the largest log-odds of an intruder in each of N lists without one, by their length.

    `alpha` is the exponent of the popularity of intruders.
    """
    worst = {}
    for n, scores in untouched.items():
        log_odds = calibrated(entry, scores.score(alpha), scores.size[scores.row])
        worst[n] = scores.largest(np.where(scores.can_alarm, log_odds, -np.inf))
    return worst
