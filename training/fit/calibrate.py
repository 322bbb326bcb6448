"""Fit the calibration, which turns log-odds into the probabilities that the service returns.

Without enough validation scenes for `outlier` or `misplaced`, the entry is None and the model gives
no judgement. An unfitted entry of another question keeps the model's own probability.

The probability of a relation means that it holds in a home with both objects. So the fits use only
sources that annotate true and false relations alike (`annotated_relations`). All fits are logistic
regressions (Platt scaling) with lower weights of large sources, such as generated rooms. A robot
lists few objects or many, so each scene takes part as a whole and in parts.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.inference.elementary import NO_UNIT
from app.model import Calibration, CountSlope, SceneModel
from app.questions.doubt import believed
from app.questions.placements import PLACES
from app.questions.posterior import Posterior
from app.scene.spatial_relations import CANONICAL, LATERAL, ON_TOP, STACKED
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask, Rng, Table
from training.datasets.batches import SceneTensors, TrainingData, subset
from training.datasets.cases import (
    Triple,
    annotated_relations,
    observed_pairs,
    removed_class,
    scene_of,
)
from training.evaluation.pair_task import ScenePairs, both_ways, lateral_shift, listed_pairs
from training.fit.calibrate_at import fit_at
from training.fit.calibrate_misplaced import fit_misplaced
from training.fit.calibrate_objects import calibrate_objects
from training.fit.configuration import ObjectsConfig
from training.fit.objects import ObjectScenes, served_popularity
from training.fit.regression import fit_count_slope, recalibrated, structure_of

_SCENES = 1500
_LISTED = 20  # relations that an answer of the service lists by default
_MOST_OF_A_PART = 8  # classes of a part of a scene
_POSSIBLE = -3.5  # least log-odds of a relation that may well hold
_OF_THE_REST = 0.02  # weight of the examples that are not listed
_ROUNDS = 3
_UNKNOWN = -1.0  # truth of an example whose data source does not annotate the relation
# Objects removed from each scene in turn: with one, the fit depends too much on chance.
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
    sources = config.calibrated_sources
    objects = calibrate_objects(artifact, scenes, data.train, popularity, sources, seed, chosen)
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
    """Fit the relations of two instances, given the objects of whole scenes and of parts."""
    rng = np.random.default_rng(seed)
    parts = [_part_of(encoded, artifact.vocabulary.structure, rng) for encoded in scenes]
    return _fit_possible(_examples_of_pairs(artifact, [*scenes, *parts]))


def fit_with_observed(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[CountSlope, ...]:
    """Fit the probability of relations of half of the pairs of a scene, given the other half."""
    return _fit_possible(_examples_of_pairs(artifact, scenes, np.random.default_rng(seed)))


def with_lower_lateral(
    artifact: SceneModel, slopes: tuple[CountSlope, ...], scenes: SceneTensors
) -> tuple[CountSlope, ...]:
    """Lower the log-odds of left and front until the likeliest relations are the listed ones."""
    entries = np.array([(s.intercept, s.slope, s.log_count) for s in slopes])
    intercept, slope, log_count = entries.T[:, :, None, None]  # of each relation, (A, 1, 1)

    def score(question: ScenePairs) -> NDArray[np.float64]:
        """Return the calibrated log-odds of all relations of the pairs, in both directions."""
        scene = question.scene
        posterior = _posterior(artifact, scene, range(len(scene.instance_classes)))
        log_odds = posterior.relation_log_odds().astype(np.float64)
        logs = np.log(scene.evidence.counts)
        logits = intercept + slope * log_odds + log_count * (logs[:, None] + logs)
        return both_ways(logits, question.pairs)

    # Of two stacked objects, an annotator lists only the stacked relation.
    shift = lateral_shift(score, listed_pairs(scenes, structure_of(artifact), STACKED))
    return tuple(
        entry.model_copy(update={"intercept": entry.intercept + shift}) if a in LATERAL else entry
        for a, entry in enumerate(slopes)
    )


def _part_of(encoded: EncodedScene, structure: ClassMask, rng: Rng) -> EncodedScene:
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


@dataclass(frozen=True, eq=False)
class _Examples(Table):
    """N candidate relations between two instances of a scene."""

    scene: Int[NDArray, "N"]
    relation: Int[NDArray, "N"]
    log_odds: Float[NDArray, "N"]  # of the relation between the two classes
    log_count: Float[NDArray, "N"]  # log of the instance counts: of both classes, or of the anchor
    truth: Float[NDArray, "N"]  # 1, 0 or `_UNKNOWN`
    source: Int[NDArray, "N"]

    @classmethod
    def joined(cls, blocks: Sequence[_Examples]) -> _Examples:
        """Join blocks, whose columns are broadcast, without pairs that have no relation unit."""
        arrays = ([*map(np.ravel, np.broadcast_arrays(*block.columns))] for block in blocks)
        columns = zip(*arrays, strict=True)
        joined = map(np.concatenate, columns) if blocks else np.zeros((6, 0), dtype=np.int64)
        examples = cls(*joined)
        return examples.rows(examples.log_odds > NO_UNIT)

    @property
    def annotated(self) -> Bool[NDArray, "N"]:
        """True for examples whose data source annotates the relation."""
        return self.truth != _UNKNOWN


def _examples_of_pairs(
    artifact: SceneModel, scenes: Sequence[EncodedScene], rng: Rng | None = None
) -> _Examples:
    """Return the examples of all pairs of a scene; with `rng`, of half, given the other half.

    A pair is an ordered pair of instances. Structure takes no part.
    """
    blocks = []
    structure = artifact.vocabulary.structure
    sources = sorted({encoded.source for encoded in scenes})
    for number, encoded in enumerate(scenes):
        n = len(encoded.instance_classes)
        pairs, observed = np.ones((n, n), dtype=np.bool_), list[Triple]()
        if rng is not None:
            pairs, observed = observed_pairs(encoded, structure, rng)
        if not n or (rng is not None and not observed):
            continue
        # The model answers for classes: `index` is the row of the class of each instance.
        index = np.searchsorted(encoded.evidence.classes, encoded.instance_classes)
        of_classes = _posterior(artifact, encoded, range(n), observed).relation_log_odds()
        log_odds = of_classes[:, index[:, None], index]
        is_thing = ~structure[encoded.instance_classes]
        pairs = pairs & is_thing[:, None] & is_thing & ~np.eye(n, dtype=np.bool_)
        annotated = annotated_relations(encoded)
        # Without annotation, relations are examples from the `_LISTED`-th largest value on.
        few = pairs.sum() <= _LISTED
        least = [-np.inf if few else np.partition(v[pairs], -_LISTED)[-_LISTED] for v in log_odds]
        is_example = pairs & (annotated | (log_odds >= np.array(least)[:, None, None]))
        relation, i, j = np.nonzero(is_example)
        logs = np.log(encoded.evidence.counts[index])
        block = _Examples(
            scene=np.array(number),
            relation=relation,
            log_odds=log_odds[is_example].astype(np.float64),
            log_count=logs[i] + logs[j],
            truth=np.where(annotated, encoded.instance_holds, _UNKNOWN)[is_example],
            source=np.array(sources.index(encoded.source)),
        )
        blocks.append(block)
    return _Examples.joined(blocks)


def fit_placements(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[CountSlope, ...]:
    """Fit the probability of relations of a removed object, in whole scenes and in parts."""
    rng = np.random.default_rng(seed)
    structure = artifact.vocabulary.structure
    sources = sorted({encoded.source for encoded in scenes})
    blocks = []
    for number in range(_PLACEMENT_CASES * len(scenes)):
        encoded = scenes[number % len(scenes)]
        if number % 2:  # every other case
            encoded = _part_of(encoded, structure, rng)
        removal = removed_class(encoded, structure, rng)
        if removal is None:
            continue
        target, kept = removal
        instance = int(rng.choice(np.flatnonzero(encoded.instance_classes == target)))
        scene = replace(scene_of(encoded, kept, ()), room_type=None)
        posterior = believed(artifact, scene)
        present = posterior.present
        anchors = np.flatnonzero(~structure[present.classes])
        tables = posterior.units.placement_log_odds(posterior.context, np.array([target]), anchors)
        anchor_index = np.array(kept)[present.first[anchors]]
        removed_index = np.full_like(anchor_index, instance)
        holds, annotated = encoded.instance_holds, annotated_relations(encoded)
        # Two tables of log-odds: the removed object is the subject, or the object of the relation.
        directions = (removed_index, anchor_index), (anchor_index, removed_index)
        for values, (subject, object_) in zip(tables, directions, strict=True):
            truth = np.where(annotated[:, subject, object_], holds[:, subject, object_], _UNKNOWN)
            block = _Examples(
                scene=np.array(number),
                relation=np.arange(len(truth))[:, None],
                log_odds=values[0].astype(np.float64),
                log_count=np.log(present.counts[anchors]),
                truth=truth,
                source=np.array(sources.index(encoded.source)),
            )
            blocks.append(block)
    return _fit_listed(_Examples.joined(blocks), PLACES)


def _fit_possible(examples: _Examples) -> tuple[CountSlope, ...]:
    """Fit the slopes to possible pairs: most pairs have far lower log-odds, and would decide."""
    examples = examples.rows(examples.annotated)
    is_possible = examples.log_odds >= _POSSIBLE
    weight = np.where(is_possible, 1.0, _OF_THE_REST)
    return _fit_by_kind(examples, weight * _source_weights(examples, is_possible))


def _fit_listed(examples: _Examples, listed: int) -> tuple[CountSlope, ...]:
    """Fit the slope of each relation, mainly to the `listed` likeliest examples of a scene.

    An answer shows these examples only.
    """
    annotated = examples.annotated
    fitted = examples.rows(annotated)
    slopes = _fit_by_kind(fitted, np.ones(len(fitted)))
    # The slopes decide which examples are listed, and the listed examples decide the slopes.
    for _ in range(_ROUNDS):
        is_listed = _is_listed(examples, slopes, listed)[annotated]
        weight = np.where(is_listed, 1.0, _OF_THE_REST)
        slopes = _fit_by_kind(fitted, weight * _source_weights(fitted, is_listed))
    return slopes


def _source_weights(examples: _Examples, is_listed: Bool[NDArray, "N"]) -> Float[NDArray, "N"]:
    """Return weights that give each source the same total of listed examples of a relation."""
    # One number for each pair of relation and source.
    key = examples.relation * (examples.source.max(initial=0) + 1) + examples.source
    counts = np.bincount(key[is_listed], minlength=int(key.max(initial=-1)) + 1)
    return (1 / np.maximum(counts, 1.0))[key]


def _is_listed(
    examples: _Examples, slopes: tuple[CountSlope, ...], listed: int
) -> Bool[NDArray, "N"]:
    """Mark the `listed` examples of each scene with the highest calibrated log-odds."""
    entries = np.array([(s.slope, s.log_count, s.intercept) for s in slopes])
    slope, log_count, intercept = entries[examples.relation].T
    logits = examples.log_odds * slope + examples.log_count * log_count + intercept
    # Sort by scene, then by falling log-odds. The rank is the distance from the scene's first one.
    order = np.lexsort((-logits, examples.scene))
    scene = examples.scene[order]
    rank = np.arange(len(order)) - np.searchsorted(scene, scene)
    is_listed = np.zeros(len(order), dtype=np.bool_)
    is_listed[order] = rank < listed
    return is_listed


def _fit_by_kind(examples: _Examples, weight: Float[NDArray, "N"]) -> tuple[CountSlope, ...]:
    """Fit one slope to left and front, and one to on-top for all relations of stacked objects."""
    entries = [CountSlope()] * len(CANONICAL)
    # Sources show hundreds of times more on-top than inside, and no above.
    for fitted, kind in ((LATERAL, LATERAL), ((ON_TOP,), STACKED)):
        is_fitted = np.isin(examples.relation, fitted)
        rows = examples.rows(is_fitted)
        entry = fit_count_slope(
            rows.log_odds, rows.log_count, rows.truth > 0, weight[is_fitted], C=1e6
        )
        if entry is not None:
            entries = [entry if a in kind else other for a, other in enumerate(entries)]
    return tuple(entries)
