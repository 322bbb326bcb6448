"""The relation part by conditional likelihood: what sources say holds, or does not.

    - sum over scenes and known units of log p(r_e | v, E[h1 | v]),   logit_e = ℓ_e + δ[source, a]

A unit is known where it holds or is known not to (`training.datasets.sources`); all others drop
out. People mention what is worth mentioning, and a procedural room lists all there is: so each
source has an offset δ of its own for each relation. Offsets are learned and left out when serving.

Weights have a normal prior (`weight_prior`, its precision), offsets too (`offset_prior`). With word
vectors X, the factors and end weights of a class are a learned map of its vector plus a deviation
of its own, which the prior holds small,

    S = X A_S + S',   O = X A_O + O',   s = (X B_s)' + s',   o = (X B_o)' + o'

so that a rare class behaves like classes with similar word vectors.

A robot has seldom seen a whole scene, so the context sees a random share of the objects: of each
scene a uniform one. What holds of a pair in rich scenes of one source would else be left to the
context, and said of no other.

A machine with implications learns them from the same scenes with a random share of their relations
given, by log p(r_e | r_given, v, E[h1 | v]) of the others. The object part stays as it is.

Sources: Besag, "Statistical analysis of non-lattice data" (1975); Mnih and Salakhutdinov,
"Probabilistic matrix factorization" (2007), for normal priors on factors.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import (
    cached,
    is_parametrized,
    register_parametrization,
    remove_parametrizations,
)

from training.batches import Batch, SceneTensors, relation_units
from training.config import ObjectiveConfig
from training.machines import BoltzmannMachine
from training.machines.mean_field import Evidence, mean_field
from training.objectives.base import Objective, relation_nll, withhold_counts, withhold_rooms

_OBJECT_PART = frozenset({"b", "c1", "c2", "W", "J", "Q", "gamma", "B", "usual", "d"})
# The map of word vectors is shared by all classes, and needs less of a prior than one class does.
_MAP_PRIOR = 0.1
_ROWS = ("S", "O")
_COLUMNS = ("s", "o")


class WordPrior(nn.Module):
    """Adds a learned map of word vectors to the weights of classes.

    Args:
        words: (V, D) vectors, scaled.
        width: of the weights of a class.
        columns: the weights are (width, V), not (V, width).
    """

    def __init__(self, words: Tensor, width: int, *, columns: bool) -> None:
        super().__init__()
        self.words, self.columns = words, columns
        self.map = nn.Parameter(torch.zeros(words.shape[1], width))

    def forward(self, deviation: Tensor) -> Tensor:
        """The weights of all classes."""
        shared = self.words @ self.map
        return deviation + (shared.T if self.columns else shared)


class RelationLikelihood(Objective):
    """Conditional likelihood of relations; see the module.

    Args:
        config: weights and priors.
        machine: gets the word prior.
        train: says which sources there are, and how many scenes.
        words: (V, D) unit vectors of the classes; None without a word prior.
        structure: (V,) bool; relations of structure are unknown.
    """

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
            add_word_prior(machine, words * config.word_weight)

    def parameters(self) -> list[nn.Parameter]:
        """The offsets."""
        return [self.offsets]

    def state(self) -> dict[str, Tensor]:
        """The offsets."""
        return {"offsets": self.offsets.detach()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Put the offsets back."""
        with torch.no_grad():
            self.offsets.copy_(state["offsets"])

    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """Mean over scenes of the negative log-likelihood, and the priors' share of a scene."""
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
        return nll / len(batch) + self._prior(machine) / max(self.scenes, 1)

    def _prior(self, machine: BoltzmannMachine) -> Tensor:
        """-log p(weights), without a constant."""
        total = 0.5 * self.config.offset_prior * (self.offsets**2).sum()
        half = 0.5 * self.config.weight_prior
        for name, parameter in machine.named_parameters():
            if name in _OBJECT_PART or not parameter.requires_grad:
                continue
            share = _MAP_PRIOR if name.endswith(".map") or name in ("R", "n") else 1.0
            total = total + share * half * (parameter**2).sum()
        return total


def partly_shown(v: Tensor, generator: torch.Generator) -> Tensor:
    """Scenes (B, V) with each object kept at its scene's own chance, uniform in [0, 1]."""
    chance = torch.rand(len(v), 1, generator=generator)
    return v * (torch.rand(v.shape, generator=generator) < chance)


def add_word_prior(machine: BoltzmannMachine, words: Tensor) -> None:
    """Give the class weights of a factorised machine a word prior; others stay as they are."""
    for names, columns in ((_ROWS, False), (_COLUMNS, True)):
        for name in names:
            weight = dict(machine.named_parameters()).get(name)
            if weight is not None:
                width = weight.shape[0] if columns else weight.shape[1]
                register_parametrization(machine, name, WordPrior(words, width, columns=columns))


def bake_word_prior(machine: BoltzmannMachine) -> None:
    """Make what a word prior adds part of the weights, as the machine is stored."""
    for name in (*_ROWS, *_COLUMNS):
        if is_parametrized(machine, name):
            remove_parametrizations(machine, name, leave_parametrized=True)
