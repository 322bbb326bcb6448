"""Baselines that score a scene's objects in closed form, by counting, or by scikit-learn's RBM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from sklearn.neural_network import BernoulliRBM
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, embedding_bag, normalize

from training.baselines.fitting import Proposals
from training.batches import SceneTensors
from training.evaluation.density import DensitySettings, ObjectDensity, ising_density
from training.evaluation.missing import MachineScore, ObjectScore
from training.machines import BoltzmannMachine, MachineSpec, build

# Scores that are linear in what else is present.


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

    @property
    def parameter_count(self) -> int:
        """Weights that are not zero."""
        return len(self.bias) + int(self.weights.count_nonzero())

    def __call__(self, v: Tensor) -> Tensor:
        """Scores (B, V) of presence (B, V)."""
        return self.bias + v @ self.weights


# How often each class is there at all.


def frequency(v: Tensor) -> Tensor:
    """Share of scenes with each class (V,), half a scene added to both sides."""
    return (v.sum(0) + 0.5) / (len(v) + 1.0)


def popularity(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """One proposal: nothing to tune."""
    V = train.v.shape[1]
    yield {}, LinearScore(frequency(train.v).logit(), torch.zeros(V, V))


# Co-occurrence: Bernoulli naive Bayes over the other classes that are present.
#
#     log-odds of i = logit p(i) + t · sum_{j present} log p(j | i) / p(j | not i)
#
# Classes that are absent are not counted as evidence: most of them were merely not mentioned.
# Evidence from classes that go together is counted many times over, which the exponent t < 1
# tempers.


_SMOOTHING = (10.0, 100.0, 300.0)
_EXPONENTS = (0.2, 0.3, 0.5, 1.0)


def evidence(v: Tensor, smoothing: float) -> Tensor:
    """log p(j | i) / p(j | not i) as (V, V) [j, i], zero on the diagonal.

    Args:
        smoothing: scenes of average content that are added to those with i and to those without.
    """
    both, count, scenes = v.T @ v, v.sum(0), len(v)
    average = frequency(v).unsqueeze(1) * smoothing
    given = (both + average) / (count + smoothing)
    otherwise = (count.unsqueeze(1) - both + average) / (scenes - count + smoothing)
    return (given / otherwise).log().fill_diagonal_(0.0)


def naive_bayes(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Smoothing × exponent."""
    bias = frequency(train.v).logit()
    for smoothing in _SMOOTHING:
        weights = evidence(train.v, smoothing)
        for exponent in _EXPONENTS:
            parameters = {"smoothing": smoothing, "exponent": exponent}
            yield parameters, LinearScore(bias, exponent * weights)


# kNN over scenes: what is in the training scenes most like this one.
#
#     p(i) = (sum of the votes of the neighbours that have i + share of all scenes with i)
#            / (sum of votes + 1),    scored as its logit
#
# The nearest scene has one vote, the others a power of their cosine as a share of the nearest
# one's.


_NEIGHBOURS = (100, 200)
_SHARPNESS = (2.0, 4.0, 8.0, 12.0)


def nearest_score(v: Tensor, *, neighbours: int, sharpness: float) -> ObjectScore:
    """Log-odds (B, V) of presence (B, V).

    Args:
        v: (N, V) training scenes.
        neighbours: k.
        sharpness: power of a cosine, relative to the nearest's, in a vote.
    """
    popularity = frequency(v)
    index = normalize(v, dim=1).T.contiguous()

    def score(query: Tensor) -> Tensor:
        cosine = normalize(query, dim=1) @ index
        near, place = cosine.topk(min(neighbours, len(v)), dim=1)
        # A scene that shares nothing has no vote, nor has any for an empty query.
        vote = (near / near[:, :1].clamp(min=1e-6)) ** sharpness
        share = embedding_bag(place, v, per_sample_weights=vote, mode="sum") + popularity
        return (share / (vote.sum(1, keepdim=True) + 1.0)).logit()

    return score


def nearest(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Neighbours × powers of their cosines."""
    for k in _NEIGHBOURS:
        for power in _SHARPNESS:
            score = nearest_score(train.v, neighbours=k, sharpness=power)
            yield {"neighbours": k, "sharpness": power}, score


# EASE, the linear item model in closed form.
#
# H. Steck, "Embarrassingly Shallow Autoencoders for Sparse Data", WWW 2019, equation 8: with P =
# (X'X + λI)⁻¹ the least-squares weights without a diagonal are -P[j,i] / P[i,i]. Here X is centred,
# which is the same regression with a free intercept. (Recommender libraries that offer EASE bring
# their own data sets and trainers around these three lines, without the intercept.)


_EASE_L2 = (10.0, 30.0, 100.0, 300.0)


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


def ease(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """L2 penalties."""
    for l2 in _EASE_L2:
        yield {"l2": l2}, fit_ease(train.v, l2)


# Pairwise logistic model: an Ising model of classes, fitted by pseudo-likelihood.
#
# J. Besag, "Statistical analysis of non-lattice data", The Statistician 24 (1975): maximise over
# the training set sum log p(v_i | others) - l2/2 · sum_{i<j} W[i,j]², where logit p(v_i = 1 |
# others) = b_i + sum_j W[i,j] v_j and W is symmetric with zero diagonal. The problem is convex;
# L-BFGS solves it.


_PAIRWISE_L2 = (30.0, 10.0, 3.0)
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


def pairwise(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[LinearScore]:
    """L2 penalties, each starting where the stronger one ended."""
    score = None
    for l2 in _PAIRWISE_L2:
        score = fit_pairwise(train.v, l2, start=score)
        yield {"l2": l2}, score


def pairwise_densities(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[ObjectDensity]:
    """The joint distributions of the same models.

    Their best penalty is another one: at a weak one pseudo-likelihood leaves a second mode of
    scenes that are full of everything, which conditionals of real scenes never show.
    """
    for parameters, score in pairwise(train, structure, seed):
        yield parameters, ising_density(score.bias, score.weights, train, _EFFORT, seed)


# scikit-learn's `BernoulliRBM` on objects alone, scored by its exact log-odds.
#
# The trained weights are put into our own machine without relation units, whose energy is the same,
# so that both models are scored by one piece of code.


_HIDDEN = 200
# Too high a rate makes persistent CD fall back to popularity, without any error.
_LEARNING_RATES = (0.1, 0.2, 0.4)
_EPOCHS = 60
_BATCH = 32


def fit_annealed(
    v: Tensor, *, hidden: int, learning_rate: float, epochs: int, seed: int
) -> BoltzmannMachine:
    """Train by scikit-learn's updates (`partial_fit`) while the rate falls linearly to 0.

    Persistent chains follow a model that stands still in the end: on the indoor scenes' validation
    part 40 passes so reach an MRR of .411; at a constant rate it is .377 after 10 passes and .378
    after 20. Batches are drawn anew in each pass; what does not fill one waits for another pass.

    Args:
        v: (N, V) binary presence.
        hidden: H1.
        learning_rate: at the start.
        epochs: passes over the data.
    """
    size = min(_BATCH, len(v))
    rbm = BernoulliRBM(n_components=hidden, batch_size=size, random_state=seed)
    order = np.random.default_rng(seed)
    for epoch in range(epochs):
        rbm.set_params(learning_rate=learning_rate * (1 - epoch / epochs))
        whole = order.permutation(len(v))[: len(v) // size * size]
        for index in whole.reshape(-1, size):
            rbm.partial_fit(v[index].numpy())
    return _as_machine(rbm)


def _as_machine(rbm: BernoulliRBM) -> BoltzmannMachine:
    hidden, V = rbm.components_.shape
    machine = build(MachineSpec("rbm", V=V, A=1, H1=hidden))
    with torch.no_grad():
        machine.b.copy_(torch.as_tensor(rbm.intercept_visible_))
        machine.c1.copy_(torch.as_tensor(rbm.intercept_hidden_))
        machine.W.copy_(torch.as_tensor(rbm.components_.T))
    return machine


def bernoulli_rbm(train: SceneTensors, _structure: Tensor, seed: int) -> Proposals[ObjectScore]:
    """Learning rates."""
    for rate in _LEARNING_RATES:
        machine = fit_annealed(
            train.v, hidden=_HIDDEN, learning_rate=rate, epochs=_EPOCHS, seed=seed
        )
        yield {"learning_rate": rate, "epochs": _EPOCHS}, MachineScore(machine)
