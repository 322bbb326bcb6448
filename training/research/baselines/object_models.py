"""Baselines for objects: class counts, linear and pairwise models, an RBM and an autoencoder."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, embedding_bag, normalize, softplus
from torch.optim.lr_scheduler import OneCycleLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from training.datasets.batches import SceneTensors
from training.evaluation.baselines import LinearScore, Lists, frequency, training_lists
from training.evaluation.selection import TRIALS, Proposals, drawn_settings, halving
from training.evaluation.setting import ObjectScore, Parameters, Structure

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
    """Return a score function from the presence of classes to kNN log-odds of all classes."""
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
    half = (start.weights / 2).requires_grad_()  # W is this matrix plus its transpose
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
        # The sum has each pair twice, hence l2 / 4.
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
        hidden = ((self.c + block @ self.W.T).unsqueeze(2) for block in v.split(_BLOCK))
        return torch.cat([(softplus(x + self.W) - softplus(x)).sum(1) for x in hidden]) + self.b


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


# The network learns to predict the hidden classes of random parts of scenes, as a machine does.
#
# A step draws scenes by their weights. In 30 % of the scenes, one class is hidden. In the others, a
# share U(.05, 1) of the classes is listed; at least one is listed and one hidden. The loss is the
# cross-entropy of the hidden classes under a softmax over the unlisted classes, or the binary
# cross-entropy of every unlisted class. Classes that the data source cannot show are left out. The
# optimiser is AdamW with one learning-rate cycle and an exponential moving average of the weights.
# Several late steps are candidates, so that selection on validation scenes has the effect of early
# stopping.
#
# Source of the softmax: D. Liang et al., "Variational Autoencoders for Collaborative Filtering",
# WWW 2018.

_AVERAGING = 0.998
_WARM_UP = 0.1
_ONE_HIDDEN = 0.3
_LEAST_SHARE = 0.05
_STEPS = 800
_OFFERS = (0.6, 0.8, 1.0)  # shares of the steps after which a network is a candidate
_BATCH = 256
LOSSES: Final = ("softmax", "binary")


@dataclass(frozen=True, eq=False)
class NetworkScore:
    """The score of each unlisted class: its logit, or log p under a softmax over these classes."""

    network: nn.Module
    structure: Structure
    softmax: bool

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    @torch.no_grad()
    def __call__(self, v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
        """Return the score of each class; -inf for present and structure classes."""
        values: Tensor = self.network(v * ~self.structure)
        values = values.masked_fill((v > 0) | self.structure, -torch.inf)
        return values.log_softmax(1) if self.softmax else values


def train_network(
    network: nn.Module,
    lists: Lists,
    structure: Structure,
    seed: int,
    *,
    learning_rate: float,
    weight_decay: float,
    loss: str,
    steps: int,
) -> Iterator[tuple[int, NetworkScore]]:
    """Train on scenes with two classes. Yield candidate steps, and scores of averaged weights.

    Raises:
        ValueError: all scenes have fewer than two classes.
    """
    usable = lists.v.sum(1) > 1
    if not usable.any():
        raise ValueError("no training scene has two classes without structure")
    v, labelled, weight = lists.v[usable], lists.labelled[usable], lists.weight[usable]
    optimiser = torch.optim.AdamW(network.parameters(), lr=learning_rate, weight_decay=weight_decay)
    schedule = OneCycleLR(optimiser, learning_rate, total_steps=steps + 1, pct_start=_WARM_UP)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(_AVERAGING))
    candidates = {max(1, round(share * steps)) for share in _OFFERS}
    for step in range(1, steps + 1):
        # Dropout uses the global random generator. The fork restores its state after the block.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed * 1_000_003 + step)  # differs for each seed and step
            network.train()
            index = weight.multinomial(_BATCH, replacement=True)
            optimiser.zero_grad()
            hidden_loss(network, v[index], labelled[index], loss).backward()
            optimiser.step()
            schedule.step()
            average.update_parameters(network)
        if step in candidates:
            trained = copy.deepcopy(average.module).eval()
            yield step, NetworkScore(trained, structure, loss == "softmax")


def draw_lists(v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
    """Return random parts of scenes with at least two classes."""
    classes = v.sum(1)
    share = _LEAST_SHARE + (1 - _LEAST_SHARE) * torch.rand(len(v))
    count = torch.where(torch.rand(len(v)) < _ONE_HIDDEN, classes - 1, (share * classes).round())
    count = count.clamp(min=1).minimum(classes - 1)
    # A random order of the classes, in which the absent ones come last.
    rank = torch.rand(v.shape).masked_fill(v == 0, 2.0).argsort(1).argsort(1)
    return v * (rank < count.unsqueeze(1))


def hidden_loss(
    network: nn.Module, v: Float[Tensor, "B V"], labelled: Bool[Tensor, "B V"], loss: str
) -> Float[Tensor, ""]:
    """Return the mean loss over B scenes, of which the network sees a random part.

    With the loss "binary", it is the cross-entropy summed over the unlisted labelled classes;
    otherwise the mean -log p of the hidden classes under a softmax over these classes.
    """
    listed = draw_lists(v)
    candidate, hidden = (listed == 0) & labelled, v - listed
    logits = network(listed)
    if loss == "binary":
        of_class = binary_cross_entropy_with_logits(logits, hidden, reduction="none")
        return (of_class * candidate).sum() / len(v)
    log_p = logits.masked_fill(~candidate, -torch.inf).log_softmax(1)
    return -(log_p.masked_fill(hidden == 0, 0.0).sum(1) / hidden.sum(1)).mean()


# Denoising autoencoder with two hidden layers and a softmax over classes.
#
# P. Vincent et al., "Extracting and composing robust features with denoising autoencoders",
# ICML 2008. `train_network` trains the network.

_RUNGS = ((TRIALS, 0.25), (4, 1.0))
_AUTOENCODER: Final[dict[str, Sequence[Any]]] = {
    "width": (300, 600),
    "dropout": (0.0, 0.15, 0.3, 0.5),
    "learning_rate": (1e-3, 3e-3, 6e-3),
    "weight_decay": (0.03, 0.1, 0.3),
}


def build_autoencoder(popularity: Float[Tensor, " V"], width: int, dropout: float) -> nn.Sequential:
    """Return an untrained autoencoder; the class frequencies initialise its output bias."""
    V = len(popularity)
    output = nn.Linear(width, V)
    with torch.no_grad():
        output.bias.copy_(popularity.log())
    return nn.Sequential(
        nn.Linear(V, width), nn.LayerNorm(width), nn.GELU(), nn.Dropout(dropout),
        nn.Linear(width, width), nn.LayerNorm(width), nn.GELU(), nn.Dropout(dropout),
        output,
    )  # fmt: skip


def autoencoder(train: SceneTensors, structure: Structure, seed: int) -> Proposals[ObjectScore]:
    """Yield the score of an autoencoder for `TRIALS` settings, losses and sets of scenes."""
    lists = dict(training_lists(train, structure))

    def fit(setting: dict[str, Any], share: float) -> Iterator[tuple[Parameters, ObjectScore]]:
        options = setting.copy()  # `train_network` gets the options that remain
        chosen = lists[options.pop("scenes")]
        sizes = {name: options.pop(name) for name in ("width", "dropout")}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = build_autoencoder(chosen.frequency(), **sizes)
        steps = round(share * _STEPS)
        for step, score in train_network(network, chosen, structure, seed, **options, steps=steps):
            yield {"steps": step}, score

    return halving(drawn_settings(scenes=tuple(lists), loss=LOSSES, **_AUTOENCODER), fit, _RUNGS)
