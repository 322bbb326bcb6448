"""The fully visible Boltzmann machine (Ising model) of classes, and its log Z by annealing.

p(v) = exp(b·v + v'Wv / 2) / Z with W symmetric and its diagonal zero. The path runs from
independent classes with log-odds a at beta = 0, where log Z is a sum, to the model at beta = 1: its
log-odds are (1 - beta) a + beta b, its edges beta W. One sweep updates every class in turn.

Source: Neal, "Annealed importance sampling" (2001), run in both directions as in
`training.machines.partition`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.machines.partition import LogPartition

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ising:
    """A pairwise density over presence vectors.

    Attributes:
        b: (V,).
        W: (V, V).

    Raises:
        ValueError: shapes disagree, or W is not symmetric with a zero diagonal.
    """

    b: Floats
    W: Floats

    def __post_init__(self) -> None:
        V = len(self.b)
        if self.W.shape != (V, V):
            raise ValueError(f"W must be ({V}, {V}), not {self.W.shape}")
        if np.diagonal(self.W).any() or not np.allclose(self.W, self.W.T):
            raise ValueError("W must be symmetric with a zero diagonal")

    def log_unnormalised(self, v: Tensor) -> Tensor:
        """b·v + v'Wv / 2, (B,), of presence (B, V)."""
        x = v.double()
        W = torch.from_numpy(self.W)
        return x @ torch.from_numpy(self.b) + ((x @ W) * x).sum(1) / 2

    def log_partition(
        self, a: Floats, start: Tensor, betas: Sequence[float], burn_in: int, seed: int
    ) -> tuple[LogPartition, LogPartition]:
        """(forward, reverse) annealing with as many chains as `start` has rows.

        Args:
            a: (V,) log-odds of the independent classes at beta = 0.
            start: (chains, V) presence, from where `burn_in` sweeps lead to samples of the model.
            betas: rising from 0 to 1.
        """
        rng = np.random.default_rng(seed)
        log_base = float(np.logaddexp(0, a).sum())
        chains = len(start)
        state = State(self, (rng.random((len(a), chains)) < _sigmoid(a)[:, None]).astype(float))
        weight = np.zeros(chains)
        for warm, cold in pairwise(betas):
            weight += (cold - warm) * state.gain(a)
            state.sweep(a, cold, rng)
        below = LogPartition.of_weights(log_base, torch.from_numpy(weight))
        state = State(self, start.double().numpy().T.copy())
        for _ in range(burn_in):
            state.sweep(a, 1.0, rng)
        weight = np.zeros(chains)
        for warm, cold in zip(betas[-2::-1], betas[:0:-1], strict=True):
            state.sweep(a, cold, rng)
            weight -= (cold - warm) * state.gain(a)
        return below, LogPartition.of_weights(log_base, torch.from_numpy(weight), reverse=True)


class State:
    """Chains (V, chains), classes first so that one class of all chains lies together."""

    def __init__(self, model: Ising, v: Floats) -> None:
        self.model = model
        self.v = v
        self.field = model.W @ v

    def gain(self, a: Floats) -> Floats:
        """Log density less that of the independent classes, both without Z, (chains,)."""
        linear = (self.model.b - a) @ self.v
        return np.asarray(linear + (self.field * self.v).sum(0) / 2)

    def sweep(self, a: Floats, beta: float, rng: np.random.Generator) -> None:
        """Every class once in turn, given the others, at `beta`."""
        uniform = rng.random(self.v.shape)
        logits = np.log(uniform) - np.log1p(-uniform)
        bias = (1 - beta) * a + beta * self.model.b
        for i, (drawn, old) in enumerate(zip(logits, self.v, strict=True)):
            new = drawn < bias[i] + beta * self.field[i]
            changed = np.flatnonzero(new != old)
            if len(changed):
                self.field[:, changed] += np.outer(self.model.W[i], new[changed] - old[changed])
                self.v[i] = new


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-x)))
