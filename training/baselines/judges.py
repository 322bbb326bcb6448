"""The figures by which validation chooses: of each task its primary metric, pooled over sources."""

from __future__ import annotations

from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.completion import complete_scenes
from training.evaluation.density import ObjectDensity
from training.evaluation.missing import ObjectScore, leave_one_out
from training.evaluation.partial import hide, rank_hidden
from training.evaluation.placed import PlacedScore, leave_one_out_at
from training.evaluation.relations import RelationScore, rank, rank_relations


def missing_mrr(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> float:
    """T2: mean reciprocal rank of removed objects.

    Raises:
        ValueError: no scene has two classes.
    """
    result = leave_one_out(scenes, structure, score)
    return result.ratio(result.reciprocal_rank()).value


def partial_mrr(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> float:
    """T2 partial: mean reciprocal rank of the hidden half of every scene.

    Raises:
        ValueError: no scene has two classes.
    """
    return rank_hidden(hide(scenes, structure, 0.5), structure, score).mrr.value


def placed_mrr(scenes: SceneTensors, structure: Tensor, score: PlacedScore) -> float:
    """T2-at: mean reciprocal rank of removed objects of which one relation is known.

    Raises:
        ValueError: no scene has a relation to ask for.
    """
    return leave_one_out_at(scenes, structure, score).mrr().value


def r_precision(scenes: SceneTensors, structure: Tensor, score: RelationScore) -> float:
    """T1a: R-precision, the counts of instances known.

    Raises:
        ValueError: no scene has a relation.
    """
    return rank_relations(scenes, structure, score).pooled().value


def completion_r_precision(scenes: SceneTensors, structure: Tensor, score: RelationScore) -> float:
    """T1b: R-precision on the half of the relations that is not given.

    Raises:
        ValueError: no scene has two relations.
    """
    return rank(complete_scenes(scenes, structure, score), len(scenes)).pooled().value


def log_likelihood(scenes: SceneTensors, _structure: Tensor, density: ObjectDensity) -> float:
    """Density: mean log-likelihood of the objects, nats, with the upper estimate of log Z."""
    return float(density.log_unnormalised(scenes.v).double().mean()) - density.upper
