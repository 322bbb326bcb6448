"""Fit the calibration of answers about objects to short lists.

A robot lists a few objects of a room. So all fits use random parts of validation scenes, of the
sources for which the answers stand (`served_scenes`). Structure is not listed.

    coverage   Listed share that the answers assume: the share with the best rank of hidden classes.
    missing    Probability that an unlisted class is present, fitted to the first classes of parts
               of each number of classes.
    outlier    Probability that a class is an intruder. Half of the parts contain an intruder.
    lines      An object is an outlier if its log-odds of being an intruder are above a line in the
               log of the number of listed classes. Each line raises alarms in a given share of the
               untouched parts (`training.evaluation.alarms.ALARMS`). A class that few training
               scenes show raises no alarm.

The prior of an intruder class is proportional to (frequency of the class)^alpha. Alpha and the
logistic regression are fitted to three kinds of intruders with equal weights. Intruders are drawn
uniformly, by the frequency of classes, or from the typical classes of another room type.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from app.questions.posterior import calibrated
from app.registry import AlarmLine, AlarmLines, Artifact, Calibration, CountSlope
from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import RIDGE, logistic
from training.evaluation.alarms import ALARMS
from training.evaluation.intruders import draw_intruders, intruder_weights
from training.evaluation.parts import Parts, draw_parts, exactly, up_to_longest
from training.fit.calibrate_rooms import calibrate_rooms, posterior_of
from training.fit.configuration import ObjectsConfig

COVERAGES = (0.15, 0.3, 0.45, 0.6, 0.8)
# Tested exponents alpha of the prior of intruders.
ALPHAS = (0.0, 0.125, 0.25, 0.375, 0.5)
LENGTHS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
"""Numbers of listed classes to which the alarm lines are fitted."""

_LEAST_SCENES = 20  # from which objects are judged
_SEEDS = (0, 1, 2)
_LISTED = 10  # classes in the fit of each part; an answer of the service lists ten by default
_SOURCE_SCENES = 200  # maximum scenes of each source
_SERVED = 0.1  # least weight of a source, as a share of the largest weight in the served mix


def calibrate_objects(
    artifact: Artifact,
    validation: SceneTensors,
    train: SceneTensors,
    popularity: Tensor,
    served: Mapping[str, float],
    seed: int = 0,
    chosen: Calibration | None = None,
) -> Calibration:
    """Return the model's calibration with newly fitted entries about objects.

    The training scenes give the intruders, and limits for room types. The coverage and alpha of a
    `chosen` calibration are copied.

    Args:
        popularity: log-odds of each class in the served mix of sources, (classes,); NaN for a
            class without a training scene.
        served: weights of the sources in the served mix; empty means that all are equal.
    """
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    scenes = served_scenes(validation, served)
    learnt = complete_scenes(train, seed)
    rounded = tuple(None if math.isnan(x) else round(x, 4) for x in popularity.double().tolist())
    artifact = recalibrated(artifact, popularity=rounded)
    artifact = recalibrated(artifact, **fit_missing(artifact, scenes, structure, chosen))
    entries = fit_outliers(artifact, scenes, learnt, structure, chosen)
    entries |= calibrate_rooms(artifact, scenes, learnt, structure)
    return recalibrated(artifact, **entries).calibration


def recalibrated(artifact: Artifact, **entries: Any) -> Artifact:
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


def served_scenes(scenes: SceneTensors, served: Mapping[str, float]) -> SceneTensors:
    """Return the scenes of the sources for which the answers stand; see `ObjectsConfig`.

    These are the sources with at least a tenth of the largest weight in `served` and at least 20
    scenes. Without such a source, they are all scenes with complete object lists. At most 200
    scenes of a source take part.
    """
    names, size = scenes.source_names, scenes.source.bincount(minlength=len(scenes.source_names))
    largest = max(served.values(), default=0.0)
    chosen = [
        names.index(name)
        for name, weight in served.items()
        if weight >= largest * _SERVED
        and name in names
        and size[names.index(name)] >= _LEAST_SCENES
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
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, chosen: Calibration | None = None
) -> dict[str, Any]:
    """Fit the entries `coverage` and `missing` of the calibration."""
    parts = [draw_parts(scenes, structure, exactly(n)) for n in LENGTHS]
    v, hidden, related = (
        torch.cat([getattr(part, name) for part in parts]) for name in ("v", "hidden", "related")
    )
    if not len(v):
        return {}
    coverages = COVERAGES if chosen is None else (chosen.coverage,)
    log_odds = unlisted_log_odds(artifact, v, coverages)
    masks = ((v == 0) & ~structure & ~related).numpy(), (hidden & ~related).numpy()
    best = int(np.argmax([_mean_rank(z, *masks) for z in log_odds]))
    features, truth = _first_classes(log_odds[best], *masks, v.sum(1).numpy())
    entry = CountSlope()
    if len(np.unique(truth)) == 2:
        slope, count, intercept = logistic(features, truth, C=RIDGE)
        entry = CountSlope(intercept=intercept, slope=slope, log_count=count)
    return {"coverage": coverages[best], "missing": entry}


def unlisted_log_odds(artifact: Artifact, v: Tensor, coverages: Sequence[float]) -> Floats:
    """Return the log-odds of every class for lists v, (coverages, lists, classes)."""
    every, posteriors = np.arange(artifact.spec.V), (posterior_of(artifact, row) for row in v)
    rows = [[posterior.absent_log_odds(every, c) for c in coverages] for posterior in posteriors]
    return np.stack(rows, 1)


def _mean_rank(z: Floats, candidates: Flags, hidden: Flags) -> float:
    """Return the mean reciprocal rank of hidden classes among the other candidates."""
    ranks = []
    for row, usable, truth in zip(z, candidates, hidden, strict=True):
        if not truth.any():
            continue
        others = np.sort(row[usable & ~truth])
        above = len(others) - np.searchsorted(others, row[truth], side="right")
        ranks.append((1.0 / (1.0 + above)).mean())
    return float(np.mean(ranks))


def _first_classes(
    z: Floats, candidates: Flags, hidden: Flags, listed: Floats
) -> tuple[Floats, Flags]:
    """Return features (log-odds, log of listed classes) and truth of each part's first classes."""
    first = np.argsort(np.where(candidates, -z, np.inf), axis=1, kind="stable")[:, :_LISTED]
    rows = np.arange(len(z))[:, None]
    size = np.broadcast_to(np.log(np.maximum(listed, 1))[:, None], first.shape)
    usable = candidates[rows, first]  # a small vocabulary has fewer candidates
    features = np.stack([z[rows, first], size], -1).astype(np.float64)
    return features[usable], hidden[rows, first][usable]


@dataclass(frozen=True, eq=False)
class ListScores:
    """Log-odds of the listed classes of N lists.

    Attributes:
        row: list of each listed class, (n,).
        log_odds: log-odds of each listed class given the rest of its list, (n,).
        popularity: log-odds of each class in the served mix, (n,).
        intruder: True for intruders, (n,) bool.
        can_alarm: False for classes that raise no alarm (`Artifact.rarely_shown`), (n,) bool.
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
    artifact: Artifact,
    scenes: SceneTensors,
    train: SceneTensors,
    structure: Tensor,
    chosen: Calibration | None = None,
) -> dict[str, Any]:
    """Fit the calibration of outliers on random parts of scenes, with and without an intruder.

    The training scenes give the distributions of intruders. A `chosen` calibration gives alpha.

    Returns:
        The fields `popularity_weight`, `outlier` and `outlier_lines` of a `Calibration`; none if
        there are too few scenes or parts.
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
    lines = fit_lines(untouched, entry, alpha)
    return {"popularity_weight": alpha, "outlier": entry, "outlier_lines": lines}


def refitted_lines(artifact: Artifact, validation: SceneTensors, config: ObjectsConfig) -> Artifact:
    """Return the model with alarm lines that are fitted again; a model without lines as it is."""
    calibration = artifact.calibration
    scenes = served_scenes(validation, config.served_sources)
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    untouched = score_untouched(artifact, scenes, structure)
    if calibration.outlier is None or not untouched:
        return artifact
    lines = fit_lines(untouched, calibration.outlier, calibration.popularity_weight)
    return recalibrated(artifact, outlier_lines=lines)


def judged_classes(artifact: Artifact) -> Flags:
    """Return the classes that can be intruders and that training shows, (classes,) bool."""
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    return artifact.vocabulary.judged & ~np.isnan(popularity)


def score_lists(artifact: Artifact, parts: Parts, intruders: Tensor | None = None) -> ListScores:
    """Return the scores of parts of scenes, each with an intruder (parts,) if these are given."""
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    v = parts.v.numpy() > 0
    is_intruder = np.zeros_like(v)
    if intruders is not None:
        is_intruder[np.arange(len(v)), intruders.numpy()] = True
        v = v | is_intruder
    log_odds = np.zeros(v.shape)
    for row, values in zip(v, log_odds, strict=True):
        values[row] = posterior_of(artifact, torch.from_numpy(row)).given_rest()[0]
    row, classes = at = np.nonzero(v & judged_classes(artifact))
    can_alarm = ~artifact.rarely_shown[classes]
    return ListScores(row, log_odds[at], popularity[classes], is_intruder[at], can_alarm, v.sum(1))


def score_untouched(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor
) -> dict[int, ListScores]:
    """Return the scores of random parts of scenes by length, without lengths of too few parts."""
    parts_by_length = {n: draw_parts(scenes, structure, exactly(n), _SEEDS) for n in LENGTHS}
    return {
        n: score_lists(artifact, parts)
        for n, parts in parts_by_length.items()
        if len(parts.v) >= _LEAST_SCENES
    }


def score_intruders(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, weights: Tensor | None
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


def fit_lines(untouched: Mapping[int, ListScores], entry: CountSlope, alpha: float) -> AlarmLines:
    """Return the line of each sensitivity."""
    lines = {name: fit_line(untouched, entry, alpha, share) for name, share in ALARMS.items()}
    return AlarmLines(**lines)


def fit_line(
    untouched: Mapping[int, ListScores], entry: CountSlope, alpha: float, share: float
) -> AlarmLine:
    """Return the line above which the given share of the untouched lists has an object.

    The line is the least-squares line through the quantiles of all lengths. It is then raised until
    the mean share over the lengths is right.
    """
    sizes, worst = np.log(list(untouched)), []
    for scores in untouched.values():
        log_odds = calibrated(entry, scores.score(alpha), scores.size[scores.row])
        worst.append(scores.extreme(np.where(scores.can_alarm, log_odds, -np.inf)))
    quantiles = [np.quantile(values, 1 - share) for values in worst]
    slope = float(np.polyfit(sizes, quantiles, 1)[0]) if len(worst) > 1 else 0.0
    above = np.concatenate([v - slope * n for n, v in zip(sizes, worst, strict=True)])
    weight = np.concatenate([np.full(len(values), 1 / len(values)) for values in worst])
    limit = np.quantile(above, 1 - share, weights=weight, method="inverted_cdf")
    return AlarmLine(intercept=float(limit), log_count=slope)
