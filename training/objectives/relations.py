"""Conditional likelihood of relations that sources state as true or false.

    - sum over scenes and known units of log p(r_e | v, E[h1 | v]),   logit_e = ℓ_e + δ[source, a]

A unit is known if its source states whether the relation holds (`training.datasets.sources`). Other
units drop out. Sources differ in what they list: people mention notable relations, and a procedural
room lists all. Each source therefore has its own trained offset δ for each relation. The service
does not use the offsets.

Weights and offsets have normal priors, with the precisions `weight_prior` and `offset_prior`. With
word vectors X, the factors and end weights of a class are a trained map of its vector plus a small
deviation of the class:

    S = X A_S + S',   O = X A_O + O',   s = (X B_s)' + s',   o = (X B_o)' + o'

A rare class then behaves like classes with similar word vectors.

A robot seldom sees a whole scene. In training, the context h1 therefore depends on a random subset
of the objects; the share is drawn uniformly for each scene. Otherwise the context would learn
relations that hold in complete scenes of one source, and would not predict them in other scenes.

For a machine with implications, the loss has a second term: a random share of the relations of each
scene is given, and the term is the sum of - log p(r_e | r_given, v, E[h1 | v]) over the other
relations. The object part of the machine is not trained.

Sources: Besag, "Statistical analysis of non-lattice data" (1975); Mnih and Salakhutdinov,
"Probabilistic matrix factorization" (2007), for normal priors on factors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.parametrize import (
    cached,
    is_parametrized,
    register_parametrization,
    remove_parametrizations,
)

from training.batches import Batch, SceneTensors, relation_units
from training.config import ObjectiveConfig
from training.distributed import size, total
from training.machines import BoltzmannMachine, build
from training.machines.bernoulli import uniform
from training.machines.mean_field import Evidence, mean_field
from training.objectives.base import Objective, relation_nll, withhold_counts, withhold_rooms

if TYPE_CHECKING:
    from training.trainer import TrainingData

_OBJECT_PART = frozenset({"b", "c1", "c2", "W", "J", "Q", "gamma", "B", "usual", "d"})
# All classes share the map of word vectors, so its prior is weaker than that of one class.
_MAP_PRIOR = 0.1
_ROWS = ("S", "O")
_COLUMNS = ("s", "o")
# τ, the precision of the prior of a residual. It weighs as much as four scenes with p(r) = 1/2.
_PRECISION = 1.0
# Minimum number of scenes that observe a triple, and minimum size of a stored residual.
_SPEAKING_SCENES = 5
_LEAST_RESIDUAL = 0.1
_NEWTON_STEPS = 12
_BATCH = 64


class WordPrior(nn.Module):
    """Add a trained map of word vectors to the weights of classes.

    Args:
        words: (V, D) scaled word vectors.
        width: number of weights of a class.
        columns: True if the weights have shape (width, V), False for (V, width).
    """

    def __init__(self, words: Tensor, width: int, *, columns: bool) -> None:
        super().__init__()
        self.register_buffer("words", words, persistent=False)
        self.words: Tensor
        self.columns = columns
        self.map = nn.Parameter(torch.zeros(words.shape[1], width))

    def forward(self, deviation: Tensor) -> Tensor:
        """Return the weights of all classes."""
        shared = self.words @ self.map
        return deviation + (shared.T if self.columns else shared)


class RelationLikelihood(Objective):
    """Conditional likelihood of relations; see the module.

    Args:
        config: weights and priors.
        machine: the machine that gets the word prior.
        train: scenes that give the source names and the number of scenes.
        words: (V, D) unit vectors of the classes; None without a word prior.
    """

    keeps_last = True

    def __init__(
        self,
        config: ObjectiveConfig,
        machine: BoltzmannMachine,
        train: SceneTensors,
        words: Tensor | None = None,
    ) -> None:
        super().__init__(config, machine)
        self.scenes = sum(bool(scene.evidence.observed.any()) for scene in train.scenes)
        self.offsets = nn.Parameter(torch.zeros(len(train.source_names), machine.spec.A))
        weights = [config.source_weights.get(name, 1.0) for name in train.source_names]
        self.source_weights = torch.tensor(weights)
        if words is not None and config.word_weight:
            add_word_prior(machine, words.to(machine.b.device) * config.word_weight)

    @classmethod
    def of(cls, config: ObjectiveConfig, machine: BoltzmannMachine, data: TrainingData) -> Self:
        """Return the objective for the training scenes of a run."""
        return cls(config, machine, data.train, data.words)

    def finish(self, machine: BoltzmannMachine, train: SceneTensors) -> BoltzmannMachine:
        """Return the machine with the word prior in its weights, and with fitted residuals."""
        bake_word_prior(machine)
        if machine.has_residuals and machine.get_parameter("residual").requires_grad:
            return with_counted_residuals(
                machine, train, self.offsets.detach().cpu(), self.source_weights.cpu()
            )
        return machine

    def parameters(self) -> list[nn.Parameter]:
        """Return the offsets."""
        return [self.offsets]

    def state(self) -> dict[str, Tensor]:
        """Return the offsets."""
        return {"offsets": self.offsets.detach()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore the offsets."""
        with torch.no_grad():
            self.offsets.copy_(state["offsets"])

    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the mean over scenes of the negative log-likelihood, plus the prior's share."""
        with cached():
            return self._loss(machine, batch, generator)

    def _loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        room = withhold_rooms(batch, self.config.room_dropout, generator)
        batch = withhold_counts(batch, self.config.count_dropout, generator)
        edges, r, observed = relation_units(machine, batch)
        with torch.no_grad():
            shown = partly_shown(batch.v, generator)
            h1 = mean_field(machine, Evidence(shown, room=room)).y.sigmoid()
        offsets = self.offsets[batch.source]
        weight = self.source_weights[batch.source].unsqueeze(1)
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets.gather(1, edges.relation.expand(len(batch), -1))
        known = observed * machine.gate(edges, batch.v) * weight
        nll = relation_nll(machine, edges, logits, r, observed, known, h1, generator)
        scenes = int(total(torch.tensor(len(batch))))
        return nll / scenes + self._prior(machine) / max(self.scenes, 1) / size()

    def _prior(self, machine: BoltzmannMachine) -> Tensor:
        """Return -log p(weights), without a constant."""
        total = 0.5 * self.config.offset_prior * (self.offsets**2).sum()
        half = 0.5 * self.config.weight_prior
        for name, parameter in machine.named_parameters():
            if name in _OBJECT_PART or not parameter.requires_grad:
                continue
            share = _MAP_PRIOR if name.endswith(".map") or name in ("R", "n") else 1.0
            total = total + share * half * (parameter**2).sum()
        return total


def partly_shown(v: Tensor, generator: torch.Generator) -> Tensor:
    """Hide objects of scenes (B, V) at random, each scene with its own uniform probability."""
    chance = uniform((len(v), 1), generator)
    return v * (uniform(v.shape, generator) < chance)


def add_word_prior(machine: BoltzmannMachine, words: Tensor) -> None:
    """Add a word prior to the class weights of a factorised machine; ignore other machines."""
    for names, columns in ((_ROWS, False), (_COLUMNS, True)):
        for name in names:
            weight = dict(machine.named_parameters()).get(name)
            if weight is not None:
                width = weight.shape[0] if columns else weight.shape[1]
                register_parametrization(machine, name, WordPrior(words, width, columns=columns))


def bake_word_prior(machine: BoltzmannMachine) -> None:
    """Add the word prior to the weights, for storage."""
    for name in (*_ROWS, *_COLUMNS):
        if is_parametrized(machine, name):
            remove_parametrizations(machine, name, leave_parametrized=True)


def with_counted_residuals(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> BoltzmannMachine:
    """Return the machine with weights of single triples, smoothed towards counts.

    Shared factors describe a relation over all classes. For some pairs, the factors give a high
    probability although the relation is false in many scenes (a window on a stove). After training,
    this function therefore fits a weight δ_e for each triple e = (a,i,j) that enough scenes
    observe. δ_e maximises

        sum over scenes of log p(r_e | v, E[h1 | v], w_e' + δ_e) - τ/2 δ_e²

    by Newton's method. All other weights are fixed. As in training, the context depends on a random
    subset of the objects. With few scenes, δ_e stays close to 0.

    Args:
        train: scenes with known relations.
        offsets: (sources, A), added to the logits of each source's scenes.
        source_weights: (sources,) weight of a relation of each source.
    """
    keys, logits, holds, weights = _known_units(machine, train, offsets, source_weights)
    triples, which, counts = np.unique(keys, return_inverse=True, return_counts=True)
    delta = np.zeros(len(triples))
    for _ in range(_NEWTON_STEPS):
        p = 1 / (1 + np.exp(-(logits + delta[which])))
        slope = np.bincount(which, weights * (holds - p), len(triples)) - _PRECISION * delta
        curvature = np.bincount(which, weights * p * (1 - p), len(triples)) + _PRECISION
        delta += (slope / curvature).clip(-2, 2)
    before = machine.get_parameter("residual").tolist()
    old = dict(zip(machine.triple_keys.tolist(), before, strict=True))
    kept = (counts >= _SPEAKING_SCENES) & (np.abs(delta) >= _LEAST_RESIDUAL)
    for key, value in zip(triples[kept].tolist(), delta[kept].tolist(), strict=True):
        old[key] = old.get(key, 0.0) + value
    return _with_residuals(machine, old)


@torch.no_grad()
def _known_units(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return keys (U,), logits, values and weights of all known units."""
    columns: list[list[Tensor]] = [[], [], [], []]
    V = machine.spec.V
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(train)).split(_BATCH):
        batch = train.batch(index)
        edges, r, observed = relation_units(machine, batch)
        h1 = mean_field(machine, Evidence(partly_shown(batch.v, generator))).y.sigmoid()
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets[batch.source].gather(1, edges.relation)
        known = (observed * machine.gate(edges, batch.v)) > 0
        key = (edges.relation * V + edges.subject) * V + edges.object
        weight = source_weights[batch.source].unsqueeze(1).expand_as(logits)
        for column, values in zip(columns, (key, logits, r, weight), strict=True):
            column.append(values[known])
    key, logits, r, weight = (torch.cat(column) for column in columns)
    return key.numpy(), logits.double().numpy(), r.double().numpy(), weight.double().numpy()


def _with_residuals(machine: BoltzmannMachine, residuals: dict[int, float]) -> BoltzmannMachine:
    V = machine.spec.V
    keys = torch.tensor(sorted(residuals), dtype=torch.int64)
    triples = torch.stack([keys // V // V, keys // V % V, keys % V], 1).to(torch.int32)
    larger = build(replace(machine.spec, T=len(keys)))
    state = machine.state_dict()
    state["triples"] = triples
    state["residual"] = torch.tensor([residuals[key] for key in keys.tolist()])
    larger.load_state_dict(state)
    return larger
