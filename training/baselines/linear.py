"""Scores that are linear in what else is present."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class LinearScore:
    """bias + v · weights; a class says nothing of itself.

    Attributes:
        bias: (V,).
        weights: (V, V), from present class to scored class, its diagonal zero.

    Raises:
        ValueError: shapes disagree or the diagonal is not zero.
    """

    bias: Tensor
    weights: Tensor

    def __post_init__(self) -> None:
        V = len(self.bias)
        if self.weights.shape != (V, V):
            raise ValueError(f"weights must be ({V}, {V}), not {tuple(self.weights.shape)}")
        if self.weights.diagonal().any():
            raise ValueError("the diagonal of the weights must be zero")

    def __call__(self, v: Tensor) -> Tensor:
        """Scores (B, V) of presence (B, V)."""
        return self.bias + v @ self.weights
