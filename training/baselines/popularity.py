"""How often each class is there at all."""

from __future__ import annotations

import torch
from torch import Tensor

from training.baselines.fitting import Proposals
from training.baselines.linear import LinearScore
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore


def frequency(v: Tensor) -> Tensor:
    """Share of scenes with each class (V,), half a scene added to both sides."""
    return (v.sum(0) + 0.5) / (len(v) + 1.0)


def propose(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """One proposal: nothing to tune."""
    V = train.v.shape[1]
    yield {}, LinearScore(frequency(train.v).logit(), torch.zeros(V, V))
