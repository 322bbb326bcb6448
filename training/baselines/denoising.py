"""Denoising autoencoder with two hidden layers and a softmax over classes.

P. Vincent et al., "Extracting and composing robust features with denoising autoencoders",
ICML 2008. Trained as `masked_sets` says.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from training.baselines.fitting import Proposals
from training.baselines.masked_sets import Course, train_network
from training.baselines.popularity import frequency
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore

_WIDTH = 600
_DROPOUT = (0.15, 0.3)
_COURSE = Course(epochs=24, learning_rate=3e-3, weight_decay=0.1)
_HEAVY = replace(_COURSE, noise=1.0)


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


def propose(
    train: SceneTensors, structure: Tensor, seed: int, course: Course = _COURSE
) -> Proposals[ObjectScore]:
    """Dropout × epochs."""
    for dropout in _DROPOUT:
        network = build_autoencoder(train.v, _WIDTH, dropout, seed)
        for epoch, score in train_network(network, train.v, structure, course, seed):
            yield {"dropout": dropout, "epochs": epoch}, score


def propose_for_parts(train: SceneTensors, structure: Tensor, seed: int) -> Proposals[ObjectScore]:
    """The same trained with heavy masking: any share of the other classes is hidden as well."""
    return propose(train, structure, seed, _HEAVY)
