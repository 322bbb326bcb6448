"""The figures of one machine on one set of scenes, per source and pooled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from app.boltzmann import BoltzmannMachine
from app.scene import CANONICAL
from training.batches import SceneTensors
from training.evaluation.intervals import Figure
from training.evaluation.missing import leave_one_out, machine_score, missing_figures, with_unknown
from training.evaluation.outliers import intruder_scores
from training.evaluation.relations import machine_score as relation_score
from training.evaluation.relations import rank_relations, rank_scored, score_scenes
from training.trainer import subset

_OUTLIER_SCENES = 600


@dataclass(frozen=True)
class Row:
    """One figure: task and source as in the evaluation's tables."""

    task: str
    source: str
    metric: str
    figure: Figure


def by_source(scenes: SceneTensors) -> Iterator[tuple[str, SceneTensors]]:
    """The scenes of each source."""
    for source in sorted({scene.source for scene in scenes.scenes}):
        index = [k for k, scene in enumerate(scenes.scenes) if scene.source == source]
        yield source, subset(scenes, torch.tensor(index))


def evaluate(
    machine: BoltzmannMachine,
    scenes: SceneTensors,
    structure: Tensor,
    *,
    progress: Callable[[str], None] = lambda _: None,
) -> list[Row]:
    """T1a, T2 and T3 of a machine on every source of a set of scenes."""
    rows: list[Row] = []
    for source, some in by_source(scenes):
        progress(f"{source}: missing objects")
        rows += missing_rows(machine, some, structure, source)
        related = [k for k, scene in enumerate(some.scenes) if scene.evidence.holds.any()]
        if related:
            progress(f"{source}: relations")
            rows += relation_rows(machine, subset(some, torch.tensor(related)), structure, source)
        progress(f"{source}: outliers")
        sample = subset(some, torch.arange(min(len(some), _OUTLIER_SCENES)))
        scores = intruder_scores(sample, structure, machine_score(machine))
        rows.append(Row("T3 outliers, uniform", source, "hit@1", scores.hit_at_1()))
        rows.append(Row("T3 outliers, uniform", source, "AUROC", scores.auroc()))
    return rows


def missing_rows(
    machine: BoltzmannMachine, scenes: SceneTensors, structure: Tensor, source: str
) -> list[Row]:
    """T2 on one source."""
    result = leave_one_out(scenes, structure, machine_score(machine))
    names = {"mrr": "MRR", "top1": "top-1", "top5": "top-5", "top10": "top-10"}
    rows = [
        Row("T2 missing", source, names[metric], figure)
        for metric, figure in missing_figures(result).items()
    ]
    unknown = np.array([scene.unknown for scene in scenes.scenes], dtype=np.int64)
    every = with_unknown(result, unknown)
    return [*rows, Row("T2 missing", source, "MRR, unknown labels score 0", every)]


def relation_rows(
    machine: BoltzmannMachine, scenes: SceneTensors, structure: Tensor, source: str
) -> list[Row]:
    """T1a on one source, with and without instance counts, and per relation."""
    task = "T1a relations"
    rows: list[Row] = []
    scored = score_scenes(scenes, relation_score(machine))
    ranking = rank_scored(scored, structure, len(scenes))
    if not len(ranking.annotated):
        return rows
    plain = rank_relations(scenes, structure, relation_score(machine, counts=False))
    rows.append(Row(task, source, "R-precision, distinct classes", plain.pooled()))
    rows.append(Row(task, source, "R-precision, instance counts", ranking.pooled()))
    rows.append(Row(task, source, "R-precision, mean over scenes", ranking.per_scene()))
    for a, name in enumerate(CANONICAL):
        ranking = rank_scored(scored, structure, len(scenes), relation=a)
        if len(ranking.annotated):
            rows.append(Row(task, source, f"R-precision, {name}", ranking.pooled()))
    return rows
