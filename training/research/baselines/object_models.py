"""Baselines for objects: class counts, linear and pairwise models, and scikit-learn's RBM."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, embedding_bag, normalize, softplus

from training.datasets.batches import SceneTensors
from training.evaluation.baselines.classes import LinearScore, Lists, frequency, training_lists
from training.evaluation.baselines.fitting import TRIALS, Proposals, drawn_settings, halving
from training.evaluation.model import ObjectScore, Parameters
from training.evaluation.setting import Structure

# Co-occurrence: Bernoulli naive Bayes, with the present classes as evidence.
#
#     log-odds of i = logit p(i) + t · sum_{j present} log p(j | i) / p(j | not i)
#
# Absent classes are no evidence, because annotators do not mention every object. The formula treats
# classes that often occur together as independent evidence. A factor t < 1 corrects for this.

_SMOOTHING = (30.0, 300.0)
_EXPONENTS = (0.2, 0.3, 0.5)


def evidence(
    v: Float[Tensor, "scenes V"], smoothing: float, weight: Float[Tensor, " scenes"] | None = None
) -> Float[Tensor, "V V"]:
    """Return log p(j | i) / p(j | not i) for present class j (row) and scored class i (column).

    The diagonal is zero. `smoothing` average scenes are added to the scenes with, and without, i.
    """
    w = torch.ones(len(v)) if weight is None else weight
    pair_count, count, scenes = (v * w.unsqueeze(1)).T @ v, w @ v, w.sum()
    average = frequency(v, w).unsqueeze(1) * smoothing
    with_class = (pair_count + average) / (count + smoothing)
    without_class = (count.unsqueeze(1) - pair_count + average) / (scenes - count + smoothing)
    return (with_class / without_class).log().fill_diagonal_(0.0)


def naive_bayes(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each set of scenes, smoothing and factor t."""
    for name, lists in training_lists(train, structure):
        for smoothing, t in product(_SMOOTHING, _EXPONENTS):
            weights = t * evidence(lists.filled(), smoothing, lists.weight)
            score = LinearScore(lists.frequency().logit(), weights)
            yield {"scenes": name, "smoothing": smoothing, "exponent": t}, score


# kNN over scenes. The neighbours are the k training scenes that are most similar to the query.
#
#     p(i) = (sum of the votes of the neighbours that have i + share of all scenes with i)
#            / (sum of all votes + 1)
#
# The score is the logit of p(i). The vote of a neighbour is (cosine similarity of the neighbour /
# cosine similarity of the nearest neighbour) ** sharpness, times the weight of the scene.

_NEIGHBOURS = (100, 200)
_SHARPNESS = (4.0, 8.0, 12.0)


def nearest_score(lists: Lists, *, neighbours: int, sharpness: float) -> ObjectScore:
    """Return a score function from presence to log-odds."""
    popularity, v = lists.frequency(), lists.filled()
    index = normalize(lists.v, dim=1).T.contiguous()

    def score(query: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
        cosine = normalize(query, dim=1) @ index
        similarity, neighbour = cosine.topk(min(neighbours, len(v)), dim=1)
        # The vote of a training scene without a class of the query is 0.
        vote = (similarity / similarity[:, :1].clamp(min=1e-6)) ** sharpness
        vote = vote * lists.weight[neighbour]
        share = embedding_bag(neighbour, v, per_sample_weights=vote, mode="sum") + popularity
        return (share / (vote.sum(1, keepdim=True) + 1.0)).logit()

    return score


def nearest(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each set of scenes, number of neighbours and sharpness."""
    for name, lists in training_lists(train, structure):
        for k, power in product(_NEIGHBOURS, _SHARPNESS):
            score = nearest_score(lists, neighbours=k, sharpness=power)
            yield {"scenes": name, "neighbours": k, "sharpness": power}, score


# Pairwise logistic model: an Ising model of classes, fitted by pseudo-likelihood.
#
# Source: J. Besag, "Statistical analysis of non-lattice data", The Statistician 24 (1975). The fit
# maximises this function, with the sum over training scenes and classes i:
#
#     sum log p(v_i | others) - l2/2 · sum_{i<j} W[i,j]²,
#     logit p(v_i = 1 | others) = b_i + sum_j W[i,j] v_j,    W symmetric with zero diagonal.
#
# The problem is convex. L-BFGS finds its optimum.

_PAIRWISE_L2 = (50.0, 30.0, 20.0, 10.0, 5.0, 3.0)
_ITERATIONS = 25


def fit_pairwise(
    lists: Lists, l2: float, *, start: LinearScore | None = None, iterations: int = _ITERATIONS
) -> LinearScore:
    """Fit the pairwise model by penalised pseudo-likelihood, from `start` or no interaction.

    Unlabelled classes have their frequency as evidence, and no term in the likelihood.
    """
    v, V = lists.v, lists.v.shape[1]
    if start is None:
        start = LinearScore(lists.frequency().logit(), torch.zeros(V, V))
    weight = lists.weight.unsqueeze(1) * lists.labelled
    # Sparse lists, and the unlabelled classes of each data source, are faster than dense lists.
    sparse = v.to_sparse()
    labelled, pattern = lists.labelled.unique(dim=0, return_inverse=True)
    unlabelled = ~labelled * lists.frequency()
    bias = start.bias.clone().requires_grad_()
    half = (start.weights / 2).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [bias, half], max_iter=iterations, history_size=10, line_search_fn="strong_wolfe"
    )

    def symmetric() -> Float[Tensor, "V V"]:
        return (half + half.T) * (1.0 - torch.eye(V))

    def loss() -> Float[Tensor, ""]:
        """Compute the penalised loss and its gradients."""
        optimiser.zero_grad()
        W = symmetric()
        logits = bias + torch.sparse.mm(sparse, W) + (unlabelled @ W)[pattern]
        misfit = binary_cross_entropy_with_logits(logits, v, weight, reduction="sum")
        total = (misfit + l2 / 4 * W.square().sum()) / len(v)
        total.backward()
        return total

    optimiser.step(loss)
    with torch.no_grad():
        return LinearScore(bias.detach(), symmetric().detach())


def pairwise(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[LinearScore]:
    """Yield a score for each L2 penalty, largest first. A fit starts at the last solution."""
    for name, lists in training_lists(train, structure):
        score = None
        for l2 in _PAIRWISE_L2:
            score = fit_pairwise(lists, l2, start=score)
            yield {"scenes": name, "l2": l2}, score


# `BernoulliRBM` of scikit-learn, trained on objects only. Each epoch draws scenes by their weights.
# Unlabelled classes have their frequency, because the library has no partial labels.
#
#     log-odds of i = b_i + sum_k [softplus(x_k + W_ki) - softplus(x_k)],   x = c + W v

# Initial learning rates. With higher rates, persistent contrastive divergence learns only the class
# frequencies, without an error.
_RBM_GRID: Final[dict[str, Sequence[Any]]] = {
    "hidden": (100, 200),
    "learning_rate": (0.05, 0.1, 0.2, 0.4),
    "batch_size": (32, 64),
}
_EPOCHS = 60
_RBM_RUNGS = ((TRIALS, 0.05), (6, 0.25), (2, 1.0))
_BLOCK = 8


@dataclass(frozen=True, eq=False)
class RbmScore:
    """Log-odds of each class of an RBM with biases b and c and weights W."""

    b: Float[Tensor, " V"]
    c: Float[Tensor, " H1"]
    W: Float[Tensor, "H1 V"]

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return self.b.numel() + self.c.numel() + self.W.numel()

    def __call__(self, v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
        """Return the log-odds of each unlisted class."""
        blocks = [self._hidden_log_odds(self.c + x @ self.W.T) for x in v.split(_BLOCK)]
        return torch.cat(blocks) + self.b

    def _hidden_log_odds(self, x: Float[Tensor, "B H1"]) -> Float[Tensor, "B V"]:
        return (softplus(x.unsqueeze(2) + self.W) - softplus(x).unsqueeze(2)).sum(1)


def fit_annealed(
    lists: Lists, *, hidden: int, learning_rate: float, batch_size: int, epochs: int, seed: int
) -> RbmScore:
    """Train scikit-learn's `BernoulliRBM` with a learning rate that falls linearly to 0.

    Persistent chains are accurate only if the model changes slowly at the end. On the indoor
    validation scenes, the MRR is .411 with the falling rate and .378 with a constant one.
    """
    from sklearn.neural_network import BernoulliRBM  # slow to import

    size, v = min(batch_size, len(lists.v)), lists.filled().numpy()
    rbm = BernoulliRBM(n_components=hidden, batch_size=size, random_state=seed)
    order = np.random.default_rng(seed)
    p = lists.weight.double().numpy()
    for epoch in range(epochs):
        rbm.set_params(learning_rate=learning_rate * (1 - epoch / epochs))
        drawn = order.choice(len(p), len(p) // size * size, p=p / p.sum())
        for index in drawn.reshape(-1, size):
            rbm.partial_fit(v[index])
    weights = rbm.intercept_visible_, rbm.intercept_hidden_, rbm.components_
    return RbmScore(*(torch.as_tensor(w, dtype=torch.float32) for w in weights))


def bernoulli_rbm(train: SceneTensors, structure: Structure, seed: int) -> Proposals[ObjectScore]:
    """Yield the score of a trained RBM for each setting and number of epochs."""
    lists = dict(training_lists(train, structure))

    def fit(setting: dict[str, Any], share: float) -> Iterator[tuple[Parameters, ObjectScore]]:
        options = {key: value for key, value in setting.items() if key != "scenes"}
        epochs = round(share * _EPOCHS)
        score = fit_annealed(lists[setting["scenes"]], **options, epochs=epochs, seed=seed)
        yield {"epochs": epochs}, score

    return halving(drawn_settings(scenes=tuple(lists), **_RBM_GRID), fit, _RBM_RUNGS)
