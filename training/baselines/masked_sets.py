"""How both networks learn: a class is taken out of a set and found among all that are absent.

One present class is drawn from each scene and removed, so is every other class with a chance that
is itself drawn per scene (the noise), and the loss is the cross-entropy of the removed class under
a softmax over the classes that are absent (a multinomial likelihood, as in D. Liang et al.,
"Variational Autoencoders for Collaborative Filtering", WWW 2018). AdamW, one learning-rate cycle,
and an exponential moving average of the weights. Every few epochs of the last stretch are offered
as candidates, so that validation stops early.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

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
