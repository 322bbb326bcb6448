"""Conditional likelihood of relations that data sources annotate as true or false.

    loss = - sum over scenes and annotated relations e of log p(r_e | v, E[h1 | v])
    logit of r_e = ℓ_e + δ[source, a]

Data sources annotate different relations: people mention notable ones, and generated rooms list
all. So each source has a trained logit correction δ, called offset, for each relation a. The
service leaves the offsets out. An epoch draws each scene with the weight of its source as
probability; a weight above 1 multiplies the terms of its scenes.

Weights and offsets have normal priors. With the matrix X of word vectors, the weights are a trained
map of X plus a small deviation of each class, so a rare class resembles those of similar words:

    S = X A_S + S',   O = X A_O + O',   s = (X B_s)' + s',   o = (X B_o)' + o'

A robot seldom sees a whole scene, so the hidden units depend on a random subset of the objects.
Otherwise, complete scenes of one source would fit well, but relations in other scenes would not.

For a machine with implication weights, a second term conditions on a random share of the observed
relations, and sums over the others. The object weights stay fixed.

Residual weights of single relation triples are fitted after the shared weights.

Sources: Besag, "Statistical analysis of non-lattice data" (1975); Mnih and Salakhutdinov,
"Probabilistic matrix factorization" (2007), for normal priors on factors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import expit
from torch import Tensor, nn
from torch.nn.functional import softplus
from torch.nn.utils.parametrize import (
    cached,
    is_parametrized,
    register_parametrization,
    remove_parametrizations,
)

from app.scene.spatial_relations import STACKED
from training.datasets.batches import Batch, SceneTensors, subset
from training.datasets.encoding import ClassEvidence
from training.fit.configuration import RelationsConfig
from training.machines import BoltzmannMachine, build
from training.machines.edges import triple_keys
from training.machines.machine import OBJECT_WEIGHTS

_WITHOUT_PRIOR = frozenset({*OBJECT_WEIGHTS, "gamma", "B", "usual", "d"})
# Factor of the prior precision for the map of word vectors, which all classes share.
_MAP_PRIOR = 0.1
# Most classes of a scene whose relations one batch has; the time grows with their third power.
_MOST_CLASSES = 20
# Random change of the log of the number of classes by which scenes are sorted into batches.
_MIXING = 0.5
SHARED = ("S", "O", "s", "o")  # weights that classes share


class RelationFit:
    """The fit of the relation weights of a machine: epochs over the scenes with annotations."""

    def __init__(
        self, machine: BoltzmannMachine, train: SceneTensors, config: RelationsConfig, seed: int
    ) -> None:
        """Select the scenes with annotated relations, and prepare offsets and optimiser."""
        self.config, self.machine = config, machine
        annotated = [k for k, scene in enumerate(train.scenes) if scene.evidence.observed.any()]
        self.train = subset(train, torch.tensor(annotated, dtype=torch.int64))
        sizes = [len(scene.evidence.classes) for scene in self.train.scenes]
        self._log_sizes = torch.tensor(sizes).clamp(1, _MOST_CLASSES).log()
        self.epochs = self._updates = 0  # numbers of finished epochs and updates
        self._generator = torch.Generator().manual_seed(seed)
        # Corrections of the logits for each data source.
        self.offsets = nn.Parameter(torch.zeros(len(train.source_names), machine.spec.A))
        self._source_weights = torch.tensor(
            [config.source_weights.get(name, 1.0) for name in train.source_names]
        )
        # Probability that an epoch draws each scene. Weights above 1 multiply the loss instead.
        self._shares = self._source_weights.clamp(max=1)[self.train.source]
        self._size = float(self._shares.sum())  # expected scenes of an epoch
        named = machine.named_parameters()
        self._weights = {name: weight for name, weight in named if weight.requires_grad}
        self._weights["offsets"] = self.offsets
        self._average = {name: w.detach().clone() for name, w in self._weights.items()}
        self._optimiser = torch.optim.Adam(
            self._weights.values(), lr=config.learning_rate, fused=True
        )

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return -log likelihood / scenes of the batch - log prior / scenes of an epoch."""
        machine = self.machine
        if self.config.count_dropout:  # the service often gets no instance counts
            hidden = torch.rand(len(batch), 1, generator=generator) < self.config.count_dropout
            batch = replace(batch, counts=batch.counts.masked_fill(hidden, 0))
        edges, r, observed = machine.lay_out(batch)
        h1 = means_of_parts(machine, batch, generator)
        offsets = self.offsets[batch.source]
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets.gather(1, edges.relation.expand(len(batch), -1))
        weight = self._source_weights[batch.source].clamp(min=1).unsqueeze(1)
        weight = observed * machine.gate(edges, batch.v) * weight
        nll = _nll(logits, r, weight)
        if machine.spec.G:  # a random share of the true relations is the condition
            share = torch.rand(len(r), 1, generator=generator)
            condition = r * observed * (torch.rand(r.shape, generator=generator) < share)
            shifted = logits + machine.implied(edges, condition, h1)
            nll = nll + _nll(shifted, r, weight * (1 - condition))
        return nll / len(batch) + self._prior() / max(self._size, 1)

    def _prior(self) -> Tensor:
        """Return the negative log prior of weights and offsets, up to a constant."""
        total = 0.5 * self.config.offset_prior * (self.offsets**2).sum()
        half = 0.5 * self.config.weight_prior
        for name, parameter in self.machine.named_parameters():
            if name in _WITHOUT_PRIOR or not parameter.requires_grad:
                continue
            share = _MAP_PRIOR if name.endswith(".map") or name in ("R", "n") else 1.0
            total = total + share * half * (parameter**2).sum()
        return total

    @property
    def finished(self) -> bool:
        """True after the last epoch, and if no scene has an annotated relation."""
        return self.epochs >= self.config.epochs or not len(self.train)

    def epoch(self, progress: Callable[[float, float], None]) -> float:
        """Run an epoch and return its mean loss. Raise FloatingPointError if it is not finite."""
        batches = self._batches()
        total = 0.0
        for number, index in enumerate(batches, 1):
            total += self._update(index, self.config.epochs * len(batches))
            done = (self.epochs + number / len(batches)) / self.config.epochs
            progress(done, total / number)
        if not math.isfinite(total):
            raise FloatingPointError(
                "the relation weights diverged in training: lower relations.learning_rate"
            )
        self.epochs += 1
        return total / len(batches)

    def _batches(self) -> list[Tensor]:
        """Return an epoch in random batches of similar scenes: large ones make a batch slow."""
        noise, draw = torch.rand(2, len(self.train), generator=self._generator)
        by_size = (self._log_sizes + _MIXING * noise).argsort()
        drawn = by_size[draw[by_size] < self._shares[by_size]]
        batches = drawn.split(self.config.batch_size)
        order = torch.randperm(len(batches), generator=self._generator).tolist()
        return [batches[k] for k in order]

    def _part(self, evidence: ClassEvidence) -> ClassEvidence:
        """Return the evidence about at most `_MOST_CLASSES` random classes of a scene."""
        count = len(evidence.classes)
        if count <= _MOST_CLASSES:
            return evidence
        order = torch.randperm(count, generator=self._generator)
        return evidence.only(order[:_MOST_CLASSES].sort().values.numpy())

    def _update(self, index: Tensor, total: int) -> float:
        """Update the weights by one batch of `total` updates in all, and return its loss."""
        with cached():
            loss = self.loss(self.train.batch(index, part=self._part), self._generator)
        for group in self._optimiser.param_groups:
            group["lr"] = self.config.learning_rate * self._schedule(total)
        self._optimiser.zero_grad()
        loss.backward()
        self._optimiser.step()
        self._updates += 1
        # During the first updates, a smaller decay reduces the share of the initial weights.
        decay = min(self.config.averaging, self._updates / (self._updates + 10))
        with torch.no_grad():
            for name, weight in self._weights.items():
                self._average[name].lerp_(weight, 1 - decay)
        return float(loss.detach())

    def _schedule(self, total: int) -> float:
        """Return the factor of the learning rate: one cycle that rises and falls to 0."""
        rise = max(1, total // 10)
        if self._updates < rise:
            return (self._updates + 1) / rise
        return 0.5 * (1 + math.cos(math.pi * (self._updates - rise) / max(total - rise, 1)))

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Give the machine the average weights for the duration of the context."""
        current = {name: w.detach().clone() for name, w in self._weights.items()}
        self._set(self._average)
        try:
            yield
        finally:
            self._set(current)

    @torch.no_grad()
    def _set(self, values: dict[str, Tensor]) -> None:
        for name, weight in self._weights.items():
            weight.copy_(values[name])

    def finish(self, parents: Int[Tensor, "V"]) -> BoltzmannMachine:
        """Return the machine for storage, with averaged weights and counted residuals."""
        self._set(self._average)
        machine = self.machine
        bake_shared_weights(machine, SHARED)
        if len(self.train) and "residual" in self._weights:
            lower_unseen_roles(machine, self.train, parents)
            offsets = self.offsets.detach()
            return with_counted_residuals(machine, self.train, offsets, self._source_weights)
        return machine


def _nll(
    logits: Float[Tensor, "B E"], r: Float[Tensor, "B E"], weight: Float[Tensor, "B E"]
) -> Float[Tensor, ""]:
    """Return the sum of -weight log p(r) over all relation units."""
    return ((softplus(logits) - r * logits) * weight).sum()


class Sharing(nn.Module):
    """Add the parent's deviation and a trained map of word vectors to the weights of each class."""

    def __init__(
        self,
        words: Float[Tensor, "V D"],  # 0 where unknown
        parents: Int[Tensor, "V"],  # -1 without a parent
        width: int,  # weights of a class
        *,
        columns: bool,  # the weights have the shape (width, V), else (V, width)
    ) -> None:
        """Start with a map of 0, so that the weights are those of the classes and parents."""
        super().__init__()
        self.words, self.parents, self.columns = words, parents, columns
        self.map = nn.Parameter(torch.zeros(words.shape[1], width))

    def forward(self, deviation: Tensor) -> Tensor:
        """Return the weights of all classes from the trained deviation of each class."""
        own = deviation.T if self.columns else deviation
        inherited = own[self.parents.clamp(min=0)] * (self.parents >= 0).unsqueeze(1)
        total = own + inherited + self.words @ self.map
        return total.T if self.columns else total


def share_weights(
    machine: BoltzmannMachine,
    words: Float[Tensor, "V D"],
    parents: Int[Tensor, "V"],
    names: Iterable[str],
) -> None:
    """Let classes share the named weights (`Sharing`). Weights that a machine lacks are skipped."""
    parameters = dict(machine.named_parameters())
    for name in names:
        if name in parameters:
            columns = name in ("s", "o")
            width = parameters[name].shape[0 if columns else 1]
            sharing = Sharing(words, parents, width, columns=columns)
            register_parametrization(machine, name, sharing)


def bake_shared_weights(machine: BoltzmannMachine, names: Iterable[str]) -> None:
    """Replace each of the shared weights by the sum of its parts, for storage."""
    for name in names:
        if is_parametrized(machine, name):
            remove_parametrizations(machine, name, leave_parametrized=True)


# Precision τ of the normal prior of a residual weight: that of four scenes with p(r) = 1/2.
_PRECISION = 1.0
# Minimum number of scenes with an annotation of a triple, and minimum size of a stored residual.
_SPEAKING_SCENES = 2
_LEAST_RESIDUAL = 0.1
_NEWTON_STEPS = 12
_BATCH = 64
# Change of the log-odds of a relation in which training shows a class in no scene, and the minimum
# number of scenes that annotate such relations of the class. Fewer scenes show nothing.
_UNSEEN_ROLE = -6.0
_CHANCES = 10


@torch.no_grad()
def means_of_parts(
    machine: BoltzmannMachine, batch: Batch, generator: torch.Generator
) -> Float[Tensor, "B H1"]:
    """Return the means of h1 given random parts of scenes, half of them with the room type."""
    probability = torch.rand(len(batch), 1, generator=generator)
    listed = batch.v * (torch.rand(batch.v.shape, generator=generator) < probability)
    lists_room = torch.rand(len(batch), generator=generator) < 0.5
    x = machine.hidden_logits(listed, torch.where(lists_room, batch.room, -1))
    return machine.state_means(x)


@torch.no_grad()
def lower_unseen_roles(
    machine: BoltzmannMachine, train: SceneTensors, parents: Int[Tensor, "V"]
) -> None:
    """Lower the weights of classes that no training scene shows on, in or above an object.

    The subject and the object of a relation are two roles, with the weights s and o. A class with
    fewer than `_CHANCES` annotated scenes keeps its weights.
    """
    # Factors extrapolate: they put windows on tables. Roles of the parent and of kinds count.
    seen = np.zeros((2, machine.spec.A, machine.spec.V), dtype=np.bool_)
    chances = np.zeros(seen.shape, dtype=np.int64)
    for scene in train.scenes:
        relation, subject, object_ = scene.evidence.holds.nonzero()
        classes = scene.evidence.classes
        seen[0, relation, classes[subject]] = seen[1, relation, classes[object_]] = True
        for role, partner_axis in ((0, 2), (1, 1)):
            chances[role][:, classes] += scene.evidence.observed.any(partner_axis)
    parent_of, seen_itself = parents.numpy(), seen.copy()
    for kind in np.flatnonzero(parent_of >= 0).tolist():
        seen[..., parent_of[kind]] |= seen_itself[..., kind]
        seen[..., kind] |= seen_itself[..., parent_of[kind]]
    unseen = torch.from_numpy(~seen & (chances >= _CHANCES))
    for a in STACKED:
        if a < machine.spec.A:
            machine.get_parameter("s")[a, unseen[0, a]] += _UNSEEN_ROLE
            machine.get_parameter("o")[a, unseen[1, a]] += _UNSEEN_ROLE


@torch.no_grad()
def with_counted_residuals(
    machine: BoltzmannMachine,
    train: SceneTensors,
    offsets: Float[Tensor, "sources A"],
    source_weights: Float[Tensor, "sources"],
) -> BoltzmannMachine:
    """Return the machine with fitted residual weights of single triples.

    Shared factors can give a false relation a high probability (a window on a stove). Newton's
    method fits a change δ_e of the residual weight w_e' of each triple e = (a,i,j) with enough
    annotations. All other weights are fixed. It maximises

        sum over scenes of log p(r_e | v, E[h1 | v], w_e' + δ_e) - τ/2 δ_e².

    As in training, the hidden units depend on a random subset of the objects, and each data source
    corrects the logits by its offsets.
    """
    V, columns = machine.spec.V, []
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(train)).split(_BATCH):
        batch = train.batch(index)
        edges, r, observed = machine.lay_out(batch)
        h1 = means_of_parts(machine, batch, generator)
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets[batch.source].gather(1, edges.relation)
        annotated = (observed * machine.gate(edges, batch.v)) > 0
        key = triple_keys(edges.relation, edges.subject, edges.object, V)
        weight = source_weights[batch.source].unsqueeze(1).expand_as(logits)
        columns.append([values[annotated] for values in (key, logits, r, weight)])
    keys, logits, r, weight = (torch.cat(blocks) for blocks in zip(*columns, strict=True))
    log_odds, holds, weights = (values.double().numpy() for values in (logits, r, weight))
    # All annotations of a triple are one logistic regression of the single weight δ.
    triples, triple_of, counts = np.unique(keys.numpy(), return_inverse=True, return_counts=True)
    delta = np.zeros(len(triples))
    for _ in range(_NEWTON_STEPS):
        p = expit(log_odds + delta[triple_of])
        slope = np.bincount(triple_of, weights * (holds - p), len(triples)) - _PRECISION * delta
        curvature = np.bincount(triple_of, weights * p * (1 - p), len(triples)) + _PRECISION
        delta += (slope / curvature).clip(-2, 2)  # a bound, so that Newton's method converges
    residuals = dict(
        zip(machine.triple_keys.tolist(), machine.get_parameter("residual").tolist(), strict=True)
    )
    is_stored = (counts >= _SPEAKING_SCENES) & (np.abs(delta) >= _LEAST_RESIDUAL)
    for key, value in zip(triples[is_stored].tolist(), delta[is_stored].tolist(), strict=True):
        residuals[key] = residuals.get(key, 0.0) + value
    keys = torch.tensor(sorted(residuals), dtype=torch.int64)  # (a V + i) V + j
    state = machine.state_dict()
    state["triples"] = torch.stack([keys // V // V, keys // V % V, keys % V], 1).int()
    state["residual"] = torch.tensor([residuals[key] for key in keys.tolist()])
    larger = build(replace(machine.spec, T=len(keys)))
    larger.load_state_dict(state)
    return larger
