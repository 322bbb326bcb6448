"""Baselines for objects: class counts, linear and pairwise models, and scikit-learn's RBM."""

from __future__ import annotations

import numpy as np
import torch
from sklearn.neural_network import BernoulliRBM
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, embedding_bag, normalize

from training.datasets.batches import SceneTensors
from training.evaluation.baselines.classes import LinearScore, frequency
from training.evaluation.baselines.fitting import Proposals
from training.evaluation.density_task import DensitySettings, ising_density
from training.evaluation.missing_tasks import MachineScore
from training.evaluation.model import ObjectDensity, ObjectScore
from training.machines import BoltzmannMachine, MachineSpec, build

# Co-occurrence: Bernoulli naive Bayes, with the present classes as evidence.
#
#     log-odds of i = logit p(i) + t · sum_{j present} log p(j | i) / p(j | not i)
#
# Absent classes are no evidence, because annotators do not mention every object. The formula treats
# classes that often occur together as independent evidence. A factor t < 1 corrects for this.

_SMOOTHING = (10.0, 100.0, 300.0)
_EXPONENTS = (0.2, 0.3, 0.5, 1.0)


def evidence(v: Tensor, smoothing: float) -> Tensor:
    """Return log p(j | i) / p(j | not i) for present class j and scored class i.

    The result has j as row and i as column, (classes, classes). The diagonal is zero.

    Args:
        smoothing: number of average scenes that are added to the scenes with i, and to the scenes
            without i.
    """
    pair_count, count, scenes = v.T @ v, v.sum(0), len(v)
    average = frequency(v).unsqueeze(1) * smoothing
    with_class = (pair_count + average) / (count + smoothing)
    without_class = (count.unsqueeze(1) - pair_count + average) / (scenes - count + smoothing)
    return (with_class / without_class).log().fill_diagonal_(0.0)


def naive_bayes(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each smoothing and each factor t."""
    bias = frequency(train.v).logit()
    for smoothing in _SMOOTHING:
        weights = evidence(train.v, smoothing)
        for exponent in _EXPONENTS:
            parameters = {"smoothing": smoothing, "exponent": exponent}
            yield parameters, LinearScore(bias, exponent * weights)


# kNN over scenes. The neighbours are the k training scenes that are most similar to the query.
#
#     p(i) = (sum of the votes of the neighbours that have i + share of all scenes with i)
#            / (sum of all votes + 1)
#
# The score is the logit of p(i). The vote of a neighbour is (cosine similarity of the neighbour /
# cosine similarity of the nearest neighbour) ** sharpness.

_NEIGHBOURS = (100, 200)
_SHARPNESS = (2.0, 4.0, 8.0, 12.0)


def nearest_score(v: Tensor, *, neighbours: int, sharpness: float) -> ObjectScore:
    """Return a score function from presence to log-odds, both (scenes, classes)."""
    popularity = frequency(v)
    index = normalize(v, dim=1).T.contiguous()

    def score(query: Tensor) -> Tensor:
        cosine = normalize(query, dim=1) @ index
        similarity, neighbour = cosine.topk(min(neighbours, len(v)), dim=1)
        # The vote of a training scene without a class of the query is 0.
        vote = (similarity / similarity[:, :1].clamp(min=1e-6)) ** sharpness
        share = embedding_bag(neighbour, v, per_sample_weights=vote, mode="sum") + popularity
        return (share / (vote.sum(1, keepdim=True) + 1.0)).logit()

    return score


def nearest(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each number of neighbours and each sharpness."""
    for k in _NEIGHBOURS:
        for power in _SHARPNESS:
            score = nearest_score(train.v, neighbours=k, sharpness=power)
            yield {"neighbours": k, "sharpness": power}, score


# Pairwise logistic model: an Ising model of classes, fitted by pseudo-likelihood.
#
# Source: J. Besag, "Statistical analysis of non-lattice data", The Statistician 24 (1975). The fit
# maximises this function, with the sum over training scenes and classes i:
#
#     sum log p(v_i | others) - l2/2 · sum_{i<j} W[i,j]²,
#     logit p(v_i = 1 | others) = b_i + sum_j W[i,j] v_j,    W symmetric with zero diagonal.
#
# The problem is convex. L-BFGS finds its optimum.

_PAIRWISE_L2 = (30.0, 10.0, 3.0)
_ITERATIONS = 40
# Settings for the estimate of log Z. A Gibbs sweep of this model updates one class at a time and is
# slow, so the number of temperatures is below the default. The error of log Z is about 0.01 nats.
_EFFORT = DensitySettings(chains=128, temperatures=1500, burn_in=500)


def fit_pairwise(
    v: Tensor, l2: float, *, start: LinearScore | None = None, iterations: int = _ITERATIONS
) -> LinearScore:
    """Fit the pairwise model by penalised pseudo-likelihood, from `start` or no interaction."""
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
    """Yield a score for each L2 penalty, largest first. A fit starts at the last solution."""
    score = None
    for l2 in _PAIRWISE_L2:
        score = fit_pairwise(train.v, l2, start=score)
        yield {"l2": l2}, score


def pairwise_densities(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[ObjectDensity]:
    """Yield the joint distribution of a pairwise model for each L2 penalty.

    The best penalty for the joint distribution differs from the best penalty for the conditionals.
    With a weak penalty, the fitted joint distribution has a second mode: scenes with very many
    classes. This mode has no effect on the conditionals of real scenes.
    """
    for parameters, score in pairwise(train, structure, seed):
        yield parameters, ising_density(score.bias, score.weights, train, _EFFORT, seed)


# `BernoulliRBM` of scikit-learn, trained on objects only. The score is the exact log-odds.
#
# The trained weights are copied into a machine of this project without relation units. Both models
# have the same energy, so `training.machines` can compute the log-odds.

_HIDDEN = 200
# Tested initial learning rates. With higher rates, persistent contrastive divergence learns only
# the class frequencies, without an error.
_LEARNING_RATES = (0.1, 0.2, 0.4)
_EPOCHS = 60
_BATCH = 32


def fit_annealed(
    v: Tensor, *, hidden: int, learning_rate: float, epochs: int, seed: int
) -> BoltzmannMachine:
    """Train scikit-learn's `BernoulliRBM` with a learning rate that falls linearly to 0.

    Persistent chains are accurate only if the model changes slowly at the end. On the indoor
    validation scenes, the MRR (mean reciprocal rank) is .411 after 40 epochs with the falling rate.
    With a constant rate, the MRR is .377 after 10 epochs and .378 after 20 epochs. Each epoch
    shuffles the scenes and skips an incomplete last batch.
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
    """Yield the score of a trained RBM for each initial learning rate."""
    for rate in _LEARNING_RATES:
        machine = fit_annealed(
            train.v, hidden=_HIDDEN, learning_rate=rate, epochs=_EPOCHS, seed=seed
        )
        yield {"learning_rate": rate, "epochs": _EPOCHS}, MachineScore(machine)
