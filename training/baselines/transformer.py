"""Masked transformer: the classes of a scene are the tokens, one more token asks what is missing.

A. Vaswani et al., "Attention is all you need", NeurIPS 2017, masked as in J. Devlin et al., "BERT",
NAACL 2019; a set has no positions. Trained as `masked_sets` says.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from training.baselines.fitting import Proposals
from training.baselines.masked_sets import Course, train_network
from training.baselines.popularity import frequency
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore

_WIDTH, _HEADS, _LAYERS = 64, 4, 2
_DROPOUT = (0.0, 0.1)
_COURSE = Course(epochs=20, learning_rate=5e-3, weight_decay=0.05, noise=0.1)


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


def propose(train: SceneTensors, structure: Tensor, seed: int) -> Proposals[ObjectScore]:
    """Dropout × epochs."""
    for dropout in _DROPOUT:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = SetTransformer(
                frequency(train.v), width=_WIDTH, heads=_HEADS, layers=_LAYERS, dropout=dropout
            )
        for epoch, score in train_network(network, train.v, structure, _COURSE, seed):
            yield {"dropout": dropout, "epochs": epoch}, score
