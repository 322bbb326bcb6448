"""Networks over sets of classes: an autoencoder and a transformer, trained in one way."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from training.baselines.fitting import Proposals
from training.baselines.objects import frequency
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore

# How both networks learn: a class is taken out of a set and found among all that are absent.
#
# One present class is drawn from each scene and removed, so is every other class with a chance that
# is itself drawn per scene (the noise), and the loss is the cross-entropy of the removed class
# under a softmax over the classes that are absent (a multinomial likelihood, as in D. Liang et al.,
# "Variational Autoencoders for Collaborative Filtering", WWW 2018). AdamW, one learning-rate cycle,
# and an exponential moving average of the weights. Every few epochs of the last stretch are offered
# as candidates, so that validation stops early.


_AVERAGING = 0.998
_WARM_UP = 0.1


@dataclass(frozen=True)
class Course:
    """How long and how hard to train.

    Attributes:
        epochs, batch_size: as they say.
        learning_rate: the peak of its cycle.
        weight_decay: AdamW's.
        noise: largest chance with which a class that stays is hidden all the same.
        offers: epochs at which the network is offered, as shares of all.
    """

    epochs: int
    learning_rate: float
    batch_size: int = 128
    weight_decay: float = 0.01
    noise: float = 0.3
    offers: tuple[float, ...] = (0.6, 0.8, 1.0)


@dataclass(frozen=True, eq=False)
class NetworkScore:
    """log p(i) under the softmax over absent, non-structure classes.

    Attributes:
        network: presence (B, V) -> (B, V).
        structure: (V,) bool.
    """

    network: nn.Module
    structure: Tensor

    @property
    def parameter_count(self) -> int:
        """Trained weights."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    @torch.no_grad()
    def __call__(self, v: Tensor) -> Tensor:
        """Scores (B, V) of presence (B, V); -inf for what is present or structure."""
        values: Tensor = self.network(v)
        return values.masked_fill((v > 0) | self.structure, -torch.inf).log_softmax(1)


def train_network(
    network: nn.Module, v: Tensor, structure: Tensor, course: Course, seed: int
) -> Iterator[tuple[int, NetworkScore]]:
    """Train and offer the averaged network at some epochs, as (epochs done, score).

    Args:
        network: presence (B, V) -> unnormalised log-probabilities (B, V).
        v: (N, V) presence; scenes without anything but structure are left out.

    Raises:
        ValueError: there is no scene left.
    """
    v = v[(v * ~structure).any(1)]
    if not len(v):
        raise ValueError("no scene has a class that could be taken out")
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=course.learning_rate, weight_decay=course.weight_decay
    )
    steps = math.ceil(len(v) / course.batch_size)
    cycle = OneCycleLR(
        optimiser, course.learning_rate, total_steps=steps * course.epochs + 1, pct_start=_WARM_UP
    )
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(_AVERAGING))
    offers = {max(1, round(share * course.epochs)) for share in course.offers}
    for epoch in range(1, course.epochs + 1):
        # Dropout draws from the global generator; nobody else's draws may change.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed * 1_000_003 + epoch)
            network.train()
            for index in torch.randperm(len(v)).chunk(steps):
                optimiser.zero_grad()
                removal_loss(network, v[index], structure, course.noise).backward()
                optimiser.step()
                cycle.step()
                average.update_parameters(network)
        if epoch in offers:
            yield epoch, NetworkScore(copy.deepcopy(average.module).eval(), structure)


def removal_loss(network: nn.Module, v: Tensor, structure: Tensor, noise: float) -> Tensor:
    """Mean cross-entropy of one removed class a scene; draws from the global generator."""
    target = torch.multinomial(v * ~structure, 1)
    left = v.scatter(1, target, 0.0)
    hidden = torch.rand(v.shape) < noise * torch.rand(len(v), 1)
    candidate = ((left == 0) & ~structure).scatter(1, target, True)
    values = network(left * ~hidden).masked_fill(~candidate, -torch.inf)
    return -values.log_softmax(1).gather(1, target).mean()


# Denoising autoencoder with two hidden layers and a softmax over classes.
#
# P. Vincent et al., "Extracting and composing robust features with denoising autoencoders",
# ICML 2008. Trained by `train_network`.


_HIDDEN = 600
_HIDDEN_DROPOUT = (0.15, 0.3)
_AUTOENCODER = Course(epochs=24, learning_rate=3e-3, weight_decay=0.1)
_HEAVY = replace(_AUTOENCODER, noise=1.0)


def build_autoencoder(v: Tensor, width: int, dropout: float, seed: int) -> nn.Sequential:
    """V -> width -> width -> V; it starts at the popularity of (N, V) training scenes."""
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
    """Dropout × epochs."""
    for dropout in _HIDDEN_DROPOUT:
        network = build_autoencoder(train.v, _HIDDEN, dropout, seed)
        for epoch, score in train_network(network, train.v, structure, course, seed):
            yield {"dropout": dropout, "epochs": epoch}, score


def autoencoder_for_parts(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[ObjectScore]:
    """The same trained with heavy masking: any share of the other classes is hidden as well."""
    return autoencoder(train, structure, seed, _HEAVY)


# Masked transformer: the classes of a scene are the tokens, one more token asks what is missing.
#
# A. Vaswani et al., "Attention is all you need", NeurIPS 2017, masked as in J. Devlin et al.,
# "BERT", NAACL 2019; a set has no positions. Trained by `train_network`.


_WIDTH, _HEADS, _LAYERS = 64, 4, 2
_DROPOUT = (0.0, 0.1)
_TRANSFORMER = Course(epochs=20, learning_rate=5e-3, weight_decay=0.05, noise=0.1)


class SetTransformer(nn.Module):
    """Presence (B, V) -> unnormalised log-probabilities (B, V) of what is missing.

    Args:
        popularity: (V,) share of scenes with each class, where it starts.
        width, heads, layers: of the encoder; the feed-forward part is twice as wide.
        dropout: the encoder's.
    """

    def __init__(
        self, popularity: Tensor, *, width: int, heads: int, layers: int, dropout: float
    ) -> None:
        super().__init__()
        V = len(popularity)
        self.classes = V
        # Class V is the question, class V + 1 padding.
        self.embedding = nn.Embedding(V + 2, width)
        layer = nn.TransformerEncoderLayer(
            width, heads, 2 * width, dropout, activation="gelu", batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(
            layer, layers, norm=nn.LayerNorm(width), enable_nested_tensor=False
        )
        self.bias = nn.Parameter(popularity.log())
        # Small, since the same vectors give the answer's logits.
        nn.init.normal_(self.embedding.weight, std=width**-0.5)

    def forward(self, v: Tensor) -> Tensor:
        """The answer of the asking token."""
        most = int((v > 0).sum(1).max())
        present, token = v.topk(most, dim=1)
        token = torch.where(present > 0, token, self.classes + 1)
        token = nn.functional.pad(token, (1, 0), value=self.classes)
        seen: Tensor = self.encoder(
            self.embedding(token), src_key_padding_mask=token == self.classes + 1
        )
        return seen[:, 0] @ self.embedding.weight[: self.classes].T + self.bias


def transformer(train: SceneTensors, structure: Tensor, seed: int) -> Proposals[ObjectScore]:
    """Dropout × epochs."""
    for dropout in _DROPOUT:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = SetTransformer(
                frequency(train.v), width=_WIDTH, heads=_HEADS, layers=_LAYERS, dropout=dropout
            )
        for epoch, score in train_network(network, train.v, structure, _TRANSFORMER, seed):
            yield {"dropout": dropout, "epochs": epoch}, score
