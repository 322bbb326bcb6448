"""Validation scores of a machine in training."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from training.datasets.batches import TrainingData, subset
from training.evaluation.artifact_model import relation_score as answers
from training.evaluation.parts import validation_score
from training.evaluation.relation_tasks import rank_relations
from training.fit.draft import draft_artifact
from training.machines import BoltzmannMachine

_SCENES = 200  # number of scenes with relations that are scored, at least


@torch.no_grad()
def object_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    """Return the MRR of hidden classes in random parts of real scenes; NaN without such scenes."""

    def log_odds(listed: Tensor, share: Tensor) -> Tensor:
        return machine.object_log_odds(listed * ~data.structure, share=share)

    return validation_score(log_odds, data.validation, data.structure)


def relation_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    """Return the R-precision of relations given the objects; NaN without annotated scenes."""
    annotated = [k for k, s in enumerate(data.validation.scenes) if s.evidence.holds.any()]
    if not annotated:
        return math.nan
    sample = subset(data.validation, torch.tensor(annotated[:: max(1, len(annotated) // _SCENES)]))
    score = answers(draft_artifact(machine, data.classes), given=False)
    ranking = rank_relations(sample, data.structure, score)
    return float(ranking.hits.sum() / max(ranking.annotated.sum(), 1))
