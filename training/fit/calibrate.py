"""Fit the calibration, which turns log-odds into the probabilities that the service returns.

All fits use validation scenes. Without enough scenes for `outlier` or `misplaced`, the entry is
None and the model gives no judgement. An unfitted entry of another question keeps the model's own
probability. `training.fit.calibrate_objects` fits the entries about objects.

The probability of a relation means that it holds in a home with both objects. So the fits use
only data sources that annotate true and false relations alike (`annotated_relations`), such as
real rooms with listed supports. All fits are logistic regressions (Platt scaling). One source of
generated rooms has more examples than all other sources together. The fits therefore give large
sources a lower weight. A robot lists few objects or many, so each scene takes part as a whole and
in parts.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from app.inference.quadrature import NO_UNIT
from app.model import Calibration, CountSlope, SceneModel
from app.questions.placements import PLACES
from app.questions.posterior import Posterior
from app.scene.spatial_relations import CANONICAL, LATERAL, ON_TOP, STACKED
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats, Rng
from training.datasets.batches import SceneTensors, TrainingData, subset
from training.datasets.cases import (
    Triple,
    annotated_relations,
    logistic,
    observed_pairs,
    removed_class,
    scene_of,
)
from training.evaluation.pair_task import ScenePairs, both_ways, lateral_shift, listed_pairs
from training.fit.calibrate_at import fit_at
from training.fit.calibrate_misplaced import fit_misplaced
from training.fit.calibrate_objects import calibrate_objects, recalibrated
from training.fit.configuration import ObjectsConfig
from training.fit.objects import ObjectScenes, served_popularity

_SCENES = 1500
_LISTED = 20  # relations that an answer of the service lists by default
_MOST_OF_A_PART = 8  # classes of a part of a scene
_POSSIBLE = -3.5  # least log-odds of a relation that may well hold
_OF_THE_REST = 0.02
_ROUNDS = 3
# Column indices of the table of examples. Column 0 is the scene.
_RELATION, _LOGIT, _TRUTH, _SOURCE = 1, 2, 4, 5
_UNKNOWN = -1.0  # truth of an example whose data source does not annotate the relation
# Number of objects that are removed from each scene in turn to fit placements. With one removed
# object, the fit depends too much on chance.
_PLACEMENT_CASES = 4


def calibrate(
    artifact: SceneModel,
    data: TrainingData,
    config: ObjectsConfig,
    seed: int = 0,
    chosen: Calibration | None = None,
) -> Calibration:
    """Fit every entry of the calibration. `calibrate_objects` copies some values of `chosen`."""
    popularity = served_popularity(ObjectScenes.of(data.train, data.structure, config), config)
    scenes = data.validation
    objects = calibrate_objects(
        *(artifact, scenes, data.train, popularity, config.calibrated_sources, seed, chosen)
    )
    artifact = replace(artifact, calibration=objects)
    pick = torch.randperm(len(scenes), generator=torch.Generator().manual_seed(seed))
    annotated = [k for k in pick.tolist() if scenes.scenes[k].evidence.holds.any()]
    related = subset(scenes, torch.tensor(annotated[:_SCENES], dtype=torch.int64))
    if not len(related):
        return objects
    complete = [encoded for encoded in related.scenes if annotated_relations(encoded).any()]
    relation = fit_relations(artifact, complete, seed)
    return recalibrated(
        artifact,
        relation=with_lower_lateral(artifact, relation, related),
        placement=fit_placements(artifact, complete, seed),
        relation_given=fit_with_observed(artifact, complete, seed),
        at=fit_at(artifact, related.scenes, seed),
        misplaced=fit_misplaced(artifact, related.scenes, seed),
    ).calibration


def fit_relations(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[CountSlope, ...]:
    """Fit the probability that a relation holds between two instances, in whole and partial scenes.

    The input is the log-odds of the relation between the two classes. No relation is observed.
    """
    rng = np.random.default_rng(seed)
    structure = artifact.vocabulary.structure
    parts = [_part_of(encoded, structure, rng) for encoded in scenes]
    return _fit_possible(_examples_of_pairs(artifact, [*scenes, *parts]))


def fit_with_observed(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[CountSlope, ...]:
    """Fit the probability of relations of half of the pairs of a scene, given the other half."""
    return _fit_possible(_examples_of_pairs(artifact, scenes, np.random.default_rng(seed)))


def with_lower_lateral(
    artifact: SceneModel, slopes: tuple[CountSlope, ...], scenes: SceneTensors
) -> tuple[CountSlope, ...]:
    """Lower the log-odds of left and front until the likeliest relations are the listed ones.

    Of two stacked objects, an annotator lists the stacked relation. `lateral_shift` finds the
    change of the intercept of left and front.
    """
    table = np.array([(s.intercept, s.slope, s.log_count) for s in slopes])[:, :, None, None]

    def score(question: ScenePairs) -> Floats:
        scene = question.scene
        posterior = _posterior(artifact, scene, range(len(scene.instance_classes)))
        log_odds = posterior.relation_log_odds().astype(np.float64)
        logs = np.log(scene.evidence.counts)
        logits = table[:, 0] + table[:, 1] * log_odds + table[:, 2] * (logs[:, None] + logs)
        return both_ways(logits, question.ends)

    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    shift = lateral_shift(score, listed_pairs(scenes, structure, STACKED))
    return tuple(
        entry.model_copy(update={"intercept": entry.intercept + shift}) if a in LATERAL else entry
        for a, entry in enumerate(slopes)
    )


def _part_of(encoded: EncodedScene, structure: Flags, rng: Rng) -> EncodedScene:
    """Return a random part of a scene: 2 to `_MOST_OF_A_PART` classes, with all their instances."""
    classes = encoded.evidence.classes
    things = rng.permutation(classes[~structure[classes]])
    count = int(rng.integers(2, _MOST_OF_A_PART + 1))
    return encoded.only(np.isin(encoded.instance_classes, things[:count]))


def _posterior(
    artifact: SceneModel,
    encoded: EncodedScene,
    kept: Sequence[int],
    observed: Sequence[Triple] = (),
) -> Posterior:
    """Return the posterior given some instances of a scene, without its room type."""
    return Posterior(artifact, replace(scene_of(encoded, kept, observed), room_type=None))


def _examples_of_pairs(
    artifact: SceneModel, scenes: Sequence[EncodedScene], rng: Rng | None = None
) -> Floats:
    """Return the examples of all pairs of a scene; with `rng`, of half, given the other half.

    The columns are: scene, relation, log-odds between the classes, log n_i + log n_j of the
    instance counts, truth value and data source, (examples, 6). Relations without annotation are
    examples only if their log-odds are high enough for the list of an answer.
    """
    blocks: list[Floats] = []
    structure = artifact.vocabulary.structure
    sources = sorted({encoded.source for encoded in scenes})
    for number, encoded in enumerate(scenes):
        n = len(encoded.instance_classes)
        pairs, observed = np.ones((n, n), dtype=np.bool_), list[Triple]()
        if rng is not None:
            pairs, observed = observed_pairs(encoded, structure, rng)
        if not n or (rng is not None and not observed):
            continue
        index = np.searchsorted(encoded.evidence.classes, encoded.instance_classes)
        values = _posterior(artifact, encoded, range(n), observed).relation_log_odds()
        log_odds = values[:, index[:, None], index]
        is_thing = ~structure[encoded.instance_classes]
        pairs = pairs & is_thing[:, None] & is_thing & ~np.eye(n, dtype=np.bool_)
        annotated = annotated_relations(encoded)
        # The smallest of the `_LISTED` largest values of each relation.
        few = pairs.sum() <= _LISTED
        least = [-np.inf if few else np.partition(v[pairs], -_LISTED)[-_LISTED] for v in log_odds]
        examples = pairs & (annotated | (log_odds >= np.array(least)[:, None, None]))
        relation, i, j = np.nonzero(examples)
        logs = np.log(encoded.evidence.counts[index])
        truth = np.where(annotated, encoded.instance_holds, _UNKNOWN)[examples]
        columns = number, relation, log_odds[examples], logs[i] + logs[j], truth
        blocks.append(_table(*columns, sources.index(encoded.source)))
    return _examples(blocks)


def fit_placements(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[CountSlope, ...]:
    """Fit the probability of relations between a removed object and the objects of its scene.

    The fit is mainly to the likeliest relations, because an answer lists them. The scenes are whole
    scenes and parts.
    """
    rng = np.random.default_rng(seed)
    structure = artifact.vocabulary.structure
    sources = sorted({encoded.source for encoded in scenes})
    blocks: list[Floats] = []
    for number in range(_PLACEMENT_CASES * len(scenes)):
        encoded = scenes[number % len(scenes)]
        if number % 2:
            encoded = _part_of(encoded, structure, rng)
        removal = removed_class(encoded, structure, rng)
        if removal is None:
            continue
        target, kept = removal
        instance = int(rng.choice(np.flatnonzero(encoded.instance_classes == target)))
        posterior = _posterior(artifact, encoded, kept)
        present = posterior.present
        anchors = np.flatnonzero(~structure[present.classes])
        tables = posterior.placement_log_odds(np.array([target]), anchors)
        anchor_index = np.array(kept)[present.first[anchors]]
        removed_index = np.full_like(anchor_index, instance)
        holds, annotated = encoded.instance_holds, annotated_relations(encoded)
        directions = (removed_index, anchor_index), (anchor_index, removed_index)
        for values, ends in zip(tables, directions, strict=True):
            truth = np.where(annotated[:, *ends], holds[:, *ends], _UNKNOWN)
            a, anchor = map(np.ravel, np.indices(truth.shape))
            count = np.log(present.counts[anchors])[anchor]
            columns = number, a, values[0].ravel(), count, truth.ravel()
            blocks.append(_table(*columns, sources.index(encoded.source)))
    return _fit_listed(_examples(blocks), PLACES)


def _table(*columns: Any) -> Floats:
    """Return a table, (examples, columns), of columns that are arrays or single values."""
    return np.stack(np.broadcast_arrays(*columns), 1).astype(np.float64)


def _examples(blocks: list[Floats]) -> Floats:
    """Return the examples for which the machine has a relation unit, and so log-odds."""
    examples = np.concatenate(blocks or [np.zeros((0, _SOURCE + 1))])
    return examples[examples[:, _LOGIT] > NO_UNIT]


def _fit_possible(examples: Floats) -> tuple[CountSlope, ...]:
    """Fit the slopes to possible pairs: most pairs have far lower log-odds, and would decide."""
    examples = examples[examples[:, _TRUTH] != _UNKNOWN]
    is_possible = examples[:, _LOGIT] >= _POSSIBLE
    weight = np.where(is_possible, 1.0, _OF_THE_REST)
    return _fit_by_kind(examples, weight * _source_weights(examples, is_possible))


def _fit_listed(examples: Floats, listed: int) -> tuple[CountSlope, ...]:
    """Fit the slopes, mainly to the `listed` likeliest examples of each scene.

    An answer lists only these examples. Selection by high log-odds also selects errors, so listed
    relations hold less often than unselected relations with equal log-odds. Examples outside the
    list have a small weight. Examples without annotation take part only in the ranking.
    """
    annotated = examples[:, _TRUTH] != _UNKNOWN
    slopes = _fit_by_kind(examples[annotated], np.ones(annotated.sum()))
    for _ in range(_ROUNDS):
        is_listed = _is_listed(examples, slopes, listed)[annotated]
        weight = np.where(is_listed, 1.0, _OF_THE_REST)
        weight *= _source_weights(examples[annotated], is_listed)
        slopes = _fit_by_kind(examples[annotated], weight)
    return slopes


def _source_weights(examples: Floats, is_listed: Flags) -> Floats:
    """Return weights (examples,) that give each source the same total of listed examples."""
    relation, source = examples[:, [_RELATION, _SOURCE]].astype(int).T
    key = relation * (source.max(initial=0) + 1) + source
    counts = np.bincount(key[is_listed], minlength=int(key.max(initial=-1)) + 1)
    return (1 / np.maximum(counts, 1.0))[key]


def _is_listed(examples: Floats, slopes: tuple[CountSlope, ...], listed: int) -> Flags:
    """Mark the examples of each scene with the highest calibrated log-odds, (examples,) bool."""
    table = np.array([(s.slope, s.log_count, s.intercept) for s in slopes])
    weights = table[examples[:, _RELATION].astype(np.int64)]
    logits = (examples[:, _LOGIT:_TRUTH] * weights[:, :2]).sum(1) + weights[:, 2]
    order = np.lexsort((-logits, examples[:, 0]))
    scene = examples[order, 0]
    rank = np.arange(len(order)) - np.searchsorted(scene, scene)
    is_listed = np.zeros(len(order), dtype=np.bool_)
    is_listed[order] = rank < listed
    return is_listed


def _fit_by_kind(examples: Floats, weight: Floats) -> tuple[CountSlope, ...]:
    """Fit one slope to left and front, and one to on-top for all relations of stacked objects.

    Complete sources show hundreds of times more pairs with on-top than with inside, and no pairs
    with above. A kind with one truth value keeps its log-odds.
    """
    entries = [CountSlope()] * len(CANONICAL)
    for fitted, kind in ((LATERAL, LATERAL), ((ON_TOP,), STACKED)):
        rows = np.isin(examples[:, _RELATION], fitted)
        truth = examples[rows, _TRUTH] > 0
        if len(np.unique(truth)) < 2:
            continue
        features = examples[rows, _LOGIT : _LOGIT + 2]
        slope, count, intercept = logistic(features, truth, weight[rows])
        entry = CountSlope(intercept=intercept, slope=slope, log_count=count)
        for a in kind:
            entries[a] = entry
    return tuple(entries)
