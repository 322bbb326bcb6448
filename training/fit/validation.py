"""Validation scores of a machine in training."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from training.datasets.batches import TrainingData
from training.machines import BoltzmannMachine


@torch.no_grad()
def object_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    return math.nan


def relation_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    return math.nan
