"""Neural networks over sets of classes: an autoencoder and a transformer with common training."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from training.datasets.batches import SceneTensors
from training.evaluation.baselines.classes import frequency
from training.evaluation.baselines.fitting import Proposals
from training.evaluation.model import ObjectScore

# Both networks learn to predict a removed class among all absent classes.
#
# One present class of each scene is removed as the target. Each other class is also hidden, with a
# probability (the noise) that is drawn for each scene. The loss is the cross-entropy of the target
# under a softmax over the absent classes. This is a multinomial likelihood as in D. Liang et al.,
# "Variational Autoencoders for Collaborative Filtering", WWW 2018. The optimiser is AdamW with one
# learning-rate cycle and an exponential moving average of the weights. Several late epochs are
# candidates, so that selection on validation scenes has the effect of early stopping.

_AVERAGING = 0.998
_WARM_UP = 0.1


@dataclass(frozen=True)
class Course:
    """Settings of the training of a network.

    Attributes:
        learning_rate: maximum learning rate of the cycle.
        noise: maximum probability with which a class other than the target is hidden.
        offers: epochs at which the network becomes a candidate, as shares of `epochs`.
    """

    epochs: int
    learning_rate: float
    batch_size: int = 128
    weight_decay: float = 0.01
    noise: float = 0.3
    offers: tuple[float, ...] = (0.6, 0.8, 1.0)


@dataclass(frozen=True, eq=False)
class NetworkScore:
    """The score log p(i) of each class i, from a softmax over absent non-structure classes.

    Attributes:
        network: network from presence, (scenes, classes), to logits of the same shape.
    """

    network: nn.Module
    structure: Tensor

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    @torch.no_grad()
    def __call__(self, v: Tensor) -> Tensor:
        """Return the score of each class, (scenes, classes).

        Present classes and structure classes have the score -inf.
        """
        values: Tensor = self.network(v)
        return values.masked_fill((v > 0) | self.structure, -torch.inf).log_softmax(1)


def train_network(
    network: nn.Module, v: Tensor, structure: Tensor, course: Course, seed: int
) -> Iterator[tuple[int, NetworkScore]]:
    """Train a network. At each candidate epoch, yield the epoch and the score of averaged weights.

    Args:
        v: presence in the training scenes, (scenes, classes). Scenes that contain only structure
            classes are left out.

    Raises:
        ValueError: every scene contains only structure classes.
    """
    v = v[(v * ~structure).any(1)]
    if not len(v):
        raise ValueError(
            "every training scene contains only structure classes; training needs scenes with "
            "other classes"
        )
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=course.learning_rate, weight_decay=course.weight_decay
    )
    steps = math.ceil(len(v) / course.batch_size)
    schedule = OneCycleLR(
        optimiser, course.learning_rate, total_steps=steps * course.epochs + 1, pct_start=_WARM_UP
    )
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(_AVERAGING))
    candidate_epochs = {max(1, round(share * course.epochs)) for share in course.offers}
    for epoch in range(1, course.epochs + 1):
        # Dropout uses the global random generator. The fork restores its state after the block.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed * 1_000_003 + epoch)
            network.train()
            for index in torch.randperm(len(v)).chunk(steps):
                optimiser.zero_grad()
                removal_loss(network, v[index], structure, course.noise).backward()
                optimiser.step()
                schedule.step()
                average.update_parameters(network)
        if epoch in candidate_epochs:
            yield epoch, NetworkScore(copy.deepcopy(average.module).eval(), structure)


def removal_loss(network: nn.Module, v: Tensor, structure: Tensor, noise: float) -> Tensor:
    """Return the cross-entropy of one randomly removed class a scene, averaged over scenes."""
    target = torch.multinomial(v * ~structure, 1)
    remaining = v.scatter(1, target, 0.0)
    hidden = torch.rand(v.shape) < noise * torch.rand(len(v), 1)
    candidate = ((remaining == 0) & ~structure).scatter(1, target, True)
    values = network(remaining * ~hidden).masked_fill(~candidate, -torch.inf)
    return -values.log_softmax(1).gather(1, target).mean()


# Denoising autoencoder with two hidden layers and a softmax over classes.
#
# P. Vincent et al., "Extracting and composing robust features with denoising autoencoders",
# ICML 2008. `train_network` trains the network.

_HIDDEN = 600
_HIDDEN_DROPOUT = (0.15, 0.3)
_AUTOENCODER = Course(epochs=24, learning_rate=3e-3, weight_decay=0.1)
HEAVILY_MASKED = replace(_AUTOENCODER, noise=1.0)
"""Training whose noise hides up to all classes except the target."""


def build_autoencoder(v: Tensor, width: int, dropout: float, seed: int) -> nn.Sequential:
    """Return an untrained autoencoder; class frequencies in `v` initialise its output bias."""
    V = v.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        output = nn.Linear(width, V)
        network = nn.Sequential(
            nn.Linear(V, width), nn.LayerNorm(width), nn.GELU(), nn.Dropout(dropout),
            nn.Linear(width, width), nn.LayerNorm(width), nn.GELU(), nn.Dropout(dropout),
            output,
        )  # fmt: skip
    with torch.no_grad():
        output.bias.copy_(frequency(v).log())
    return network


def autoencoder(
    train: SceneTensors, structure: Tensor, seed: int, course: Course = _AUTOENCODER
) -> Proposals[ObjectScore]:
    """Yield the score of an autoencoder for each dropout rate and number of epochs."""
    for dropout in _HIDDEN_DROPOUT:
        network = build_autoencoder(train.v, _HIDDEN, dropout, seed)
        for epoch, score in train_network(network, train.v, structure, course, seed):
            yield {"dropout": dropout, "epochs": epoch}, score


# Masked transformer. The classes of a scene are tokens, and one query token predicts the removed
# class.
#
# Sources: A. Vaswani et al., "Attention is all you need", NeurIPS 2017; J. Devlin et al., "BERT",
# NAACL 2019, for masking. The classes of a scene have no order, so the network has no position
# embeddings. `train_network` trains the network.

_WIDTH, _HEADS, _LAYERS = 64, 4, 2
_DROPOUT = (0.0, 0.1)
_TRANSFORMER = Course(epochs=20, learning_rate=5e-3, weight_decay=0.05, noise=0.1)


class SetTransformer(nn.Module):
    """A transformer that predicts the removed class of a scene.

    Args:
        popularity: share of scenes with each class, (classes,). The log of this share initialises
            the output bias.
        width: width of the encoder. Its feed-forward part is twice as wide.
    """

    def __init__(
        self, popularity: Tensor, *, width: int, heads: int, layers: int, dropout: float
    ) -> None:
        super().__init__()
        V = len(popularity)
        self.classes = V
        # Token V is the query token. Token V + 1 is padding.
        self.embedding = nn.Embedding(V + 2, width)
        layer = nn.TransformerEncoderLayer(
            width, heads, 2 * width, dropout, activation="gelu", batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(
            layer, layers, norm=nn.LayerNorm(width), enable_nested_tensor=False
        )
        self.bias = nn.Parameter(popularity.log())
        # The initial values are small, because the embeddings are also weights of the output.
        nn.init.normal_(self.embedding.weight, std=width**-0.5)

    def forward(self, v: Tensor) -> Tensor:
        """Return the logits of the removed class, (scenes, classes), from the query token."""
        most = int((v > 0).sum(1).max())
        present, token = v.topk(most, dim=1)
        token = torch.where(present > 0, token, self.classes + 1)
        token = nn.functional.pad(token, (1, 0), value=self.classes)
        encoded: Tensor = self.encoder(
            self.embedding(token), src_key_padding_mask=token == self.classes + 1
        )
        return encoded[:, 0] @ self.embedding.weight[: self.classes].T + self.bias


def transformer(train: SceneTensors, structure: Tensor, seed: int) -> Proposals[ObjectScore]:
    """Yield the score of a transformer for each dropout rate and number of epochs."""
    for dropout in _DROPOUT:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = SetTransformer(
                frequency(train.v), width=_WIDTH, heads=_HEADS, layers=_LAYERS, dropout=dropout
            )
        for epoch, score in train_network(network, train.v, structure, _TRANSFORMER, seed):
            yield {"dropout": dropout, "epochs": epoch}, score
