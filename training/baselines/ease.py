"""EASE, the linear item model in closed form.

H. Steck, "Embarrassingly Shallow Autoencoders for Sparse Data", WWW 2019, equation 8: with
P = (X'X + λI)⁻¹ the least-squares weights without a diagonal are -P[j,i] / P[i,i]. Here X is
centred, which is the same regression with a free intercept. (Recommender libraries that offer EASE
bring their own data sets and trainers around these three lines, without the intercept.)
"""

from __future__ import annotations

import torch
from torch import Tensor

from training.baselines.fitting import Proposals
from training.baselines.linear import LinearScore
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore

_L2 = (10.0, 30.0, 100.0, 300.0)


def fit_ease(v: Tensor, l2: float) -> LinearScore:
    """Ridge regression of every class on all others.

    Args:
        v: (N, V) presence.
        l2: λ > 0.
    """
    mean = v.double().mean(0)
    centred = v.double() - mean
    gram = centred.T @ centred
    gram.diagonal().add_(l2)
    precision = torch.linalg.inv(gram)
    weights = (-precision / precision.diagonal()).fill_diagonal_(0.0)
    return LinearScore((mean - mean @ weights).float(), weights.float())


def propose(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """L2 penalties."""
    for l2 in _L2:
        yield {"l2": l2}, fit_ease(train.v, l2)
