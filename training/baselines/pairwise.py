"""Pairwise logistic model: an Ising model of classes, fitted by pseudo-likelihood.

J. Besag, "Statistical analysis of non-lattice data", The Statistician 24 (1975): maximise over the
training set sum log p(v_i | others) - l2/2 · sum_{i<j} W[i,j]², where
logit p(v_i = 1 | others) = b_i + sum_j W[i,j] v_j and W is symmetric with zero diagonal. The
problem is convex; L-BFGS solves it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from training.baselines.fitting import Proposals
from training.baselines.linear import LinearScore
from training.baselines.popularity import frequency
from training.batches import SceneTensors
from training.evaluation.density import DensitySettings, ObjectDensity, ising_density

_L2 = (30.0, 10.0, 3.0)
_ITERATIONS = 40
# Sweeps go class by class and are slow; log Z is known to some .01 nats by them.
_EFFORT = DensitySettings(chains=128, temperatures=1500, burn_in=500)


def fit_pairwise(
    v: Tensor, l2: float, *, start: LinearScore | None = None, iterations: int = _ITERATIONS
) -> LinearScore:
    """Penalised pseudo-likelihood weights.

    Args:
        v: (N, V) presence.
        l2: strength of the penalty, >= 0.
        start: where to begin; by default independent classes.
        iterations: of L-BFGS, at most.
    """
    V = v.shape[1]
    if start is None:
        start = LinearScore(frequency(v).logit(), torch.zeros(V, V))
    bias = start.bias.clone().requires_grad_()
    half = (start.weights / 2).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [bias, half], max_iter=iterations, history_size=10, line_search_fn="strong_wolfe"
    )

    def symmetric() -> Tensor:
        return (half + half.T) * (1.0 - torch.eye(V))

    def loss() -> Tensor:
        optimiser.zero_grad()
        W = symmetric()
        misfit = binary_cross_entropy_with_logits(bias + v @ W, v, reduction="sum")
        total = (misfit + l2 / 4 * W.square().sum()) / len(v)
        total.backward()
        return total

    optimiser.step(loss)
    with torch.no_grad():
        return LinearScore(bias.detach(), symmetric().detach())


def propose(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[LinearScore]:
    """L2 penalties, each starting where the stronger one ended."""
    score = None
    for l2 in _L2:
        score = fit_pairwise(train.v, l2, start=score)
        yield {"l2": l2}, score


def propose_densities(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[ObjectDensity]:
    """The joint distributions of the same models.

    Their best penalty is another one: at a weak one pseudo-likelihood leaves a second mode of
    scenes that are full of everything, which conditionals of real scenes never show.
    """
    for parameters, score in propose(train, structure, seed):
        yield parameters, ising_density(score.bias, score.weights, train, _EFFORT, seed)
