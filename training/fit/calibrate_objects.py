"""Fit the calibration of answers about objects to short lists.

A robot lists a few objects of a room. So all fits use random parts of validation scenes
(`calibration_scenes`). Structure is not listed.

    coverage   Listed share that the answers assume: the share with the best rank of hidden classes.
    missing    Probability that an unlisted class is present, fitted to the first classes of parts
               of each number of classes. Written places have far more things than a person or a
               detector lists of a room. So these parts are not written, unless all scenes are.
    covered    The same in parts of a stated share of the scene, written scenes included.
    outlier    Probability that a class is an intruder. Half of the parts contain an intruder.
    lines      An object is an outlier if its log-odds of being an intruder are above a line in the
               log of the number of listed classes. Each line raises alarms in a given share of the
               untouched parts (`training.evaluation.alarms.ALARMS`), with and without the room
               type. A class that few training scenes show raises no alarm.

The prior of an intruder class is proportional to (frequency of the class)^alpha. Alpha and the
logistic regression are fitted to three kinds of intruders with equal weights. Intruders are drawn
uniformly, by the frequency of classes, or from the typical classes of another room type.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from app.model import AlarmLine, AlarmLines, Calibration, CountSlope, CoverageFit, SceneModel
from app.model.calibration import LEAST_COVERAGE, LONGEST_JUDGED
from app.questions.posterior import calibrated
from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import RIDGE, logistic
from training.datasets.sources import source_of
from training.evaluation.alarms import ALARMS
from training.evaluation.intruders import draw_intruders, intruder_weights
from training.evaluation.parts import (
    Parts,
    Size,
    all_but_one,
    draw_parts,
    exactly,
    share_of,
    up_to_longest,
)
from training.fit.calibrate_rooms import calibrate_rooms, posterior_of, quantile_of
from training.fit.configuration import ObjectsConfig

COVERAGES = (0.15, 0.3, 0.45, 0.6, 0.8)
# Tested exponents alpha of the prior of intruders.
ALPHAS = (0.0, 0.125, 0.25, 0.375, 0.5)
LENGTHS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
"""Numbers of listed classes to which `missing` is fitted."""
JUDGED_LENGTHS = (*LENGTHS[1:], 16, 24, LONGEST_JUDGED)
"""Numbers of listed classes to which the alarm lines are fitted: a single class is not judged."""
COVERED = (0.15, 0.25, 0.5, 0.75, 0.9)
"""Shares of a scene to which `covered` is fitted, besides all classes but one."""
MARGIN = 0.65
"""Share of the permitted alarms at which the lines aim, because foreign sources raise up to half as
many alarms again as the sources of the fit."""

_LEAST_SCENES = 20  # from which objects are judged
_SEEDS = (0, 1, 2)
_LISTED = 10  # classes in the fit of each part; an answer of the service lists ten by default
_SOURCE_SCENES = 200  # maximum scenes of each source


def calibrate_objects(
    artifact: SceneModel,
    validation: SceneTensors,
    train: SceneTensors,
    popularity: Tensor,
    sources: Collection[str],
    seed: int = 0,
    chosen: Calibration | None = None,
) -> Calibration:
    """Return the model's calibration with newly fitted entries about objects.

    The training scenes give the intruders, and limits for room types. The coverage and alpha of a
    `chosen` calibration are copied.

    Args:
        popularity: log-odds of each class in the served mix of sources, (classes,); NaN for a
            class without a training scene.
        sources: see `calibration_scenes`.
    """
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    scenes = calibration_scenes(validation, sources)
    learnt = complete_scenes(train, seed)
    rounded = tuple(None if math.isnan(x) else round(x, 4) for x in popularity.double().tolist())
    artifact = recalibrated(artifact, popularity=rounded)
    artifact = recalibrated(artifact, **fit_missing(artifact, scenes, structure, chosen))
    entries = fit_outliers(artifact, scenes, learnt, structure, chosen)
    entries |= calibrate_rooms(artifact, scenes, learnt, structure)
    return recalibrated(artifact, **entries).calibration


def recalibrated(artifact: SceneModel, **entries: Any) -> SceneModel:
    """Return a copy of the model in which some entries of the calibration are replaced."""
    return replace(artifact, calibration=artifact.calibration.model_copy(update=entries))


def complete_scenes(scenes: SceneTensors, seed: int = 0) -> SceneTensors:
    """Return the scenes with complete object lists, or all scenes if no list is complete.

    A near-duplicate scene is kept with a probability equal to its weight.
    """
    rng = np.random.default_rng(seed)
    complete = scenes.complete.numpy()
    complete = complete if complete.any() else ~complete
    mask = complete & (rng.random(len(scenes)) < scenes.weight.numpy())
    return subset(scenes, torch.from_numpy(np.flatnonzero(mask)))


def calibration_scenes(scenes: SceneTensors, sources: Collection[str]) -> SceneTensors:
    """Return the scenes of the named sources with at least 20 scenes.

    Without such a source, they are all scenes with complete object lists. At most 200 scenes of a
    source take part.
    """
    names, size = scenes.source_names, scenes.source.bincount(minlength=len(scenes.source_names))
    chosen = [
        index
        for index, name in enumerate(names)
        if name in sources and size[index] >= _LEAST_SCENES
    ]
    if not chosen:
        scenes = complete_scenes(scenes)
        chosen = scenes.source.unique().tolist()
    kept: list[int] = []
    for source in chosen:
        index = np.flatnonzero(scenes.source.numpy() == source)
        kept += np.random.default_rng(0).permutation(index)[:_SOURCE_SCENES].tolist()
    return subset(scenes, torch.tensor(sorted(kept), dtype=torch.int64))


def written_scenes(scenes: SceneTensors, *, written: bool = True) -> SceneTensors:
    """Return the scenes of written sources, or of the other sources."""
    chosen = torch.tensor([source_of(name).written == written for name in scenes.source_names])
    return subset(scenes, chosen[scenes.source].nonzero().squeeze(1))


def fit_missing(
    artifact: SceneModel, scenes: SceneTensors, structure: Tensor, chosen: Calibration | None = None
) -> dict[str, Any]:
    """Fit the entries `coverage`, `missing` and `covered` of the calibration."""
    seen = written_scenes(scenes, written=False)
    used = seen if len(seen) >= _LEAST_SCENES else scenes
    lists = _joined(used, structure, map(exactly, LENGTHS))
    if not len(lists.v):
        return {}
    coverages = COVERAGES if chosen is None else (chosen.coverage,)
    log_odds = unlisted_log_odds(artifact, lists.v, coverages)
    best = int(np.argmax([_mean_rank(z, lists) for z in log_odds]))
    z, row, truth = _first_classes(log_odds[best], lists)
    log_n = np.log(np.maximum(lists.v.sum(1).numpy(), 1))
    entries: dict[str, Any] = {"coverage": coverages[best]}
    if len(np.unique(truth)) == 2:
        slope, count, intercept = logistic(np.stack([z, log_n[row]], 1), truth, C=RIDGE)
        entries["missing"] = CountSlope(intercept=intercept, slope=slope, log_count=count)
    parts = _joined(scenes, structure, (*map(share_of, COVERED), all_but_one))
    if len(parts.v):
        entries["covered"] = _fit_covered(artifact, parts)
    return entries


def _fit_covered(artifact: SceneModel, parts: _Lists) -> CoverageFit:
    """Fit `covered` to the first classes of parts, each asked with its share of the scene."""
    n, hidden = parts.v.sum(1).numpy(), parts.hidden.sum(1)
    # The model's base rates for a complete list are those of all classes but one.
    share = np.where(hidden == 1, 1.0, n / (n + hidden))
    every = np.arange(artifact.spec.V)
    asked = zip(parts.v, share.tolist(), strict=True)
    rows = [posterior_of(artifact, v).absent_log_odds(every, s) for v, s in asked]
    z, row, truth = _first_classes(np.array(rows, np.float64), parts)
    if len(np.unique(truth)) < 2:
        return CoverageFit()
    log_n, log_s = np.log(n)[row], np.log(np.maximum(share, LEAST_COVERAGE))[row]
    features = np.stack([z, log_n, log_s, log_n * log_s, share[row] == 1], 1)
    *slopes, intercept = logistic(features, truth, C=RIDGE)
    names = ("slope", "log_count", "log_share", "both", "last")
    return CoverageFit(intercept=intercept, **dict(zip(names, slopes, strict=True)))


class _Lists(NamedTuple):
    """Parts of scenes as arrays over the classes, (parts, classes).

    Attributes:
        v: 1 for listed classes.
        hidden, candidates: True for hidden classes, and for classes that an answer may list.
        annotated: True for the classes that the data source of the scene can show.
    """

    v: Tensor
    hidden: Flags
    candidates: Flags
    annotated: Flags


def _joined(scenes: SceneTensors, structure: Tensor, sizes: Iterable[Size]) -> _Lists:
    drawn = [draw_parts(scenes, structure, size) for size in sizes]
    v, hidden, related, scene = (
        torch.cat([getattr(parts, name) for parts in drawn])
        for name in ("v", "hidden", "related", "scene")
    )
    candidates = (v == 0) & ~structure & ~related
    annotated = scenes.annotated_classes[scenes.source[scene]]
    return _Lists(v, (hidden & ~related).numpy(), candidates.numpy(), annotated.numpy())


def unlisted_log_odds(artifact: SceneModel, v: Tensor, coverages: Sequence[float]) -> Floats:
    """Return the log-odds of every class for lists v, (coverages, lists, classes)."""
    every, posteriors = np.arange(artifact.spec.V), (posterior_of(artifact, row) for row in v)
    rows = [[posterior.absent_log_odds(every, c) for c in coverages] for posterior in posteriors]
    return np.stack(rows, 1)


def _mean_rank(z: Floats, parts: _Lists) -> float:
    """Return the mean reciprocal rank of hidden classes among the other candidates."""
    ranks = []
    for row, usable, truth in zip(z, parts.candidates, parts.hidden, strict=True):
        if not truth.any():
            continue
        others = np.sort(row[usable & ~truth])
        above = len(others) - np.searchsorted(others, row[truth], side="right")
        ranks.append((1.0 / (1.0 + above)).mean())
    return float(np.mean(ranks))


def _first_classes(z: Floats, parts: _Lists) -> tuple[Floats, Ints, Flags]:
    """Return log-odds, part and truth of the first classes of each part, (examples,) each.

    Classes that the data source cannot show are left out, because their truth is unknown.
    """
    first = np.argsort(np.where(parts.candidates, -z, np.inf), axis=1, kind="stable")[:, :_LISTED]
    rows = np.broadcast_to(np.arange(len(z))[:, None], first.shape)
    # A small vocabulary has fewer candidates.
    usable = (parts.candidates & parts.annotated)[rows, first]
    row, classes = rows[usable], first[usable]
    return z[row, classes].astype(np.float64), row, parts.hidden[row, classes]


@dataclass(frozen=True, eq=False)
class ListScores:
    """Log-odds of the listed classes of N lists.

    Attributes:
        row: list of each listed class, (n,).
        log_odds: log-odds of each listed class given the rest of its list, (n,).
        popularity: log-odds of each class in the served mix, (n,).
        intruder: True for intruders, (n,) bool.
        can_alarm: False for classes that raise no alarm (`SceneModel.rarely_shown`), (n,) bool.
        size: number of listed classes of each list, (N,).
    """

    row: Ints
    log_odds: Floats
    popularity: Floats
    intruder: Flags
    can_alarm: Flags
    size: Ints

    def score(self, alpha: float) -> Floats:
        """Return log-odds with the prior of intruders, (n,); low values mean intruders."""
        return self.log_odds - alpha * self.popularity

    def extreme(self, values: Floats) -> Floats:
        """Return the largest value of each list, (N,)."""
        worst = np.full(len(self.size), -np.inf)
        np.maximum.at(worst, self.row, values)
        return worst


def fit_outliers(
    artifact: SceneModel,
    scenes: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    chosen: Calibration | None = None,
) -> dict[str, Any]:
    """Fit the calibration of outliers on random parts of scenes, with and without an intruder.

    The training scenes give the distributions of intruders. A `chosen` calibration gives alpha.

    Returns:
        The fields `popularity_weight`, `outlier`, `outlier_lines` and `room_lines` of a
        `Calibration`; none if there are too few scenes or parts.
    """
    if len(scenes) < _LEAST_SCENES:
        return {}
    untouched = score_untouched(artifact, scenes, structure)
    laws = intruder_weights(scenes, train).values()
    scored = (score_intruders(artifact, scenes, structure, weights) for weights in laws)
    with_intruder = [scores for scores in scored if len(scores.size)]
    if not untouched or not with_intruder:
        return {}
    alpha = chosen.popularity_weight if chosen else choose_alpha(untouched.values(), with_intruder)
    entry = _fit_intruders(untouched.values(), with_intruder, alpha)
    lines = fit_lines(artifact, scenes, structure, entry, alpha)
    return {"popularity_weight": alpha, "outlier": entry, **lines}


def refitted_lines(
    artifact: SceneModel, validation: SceneTensors, config: ObjectsConfig
) -> SceneModel:
    """Return the model with alarm lines that are fitted again; a model without lines as it is."""
    calibration = artifact.calibration
    scenes = calibration_scenes(validation, config.calibrated_sources)
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    entry, alpha = calibration.outlier, calibration.popularity_weight
    if entry is None:
        return artifact
    return recalibrated(artifact, **fit_lines(artifact, scenes, structure, entry, alpha))


def judged_classes(artifact: SceneModel) -> Flags:
    """Return the classes that can be intruders and that training shows, (classes,) bool."""
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    return artifact.vocabulary.judged & ~np.isnan(popularity)


def score_lists(
    artifact: SceneModel,
    parts: Parts,
    intruders: Tensor | None = None,
    rooms: Sequence[int] | None = None,
) -> ListScores:
    """Return the scores of parts of scenes, each with an intruder (parts,) if these are given.

    The room type (parts,) of each scene is stated if these are given.
    """
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    v = parts.v.numpy() > 0
    is_intruder = np.zeros_like(v)
    if intruders is not None:
        is_intruder[np.arange(len(v)), intruders.numpy()] = True
        v = v | is_intruder
    log_odds = np.zeros(v.shape)
    for k, (row, values) in enumerate(zip(v, log_odds, strict=True)):
        room = None if rooms is None else rooms[k]
        values[row] = posterior_of(artifact, torch.from_numpy(row), room).given_rest()[0]
    row, classes = at = np.nonzero(v & judged_classes(artifact))
    can_alarm = ~artifact.rarely_shown[classes]
    return ListScores(row, log_odds[at], popularity[classes], is_intruder[at], can_alarm, v.sum(1))


def score_untouched(
    artifact: SceneModel, scenes: SceneTensors, structure: Tensor, *, in_room: bool = False
) -> dict[int, ListScores]:
    """Return the scores of random parts of scenes by length, without lengths of too few parts.

    With `in_room`, the request states the room type, and scenes without a type are left out.
    """
    if in_room:
        scenes = subset(scenes, (scenes.room >= 0).nonzero().squeeze(1))
    scores: dict[int, ListScores] = {}
    for n in JUDGED_LENGTHS:
        parts = draw_parts(scenes, structure, exactly(n), _SEEDS)
        if len(parts.v) >= _LEAST_SCENES:
            rooms = scenes.room[parts.scene].tolist() if in_room else None
            scores[n] = score_lists(artifact, parts, rooms=rooms)
    return scores


def score_intruders(
    artifact: SceneModel, scenes: SceneTensors, structure: Tensor, weights: Tensor | None
) -> ListScores:
    """Return the scores of random parts of scenes, each with an intruder drawn by the weights."""
    unjudged = torch.from_numpy(~judged_classes(artifact))
    intruders = draw_intruders(scenes, unjudged, weights)
    kept = (intruders >= 0).nonzero().squeeze(1)
    usable = subset(scenes, kept)
    parts = draw_parts(usable, structure, up_to_longest, _SEEDS)
    return score_lists(artifact, parts, intruders[kept][parts.scene])


def choose_alpha(untouched: Collection[ListScores], altered: Collection[ListScores]) -> float:
    """Return the alpha with the best mean of hit@1 and detected share over the intruder kinds."""

    def rate(alpha: float) -> float:
        worst = [scores.extreme(-scores.score(alpha)) for scores in untouched]
        limit = float(np.mean([np.quantile(values, 1 - ALARMS["medium"]) for values in worst]))
        return float(np.mean([_detection(scores, alpha, limit) for scores in altered]))

    return max(ALPHAS, key=lambda alpha: (rate(alpha), -alpha))


def _detection(scores: ListScores, alpha: float, limit: float) -> float:
    """Return the mean of hit@1 and of the share of intruders above a limit."""
    values = -scores.score(alpha)
    first = values >= scores.extreme(values)[scores.row]
    caught = values > limit
    return float(first[scores.intruder].mean() + caught[scores.intruder].mean()) / 2


def _fit_intruders(
    untouched: Collection[ListScores], altered: Collection[ListScores], alpha: float
) -> CountSlope:
    """Fit the log-odds of being an intruder, with half of the lists altered."""
    columns, truth, weights = [], [], []
    for group in (untouched, altered):
        for scores in group:
            size = np.log(scores.size[scores.row])
            columns.append(np.stack([scores.score(alpha), size], 1))
            truth.append(scores.intruder)
            weights.append(np.full(len(scores.row), 1 / (len(group) * len(scores.size))))
    total = np.concatenate(weights)
    total *= len(total) / total.sum()
    slope, count, intercept = logistic(np.concatenate(columns), np.concatenate(truth), total, RIDGE)
    return CountSlope(intercept=intercept, slope=slope, log_count=count)


def fit_lines(
    artifact: SceneModel, scenes: SceneTensors, structure: Tensor, entry: CountSlope, alpha: float
) -> dict[str, AlarmLines | None]:
    """Return the fields `outlier_lines` and `room_lines` of a `Calibration`.

    A field is None if there are too few lists for it.
    """
    fields: dict[str, AlarmLines | None] = {}
    for name, in_room in (("outlier_lines", False), ("room_lines", True)):
        untouched = score_untouched(artifact, scenes, structure, in_room=in_room)
        worst = worst_log_odds(untouched, entry, alpha)
        lines = {level: fit_line(worst, share) for level, share in ALARMS.items()} if worst else {}
        fields[name] = AlarmLines(**lines) if lines else None
    return fields


def fit_line(worst: Mapping[int, Floats], share: float) -> AlarmLine:
    """Return a line above which about `MARGIN` times the share of the lists has an object.

    The shape of the line is the least-squares parabola in the log of the length through the
    quantiles of the lengths, weighted by the square roots of their numbers of lists. A parabola,
    because short lists say little, and long lists of written places contain rare things. With fewer
    than five lengths, the shape is a straight line, and with fewer than three, it is constant. The
    quantiles are those of medium sensitivity, so the lines of two sensitivities never cross. The
    line is then moved until the mean share over the lengths is right.

    Args:
        worst: the largest log-odds of each list by the length of the lists.
    """
    sizes, lists = np.log(list(worst)), list(worst.values())
    quantiles = [np.quantile(values, 1 - MARGIN * ALARMS["medium"]) for values in lists]
    numbers = np.sqrt([len(values) for values in lists])
    fit = np.polyfit(sizes, quantiles, min(2, (len(sizes) - 1) // 2), w=numbers)
    curve, slope, _ = (0.0, 0.0, *fit.tolist())[-3:]
    line = (curve * sizes + slope) * sizes
    above = np.concatenate([values - height for values, height in zip(lists, line, strict=True)])
    weight = np.concatenate([np.full(len(values), 1 / len(values)) for values in lists])
    limit = quantile_of(above, weight, 1 - MARGIN * share)
    return AlarmLine(intercept=limit, log_count=slope, curve=curve)


def worst_log_odds(
    untouched: Mapping[int, ListScores], entry: CountSlope, alpha: float
) -> dict[int, Floats]:
    """Return the largest log-odds of an alarm in each list, by the length of the lists."""
    worst = {}
    for n, scores in untouched.items():
        log_odds = calibrated(entry, scores.score(alpha), scores.size[scores.row])
        worst[n] = scores.extreme(np.where(scores.can_alarm, log_odds, -np.inf))
    return worst
