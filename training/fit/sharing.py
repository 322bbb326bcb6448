"""Weights that classes share with their parent and with classes of similar word vectors.

The weights of a class are the sum of three parts: a deviation of the class, the deviation of its
parent, and a trained linear map of its word vector. The normal prior pulls the deviation of a class
to 0. So a class with few scenes has weights like its parent and its neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import (
    is_parametrized,
    register_parametrization,
    remove_parametrizations,
)

from training.machines import BoltzmannMachine


class Sharing(nn.Module):
    """Add the parent's deviation and a trained map of word vectors to the weights of each class.

    Args:
        words: scaled word vectors, (classes, dimensions), 0 where unknown.
        parents: index of the parent of each class, (classes,) int64. -1 means no parent.
        width: number of weights of a class.
        columns: True if the weights have the shape (width, classes), else (classes, width).
    """

    def __init__(self, words: Tensor, parents: Tensor, width: int, *, columns: bool) -> None:
        super().__init__()
        self.words, self.parents, self.columns = words, parents, columns
        self.map = nn.Parameter(torch.zeros(words.shape[1], width))

    def forward(self, deviation: Tensor) -> Tensor:
        own = deviation.T if self.columns else deviation
        inherited = own[self.parents.clamp(min=0)] * (self.parents >= 0).unsqueeze(1)
        total = own + inherited + self.words @ self.map
        return total.T if self.columns else total


def share_weights(
    machine: BoltzmannMachine, words: Tensor, parents: Tensor, names: Iterable[str]
) -> None:
    """Let classes share the weights of the given names. Weights that a machine lacks are skipped.

    `Sharing` describes words and parents.
    """
    parameters = dict(machine.named_parameters())
    for name in names:
        if name in parameters:
            columns = name in ("s", "o")
            width = parameters[name].shape[0 if columns else 1]
            sharing = Sharing(words, parents, width, columns=columns)
            register_parametrization(machine, name, sharing)


def bake_shared_weights(machine: BoltzmannMachine, names: Iterable[str]) -> None:
    """Replace each of the shared weights by the sum of its parts, for storage."""
    for name in names:
        if is_parametrized(machine, name):
            remove_parametrizations(machine, name, leave_parametrized=True)
