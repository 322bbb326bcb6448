"""Conditional likelihood of relations that data sources annotate as true or false.

    loss = - sum over scenes and annotated relations e of log p(r_e | v, E[h1 | v])
    logit of r_e = ℓ_e + δ[source, a]

Relations without an annotation have no term (`training.datasets.sources`). Data sources annotate
different relations. For example, people mention notable relations, and generated rooms list all
relations. Each source therefore has a trained logit correction δ, called offset, for each relation
a. The service leaves the offsets out.

Weights and offsets have normal priors, with the precisions `weight_prior` and `offset_prior`. The
relation weights of a class can depend on its word vector. With the matrix X of word vectors, the
weights are a trained linear map of X plus a small deviation of each class:

    S = X A_S + S',   O = X A_O + O',   s = (X B_s)' + s',   o = (X B_o)' + o'

A rare class then has weights similar to those of classes with similar word vectors.

A robot seldom sees a whole scene. In training, the hidden units h1 therefore depend on a random
subset of the objects. The size of the subset is drawn uniformly for each scene. Otherwise, the
relations of complete scenes of one source would fit well, but relations in other scenes would not.

For a machine with implication weights, the loss has a second term, see `relation_nll`. The object
weights of the machine stay fixed.

Sources: Besag, "Statistical analysis of non-lattice data" (1975); Mnih and Salakhutdinov,
"Probabilistic matrix factorization" (2007), for normal priors on factors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import (
    cached,
    is_parametrized,
    register_parametrization,
    remove_parametrizations,
)

from training.datasets.array_types import Floats, Ints
from training.datasets.batches import Batch, SceneTensors, TrainingData, relation_units
from training.fit.configuration import ObjectiveConfig
from training.fit.objectives.base import Objective, relation_nll, withhold_counts, withhold_rooms
from training.machines import BoltzmannMachine, build
from training.machines.bernoulli import uniform
from training.machines.distributed import size, total
from training.machines.mean_field import Evidence, mean_field

_OBJECT_PART = frozenset({"b", "c1", "c2", "W", "J", "Q", "gamma", "B", "usual", "d"})
# Factor of the prior precision for the map of word vectors. All classes share the map, so its prior
# is weaker than the prior of the weights of a class.
_MAP_PRIOR = 0.1
_ROWS = ("S", "O")
_COLUMNS = ("s", "o")
# Precision τ of the normal prior of a residual weight. A scene with p(r) = 1/2 has the Fisher
# information 1/4, so the prior has the weight of four such scenes.
_PRECISION = 1.0
# Minimum number of scenes with an annotation of a triple, and minimum size of a stored residual.
_SPEAKING_SCENES = 5
_LEAST_RESIDUAL = 0.1
_NEWTON_STEPS = 12
_BATCH = 64


class WordPrior(nn.Module):
    """Add a trained linear map of scaled word vectors, (classes, dimensions), to class weights.

    The weights have the shape (width, classes) with `columns`, and (classes, width) without.
    """

    def __init__(self, words: Tensor, width: int, *, columns: bool) -> None:
        super().__init__()
        self.register_buffer("words", words, persistent=False)
        self.words: Tensor
        self.columns = columns
        self.map = nn.Parameter(torch.zeros(words.shape[1], width))

    def forward(self, deviation: Tensor) -> Tensor:
        shared = self.words @ self.map
        return deviation + (shared.T if self.columns else shared)


class RelationLikelihood(Objective):
    """The negative conditional log-likelihood of annotated relations, plus priors.

    The constructor adds a word prior to the machine if there are word vectors of the classes with
    length 1, (classes, dimensions).
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
        return cls(config, machine, data.train, data.words)

    def finish(self, machine: BoltzmannMachine, train: SceneTensors) -> BoltzmannMachine:
        """Return the machine for storage, with word prior and residuals included in its weights."""
        bake_word_prior(machine)
        if machine.has_residuals and machine.get_parameter("residual").requires_grad:
            return with_counted_residuals(
                machine, train, self.offsets.detach().cpu(), self.source_weights.cpu()
            )
        return machine

    def parameters(self) -> list[nn.Parameter]:
        return [self.offsets]

    def state(self) -> dict[str, Tensor]:
        return {"offsets": self.offsets.detach()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self.offsets.copy_(state["offsets"])

    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the negative log-likelihood plus the negative log prior, divided by scenes.

        The likelihood is divided by the scenes of the batch, and the prior by all training scenes.
        """
        with cached():
            return self._loss(machine, batch, generator)

    def _loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        room = withhold_rooms(batch, self.config.room_dropout, generator)
        batch = withhold_counts(batch, self.config.count_dropout, generator)
        edges, r, observed = relation_units(machine, batch)
        with torch.no_grad():
            visible = hide_objects(batch.v, generator)
            h1 = mean_field(machine, Evidence(visible, room=room)).y.sigmoid()
        offsets = self.offsets[batch.source]
        weight = self.source_weights[batch.source].unsqueeze(1)
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets.gather(1, edges.relation.expand(len(batch), -1))
        weight = observed * machine.gate(edges, batch.v) * weight
        nll = relation_nll(machine, edges, logits, r, observed, weight, h1, generator)
        scenes = int(total(torch.tensor(len(batch))))
        return nll / scenes + self._prior(machine) / max(self.scenes, 1) / size()

    def _prior(self, machine: BoltzmannMachine) -> Tensor:
        """Return the negative log prior of weights and offsets, up to a constant."""
        total = 0.5 * self.config.offset_prior * (self.offsets**2).sum()
        half = 0.5 * self.config.weight_prior
        for name, parameter in machine.named_parameters():
            if name in _OBJECT_PART or not parameter.requires_grad:
                continue
            share = _MAP_PRIOR if name.endswith(".map") or name in ("R", "n") else 1.0
            total = total + share * half * (parameter**2).sum()
        return total


def hide_objects(v: Tensor, generator: torch.Generator) -> Tensor:
    """Hide objects of scenes (B, V) at random, each scene with its own uniform probability."""
    chance = uniform((len(v), 1), generator)
    return v * (uniform(v.shape, generator) < chance)


def add_word_prior(machine: BoltzmannMachine, words: Tensor) -> None:
    """Add a word prior to the class weights S, O, s and o that a machine has."""
    for names, columns in ((_ROWS, False), (_COLUMNS, True)):
        for name in names:
            weight = dict(machine.named_parameters()).get(name)
            if weight is not None:
                width = weight.shape[0] if columns else weight.shape[1]
                register_parametrization(machine, name, WordPrior(words, width, columns=columns))


def bake_word_prior(machine: BoltzmannMachine) -> None:
    """Replace each weight by the sum of word map and class deviation, for storage."""
    for name in (*_ROWS, *_COLUMNS):
        if is_parametrized(machine, name):
            remove_parametrizations(machine, name, leave_parametrized=True)


def with_counted_residuals(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> BoltzmannMachine:
    """Return the machine with fitted residual weights of single triples.

    All classes share the factors of a relation. For some pairs of classes, the factors give a high
    probability although the relation is false in many scenes (a window on a stove). After training,
    this function therefore fits a change δ_e of the residual weight w_e' of each triple e = (a,i,j)
    that enough scenes annotate. Newton's method maximises

        sum over scenes of log p(r_e | v, E[h1 | v], w_e' + δ_e) - τ/2 δ_e².

    All other weights are fixed. As in training, the hidden units depend on a random subset of the
    objects. With few scenes, δ_e stays close to 0.

    Args:
        offsets: corrections of the logits for each data source, (sources, relations).
        source_weights: weight of a relation from each data source, (sources,).
    """
    keys, logits, holds, weights = _annotated_units(machine, train, offsets, source_weights)
    triples, which, counts = np.unique(keys, return_inverse=True, return_counts=True)
    delta = np.zeros(len(triples))
    for _ in range(_NEWTON_STEPS):
        p = 1 / (1 + np.exp(-(logits + delta[which])))
        slope = np.bincount(which, weights * (holds - p), len(triples)) - _PRECISION * delta
        curvature = np.bincount(which, weights * p * (1 - p), len(triples)) + _PRECISION
        delta += (slope / curvature).clip(-2, 2)
    before = machine.get_parameter("residual").tolist()
    residuals = dict(zip(machine.triple_keys.tolist(), before, strict=True))
    kept = (counts >= _SPEAKING_SCENES) & (np.abs(delta) >= _LEAST_RESIDUAL)
    for key, value in zip(triples[kept].tolist(), delta[kept].tolist(), strict=True):
        residuals[key] = residuals.get(key, 0.0) + value
    return _with_residuals(machine, residuals)


@torch.no_grad()
def _annotated_units(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> tuple[Ints, Floats, Floats, Floats]:
    """Return keys, logits, values and weights of all annotated relations, each (relations,)."""
    columns: list[list[Tensor]] = [[], [], [], []]
    V = machine.spec.V
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(train)).split(_BATCH):
        batch = train.batch(index)
        edges, r, observed = relation_units(machine, batch)
        h1 = mean_field(machine, Evidence(hide_objects(batch.v, generator))).y.sigmoid()
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets[batch.source].gather(1, edges.relation)
        annotated = (observed * machine.gate(edges, batch.v)) > 0
        key = (edges.relation * V + edges.subject) * V + edges.object
        weight = source_weights[batch.source].unsqueeze(1).expand_as(logits)
        for column, values in zip(columns, (key, logits, r, weight), strict=True):
            column.append(values[annotated])
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
