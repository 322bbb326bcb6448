"""The tasks of the evaluation's table: a contender and a set of scenes to metrics.

A task that the contender does not take part in, or for which the scenes hold nothing, is None.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from app.scene import CANONICAL
from training.batches import SceneTensors
from training.evaluation.answers import (
    QUESTIONS,
    Ask,
    ask_outliers,
    collect,
    kinds_of_intruders,
    uncalibrated,
)
from training.evaluation.completion import complete_scenes
from training.evaluation.contenders import Contender
from training.evaluation.density import independent_density
from training.evaluation.everyday import everyday_task
from training.evaluation.evidence import (
    missing_evidence_task,
    outliers_evidence_task,
    relations_evidence_task,
)
from training.evaluation.generation import (
    generation_metrics,
    independent_sampler,
    median_distance,
    scene_sampler,
)
from training.evaluation.intervals import Metric
from training.evaluation.metrics import Ratio
from training.evaluation.missing import (
    leave_one_out,
    leave_one_out_in_rooms,
    missing_metrics,
)
from training.evaluation.outliers import by_popularity, by_room, intruder_scores
from training.evaluation.pairs import pairs_task
from training.evaluation.partial import partial_task
from training.evaluation.placed import leave_one_out_at
from training.evaluation.placement import placement_scores
from training.evaluation.relations import (
    Candidates,
    candidates,
    of_relation,
    rank,
    score_scenes,
    unseen,
)
from training.evaluation.setting import Outcome, Setting, Task, about_objects
from training.evaluation.signature import sensitivity_task, signature_task
from training.trainer import subset

__all__ = [
    "FIRST",
    "ONCE",
    "TASKS",
    "WHOLE_SET",
    "Outcome",
    "Setting",
    "Task",
    "floor_contender",
    "independent_contender",
]

_COSTLY = 3


FIRST = (1, 2, 5, 10, 20, 50, 100)
"""Numbers of predictions, per scene, among which annotated relations are looked for."""
_RECALLS = (20, 50, 100)


def relations_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T1a; unlisted is counted as wrong."""
    if contender.relations is None:
        return None
    scenes, score = setting.scenes, contender.relations
    with_counts = candidates(score_scenes(scenes, score), setting.structure)
    plain = candidates(score_scenes(scenes, score, counts=False), setting.structure)
    if not any(scene.truth.any() for scene in plain):
        return None
    ranking = rank(plain, len(scenes))
    counted = rank(with_counts, len(scenes))
    metrics: dict[str, Metric] = {
        "R-precision, distinct classes": ranking.pooled(),
        "R-precision, instance counts": counted.pooled(),
        "R-precision, distinct classes, mean over scenes": ranking.per_scene(),
        "R-precision, mean over scenes": counted.per_scene(),
    }
    metrics |= _by_relation(with_counts, len(scenes))
    for k in FIRST:
        metrics[f"R@{k}"] = rank(with_counts, len(scenes), first=k).per_scene()
    metrics |= _zero_shot(with_counts, setting)
    return Outcome(metrics, len(scenes), ranking.skipped)


def completion_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T1b; beside it the same candidates with nothing given."""
    if contender.completion is None:
        return None
    scenes = setting.scenes
    given = complete_scenes(scenes, setting.structure, contender.completion, seed=setting.seed)
    if not any(scene.truth.any() for scene in given):
        return None
    ranking = rank(given, len(scenes))
    metrics: dict[str, Metric] = {
        "R-precision": ranking.pooled(),
        "R-precision, mean over scenes": ranking.per_scene(),
    }
    metrics |= _by_relation(given, len(scenes))
    for k in _RECALLS:
        metrics[f"R@{k}"] = rank(given, len(scenes), first=k).per_scene()
    metrics |= _zero_shot(given, setting)
    if contender.relations is not None:
        blind = complete_scenes(scenes, setting.structure, contender.relations, seed=setting.seed)
        metrics["R-precision, nothing given"] = rank(blind, len(scenes)).pooled()
    return Outcome(metrics, len(scenes), ranking.skipped)


def _by_relation(scored: list[Candidates], scenes: int) -> dict[str, Metric]:
    metrics: dict[str, Metric] = {}
    for a, name in enumerate(CANONICAL):
        some = of_relation(scored, a)
        if any(scene.truth.any() for scene in some):
            metrics[f"R-precision, {name}"] = rank(some, scenes).pooled()
    return metrics


def _zero_shot(scored: list[Candidates], setting: Setting) -> dict[str, Metric]:
    """R-precision over the triples that training never had, where that is known and any hold."""
    if setting.seen is None:
        return {}
    new = unseen(scored, setting.seen, setting.scenes.v.shape[1])
    if not any(scene.truth.any() for scene in new):
        return {}
    return {"R-precision, zero-shot": rank(new, len(setting.scenes)).pooled()}


def missing_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T2."""
    if contender.objects is None:
        return None
    scenes = setting.scenes
    result = leave_one_out(scenes, setting.structure, contender.objects)
    if not len(result.target):
        return None
    unknown = np.array([scene.unknown for scene in scenes.scenes], dtype=np.int64)
    metrics: dict[str, Metric] = dict(missing_metrics(result))
    metrics["MRR, unknown labels score 0"] = result.with_unknown(unknown)
    return Outcome(metrics, len(scenes), result.skipped)


def missing_in_room_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T2 on the scenes whose room type is known and given; beside it the same with it withheld."""
    known = (setting.scenes.room >= 0).nonzero().squeeze(1)
    if contender.objects_in_rooms is None or not len(known):
        return None
    scenes = subset(setting.scenes, known)
    result = leave_one_out_in_rooms(scenes, setting.structure, contender.objects_in_rooms)
    if not len(result.target):
        return None
    metrics: dict[str, Metric] = dict(missing_metrics(result))
    if contender.objects is not None:
        blind = leave_one_out(scenes, setting.structure, contender.objects)
        metrics["MRR, room type withheld"] = blind.ratio(blind.reciprocal_rank())
    return Outcome(metrics, len(scenes), result.skipped)


def placed_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T2-at; beside it the same questions answered without the place."""
    if contender.placed is None:
        return None
    scenes = setting.some(related=True, share=_COSTLY)
    found = leave_one_out_at(scenes, setting.structure, contender.placed, seed=setting.seed)
    if not len(found.relation):
        return None
    metrics: dict[str, Metric] = {"MRR": found.mrr()}
    for a, name in enumerate(CANONICAL):
        if (found.relation == a).any():
            metrics[f"MRR, {name}"] = found.mrr(a)
    if contender.objects is not None:
        objects = contender.objects
        blind = leave_one_out_at(
            scenes, setting.structure, lambda places: objects(places.v), seed=setting.seed
        )
        metrics["MRR, place unknown"] = blind.mrr()
    return Outcome(metrics, len(scenes), found.ranking.skipped)


def outliers_task(
    contender: Contender,
    setting: Setting,
    *,
    law: Callable[[SceneTensors, SceneTensors], Tensor] | None = None,
) -> Outcome | None:
    """T3, the intruder drawn by weights (N, V), uniformly by default."""
    if contender.objects is None or (law is not None and setting.train is None):
        return None
    scenes = setting.some()
    weights = law(scenes, setting.train) if law is not None and setting.train is not None else None
    scores = intruder_scores(
        scenes, setting.structure, contender.objects, weights=weights, seed=setting.seed
    )
    if not len(scores.scene):
        return None
    metrics: dict[str, Metric] = {
        "hit@1": scores.hit_at_1(),
        "AUROC": scores.auroc(),
        "average precision": scores.average_precision(),
    }
    if contender.alarm is not None:
        loud = contender.alarm.raised(scores)
        metrics["alarms in untouched scenes"] = scores.false_alarms(loud)
        metrics["intruders caught"] = scores.caught(loud)
    return Outcome(metrics, len(scenes), scores.skipped)


def placement_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T3b."""
    if contender.placement is None:
        return None
    scenes = setting.some(related=True)
    scores = placement_scores(scenes, setting.structure, contender.placement, seed=setting.seed)
    if not len(scores.scene):
        return None
    metrics: dict[str, Metric] = {"hit@1": scores.hit_at_1(), "AUROC": scores.auroc()}
    return Outcome(metrics, len(scenes), scores.skipped)


def generation_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T4: as many scenes as there are in a second half of the held-out ones, against the first.

    Free; given the room types of the second half; and given one class each, drawn from all the
    classes that scenes of the second half hold. A scene then comes up as often as it has classes:
    so the first half counts by size there, and a perfect sampler would leave no discrepancy.
    """
    if contender.sampler is None or setting.train is None:
        return None
    first, second = setting.halves()
    asked = first.annotated_classes[first.source].any(0) & ~setting.structure
    mentions = ((second.v > 0) & asked).nonzero()
    if min(len(first), len(second), len(mentions)) < 2 or not first.v[:, asked].any():
        return None
    bandwidth = median_distance(first.v[:, asked])
    nothing = torch.zeros_like(second.v, dtype=torch.bool)
    nowhere = torch.full_like(second.room, -1)
    order = np.random.default_rng(setting.seed).permutation(len(mentions))[: len(second)]
    classes = mentions[torch.from_numpy(order), 1]
    one = nothing[: len(classes)].scatter(1, classes.unsqueeze(1), True)
    size = first.v[:, asked].sum(1)
    conditions = {
        "free": (nothing, nowhere, None),
        "given room types": (nothing, second.room, None),
        "given one class": (one, nowhere[: len(one)], size),
    }
    metrics: dict[str, Metric] = {}
    for name, (given, room, emphasis) in conditions.items():
        drawn = contender.sampler(given, room, setting.seed)
        found = generation_metrics(drawn, first.v, setting.train.v, asked, bandwidth, emphasis)
        metrics |= {f"{metric}, {name}": value for metric, value in found.items()}
    notes = {"bandwidth": bandwidth, "held-out scenes": len(first), "drawn scenes": len(second)}
    return Outcome(metrics, len(first), 0, notes)


def floor_contender(setting: Setting) -> Contender:
    """A second half of the held-out scenes as if it had been drawn: the floor of T4."""
    _, second = setting.complete.halves()
    return Contender(sampler=scene_sampler(second)) if len(second) else Contender()


def independent_contender(setting: Setting) -> Contender:
    """Classes drawn independently, each as often as in training."""
    train = setting.complete.train
    if train is None:
        return Contender()
    return Contender(
        sampler=independent_sampler(train),
        density=lambda: independent_density(train),
        parameters=train.v.shape[1],
    )


def density_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Log-likelihood of the objects in nats; claims rest on the upper estimate of log Z."""
    if contender.density is None or setting.train is None:
        return None
    scenes = setting.some()
    density = contender.density()
    log_sum = density.log_unnormalised(scenes.v).double().numpy()
    independent = independent_density(setting.train)
    base = independent.log_unnormalised(scenes.v).double().numpy()
    one = np.ones(len(scenes))
    metrics: dict[str, Metric] = {
        "log-likelihood, upper log Z": Ratio(log_sum - density.upper, one),
        "log-likelihood, lower log Z": Ratio(log_sum - density.lower, one),
        "log-likelihood, independent classes": Ratio(base, one),
        "gain over independent classes, upper log Z": Ratio(log_sum - density.upper - base, one),
    }
    notes = {"log Z, upper": density.upper, "log Z, lower": density.lower} | density.notes
    return Outcome(metrics, len(scenes), 0, notes)


def calibration_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Every probability of the service, as published and with log-odds as they are."""
    if contender.artifact is None:
        return None
    related = setting.some(related=True, share=_COSTLY)
    complete = setting.complete.some(share=_COSTLY)
    at_place = setting.complete.some(related=True, share=_COSTLY)
    of_objects = {"missing": complete, "outliers": complete, "missing at a place": at_place}
    metrics: dict[str, Metric] = {}
    skipped = 0
    published, plain = contender.artifact, uncalibrated(contender.artifact)
    for name, ask in _questions(complete, setting).items():
        asked = of_objects.get(name, related)
        found = collect(published, asked, ask, setting.seed)
        skipped += found.skipped
        if len(found.scene):
            before = collect(plain, asked, ask, setting.seed)
            metrics[f"ECE, {name}"] = found.ece()
            metrics[f"ECE, {name}, uncalibrated"] = before.ece()
            metrics[f"Brier skill, {name}"] = found.brier_skill()
            metrics[f"Brier skill, {name}, uncalibrated"] = before.brier_skill()
    # Skill is undefined where no answer was true, or every one.
    metrics = {name: metric for name, metric in metrics.items() if np.isfinite(metric.value)}
    return Outcome(metrics, max(len(related), len(complete)), skipped) if metrics else None


def _questions(complete: SceneTensors, setting: Setting) -> dict[str, Ask]:
    """`QUESTIONS`, with intruders of every kind among these scenes."""
    intruders = kinds_of_intruders(
        complete, setting.structure, setting.complete.train, setting.seed
    )
    return QUESTIONS | {"outliers": partial(ask_outliers, intruders=intruders)}


ONCE = ("Everyday",)
"""Tasks that do not depend on the scenes: measured on the set of all sources alone."""

WHOLE_SET = ("T4 generate", *ONCE)
"""Tasks whose metrics are of a set of scenes as a whole: of several sources they are measured anew.

The others' are pooled from what was found of each source.
"""

TASKS: dict[str, Task] = {
    "T1a relations": relations_task,
    "T1 pairs": pairs_task,
    "T1 with evidence": relations_evidence_task,
    "T1b completion": completion_task,
    "T2 missing": about_objects(missing_task),
    "T2 missing, room type given": about_objects(missing_in_room_task),
    "T2 partial": about_objects(partial_task),
    "T2 with evidence": about_objects(missing_evidence_task),
    "T2-at missing at a place": about_objects(placed_task),
    "T3 outliers, uniform": about_objects(outliers_task),
    "T3 outliers, by popularity": about_objects(partial(outliers_task, law=by_popularity)),
    "T3 outliers, same room type": about_objects(partial(outliers_task, law=by_room)),
    "T3 signature": about_objects(signature_task),
    "T3 sensitivity": about_objects(sensitivity_task),
    "T3 with evidence": about_objects(outliers_evidence_task),
    "T3b placement": placement_task,
    "T4 generate": about_objects(generation_task),
    "Density": about_objects(density_task),
    "Calibration": calibration_task,
    "Everyday": everyday_task,
}
