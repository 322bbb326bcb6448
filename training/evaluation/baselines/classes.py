"""Baselines for objects: class frequencies and EASE."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from training.datasets.batches import SceneTensors
from training.evaluation.baselines.fitting import Proposals
from training.evaluation.model import ObjectScore


@dataclass(frozen=True, eq=False)
class LinearScore:
    """The linear score bias + v · weights of each class.

    Attributes:
        bias: bias of each class, (classes,).
        weights: weights from a present class (row) to the scored class (column), (classes,
            classes). The diagonal is zero.

    Raises:
        ValueError: the shapes of bias and weights do not match, or the diagonal is not zero.
    """

    bias: Tensor
    weights: Tensor

    def __post_init__(self) -> None:
        V = len(self.bias)
        if self.weights.shape != (V, V):
            raise ValueError(
                f"the shape of weights must be ({V}, {V}), not {tuple(self.weights.shape)}"
            )
        if self.weights.diagonal().any():
            raise ValueError("the diagonal of the weights must be zero")

    @property
    def parameter_count(self) -> int:
        """Number of biases and of weights that are not zero."""
        return len(self.bias) + int(self.weights.count_nonzero())

    def __call__(self, v: Tensor) -> Tensor:
        """Return the score of each class for presence v, both (scenes, classes)."""
        return self.bias + v @ self.weights


def frequency(v: Tensor) -> Tensor:
    """Return the share of scenes with each class, (classes,), smoothed by 1/2 in both counts."""
    return (v.sum(0) + 0.5) / (len(v) + 1.0)


def popularity(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Yield a single score: the log-odds of the class frequencies."""
    V = train.v.shape[1]
    yield {}, LinearScore(frequency(train.v).logit(), torch.zeros(V, V))


_EASE_L2 = (10.0, 30.0, 100.0, 300.0)


def fit_ease(v: Tensor, l2: float) -> LinearScore:
    """Fit EASE, a ridge regression of every class on all other classes with a free intercept.

    Source: Steck, "Embarrassingly Shallow Autoencoders for Sparse Data", WWW 2019, equation 8. With
    the centred presence X and P = (X'X + λI)⁻¹, the least-squares weights with zero diagonal are
    -P[j,i] / P[i,i].
    """
    mean = v.double().mean(0)
    centred = v.double() - mean
    gram = centred.T @ centred
    gram.diagonal().add_(l2)
    precision = torch.linalg.inv(gram)
    weights = (-precision / precision.diagonal()).fill_diagonal_(0.0)
    return LinearScore((mean - mean @ weights).float(), weights.float())


def ease(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each ridge penalty."""
    for l2 in _EASE_L2:
        yield {"l2": l2}, fit_ease(train.v, l2)
