"""Baselines for objects: class frequencies and EASE."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from training.datasets.batches import SceneTensors
from training.evaluation.baselines.fitting import Proposals
from training.evaluation.model import ObjectScore
from training.evaluation.setting import Structure


@dataclass(frozen=True, eq=False)
class LinearScore:
    """The linear score bias + v · weights of each class.

    Rows of the weights are present classes, columns are scored classes. The diagonal is zero.
    """

    bias: Float[Tensor, " V"]
    weights: Float[Tensor, "V V"]

    @property
    def parameter_count(self) -> int:
        """Number of biases and of weights that are not zero."""
        return len(self.bias) + int(self.weights.count_nonzero())

    def __call__(self, v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
        """Return the score of each class for the presence of classes."""
        return self.bias + v @ self.weights


@dataclass(frozen=True, eq=False)
class Lists:
    """Training scenes as the object part of a machine learns from them."""

    v: Float[Tensor, "scenes V"]  # without structure classes
    labelled: Bool[Tensor, "scenes V"]  # False for classes that the data source cannot show
    weight: Float[Tensor, " scenes"]  # 1 in the mean
    index: Int[Tensor, " scenes"]  # in training

    def frequency(self) -> Float[Tensor, " V"]:
        """Return the share of scenes with each class among the labelled scenes."""
        return frequency(self.v, self.weight, self.labelled)

    def filled(self) -> Float[Tensor, "scenes V"]:
        """Return the presence with unlabelled entries replaced by the frequency of the class."""
        return torch.where(self.labelled, self.v, self.frequency())


def training_lists(train: SceneTensors, structure: Structure) -> Iterator[tuple[str, Lists]]:
    """Yield sets of training scenes with their names. A baseline chooses between the sets.

    A set has all scenes, or only those with complete object lists. A class that a data source
    cannot show is unlabelled, or it is absent.
    """
    able = train.annotated_classes[train.source] & ~structure
    v, weight = train.v * ~structure, train.weight
    for absent, labelled in (("", able | (v > 0)), (", unlisted absent", ~structure.expand_as(v))):
        for name, mask in (("all", torch.ones_like(train.complete)), ("complete", train.complete)):
            is_new = name == "all" or not mask.all()
            if mask.any() and is_new and not (absent and able[mask].all(0)[~structure].all()):
                share = weight[mask] / weight[mask].mean()
                index = mask.nonzero().squeeze(1)
                yield name + absent, Lists(v[mask], labelled[mask], share, index)


def frequency(
    v: Float[Tensor, "scenes V"],
    weight: Float[Tensor, " scenes"] | None = None,
    labelled: Bool[Tensor, "scenes V"] | None = None,
) -> Float[Tensor, " V"]:
    """Return the share of scenes with each class, smoothed by 1/2 in both counts."""
    weight = torch.ones(len(v)) if weight is None else weight
    total = weight.sum().expand(v.shape[1])
    if labelled is not None:
        of_labelled = weight @ labelled.to(v.dtype)
        total = torch.where(of_labelled > 0, of_labelled, total)
    return (weight @ v + 0.5) / (total + 1.0)


def popularity(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[ObjectScore]:
    """Yield the log-odds of the class frequencies."""
    V = train.v.shape[1]
    for name, lists in training_lists(train, structure):
        yield {"scenes": name}, LinearScore(lists.frequency().logit(), torch.zeros(V, V))


_EASE_L2 = (3.0, 10.0, 30.0, 50.0, 100.0, 300.0)


def fit_ease(
    v: Float[Tensor, "scenes V"], l2: float, weight: Float[Tensor, " scenes"] | None = None
) -> LinearScore:
    """Fit EASE, a ridge regression of every class on all other classes with a free intercept.

    Source: Steck, "Embarrassingly Shallow Autoencoders for Sparse Data", WWW 2019, equation 8. With
    the centred presence X and P = (X'X + λI)⁻¹, the least-squares weights with zero diagonal are
    -P[j,i] / P[i,i]. `weight` weighs the squared errors of each scene.
    """
    w = torch.ones(len(v)) if weight is None else weight
    x, w = v.double(), w.double()
    mean = w @ x / w.sum()
    centred = x - mean
    gram = (centred * w.unsqueeze(1)).T @ centred
    gram.diagonal().add_(l2)
    precision = torch.linalg.inv(gram)
    weights = (-precision / precision.diagonal()).fill_diagonal_(0.0)
    return LinearScore((mean - mean @ weights).float(), weights.float())


def ease(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each ridge penalty. Unlabelled classes have their mean."""
    for name, lists in training_lists(train, structure):
        v = lists.filled()
        for l2 in _EASE_L2:
            yield {"scenes": name, "l2": l2}, fit_ease(v, l2, lists.weight)
