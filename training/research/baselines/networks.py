"""A neural network over sets of classes: a denoising autoencoder."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.optim.lr_scheduler import OneCycleLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from training.datasets.batches import SceneTensors
from training.evaluation.baselines.classes import Lists, training_lists
from training.evaluation.baselines.fitting import TRIALS, Proposals, drawn_settings, halving
from training.evaluation.model import ObjectScore, Parameters
from training.evaluation.setting import Structure

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
            torch.manual_seed(seed * 1_000_003 + step)
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
    listed = torch.where(torch.rand(len(v)) < _ONE_HIDDEN, classes - 1, (share * classes).round())
    listed = listed.clamp(min=1).minimum(classes - 1)
    rank = torch.rand(v.shape).masked_fill(v == 0, 2.0).argsort(1).argsort(1)
    return v * (rank < listed.unsqueeze(1))


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
        each = binary_cross_entropy_with_logits(logits, hidden, reduction="none")
        return (each * candidate).sum() / len(v)
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
        options = setting.copy()
        chosen = lists[options.pop("scenes")]
        sizes = {name: options.pop(name) for name in ("width", "dropout")}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = build_autoencoder(chosen.frequency(), **sizes)
        steps = round(share * _STEPS)
        for step, score in train_network(network, chosen, structure, seed, **options, steps=steps):
            yield {"steps": step}, score

    return halving(drawn_settings(scenes=tuple(lists), loss=LOSSES, **_AUTOENCODER), fit, _RUNGS)
