"""Composite conditional likelihood of masked objects, presence and relations.

In each scene, one present class i is removed with all its instances and relations. The loss then
has two terms for objects:

    ranking    - log softmax_i of the log-odds, over all absent classes including i
    presence   n·softplus(-log-odds_i) + sum over the other absent classes of softplus(log-odds)

n is the number of classes that can be removed. With the factor n, the presence term is an unbiased
estimate of the negative pseudo-likelihood. With the ranking term alone, log-odds from different
scenes would not be comparable.

Scenes with annotated relations have a third term:

    relations  - sum over observed relations e of log p(r_e | v, E[h1 | v])

By Jensen's inequality, log p(r | v) ≥ E[log p(r | v, h1)] for h1 from p(h1 | v). The relation term
approximates this bound by using the mean of h1. Unannotated relations are summed out. A machine
with implication weights has a second relation term, see `relation_nll`.

A class that a data source never mentions counts as absent in all scenes of that source. A request
to the service has no source, so the service must rank all classes.

Sources: Besag, "Statistical analysis of non-lattice data" (1975); Varin, Reid and Firth, "An
overview of composite likelihood methods" (2011).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import softplus

from training.datasets.batches import Batch, relation_units
from training.fit.configuration import ObjectiveConfig
from training.fit.objectives.base import Objective, relation_nll, withhold_counts, withhold_rooms
from training.machines import BoltzmannMachine
from training.machines.bernoulli import bernoulli, categorical, uniform
from training.machines.distributed import anywhere, gather, mean_part, share, total
from training.machines.gibbs import Clamp, bare_state, initial_state, run
from training.machines.log_odds import object_log_odds
from training.machines.mean_field import Evidence, mean_field


@dataclass(frozen=True)
class Masked:
    """Scenes from each of which one class is removed.

    Attributes:
        batch: the complete scenes.
        v: presence of objects without the removed class, (scenes, classes).
        target: index of the removed class, (scenes,).
        absent: True for absent classes and the removed class, (scenes, classes).
        removable: number of classes that can be removed, (scenes,).
    """

    batch: Batch
    v: Tensor
    target: Tensor
    absent: Tensor
    removable: Tensor


def mask_one_class(batch: Batch, structure: Tensor, generator: torch.Generator) -> Masked | None:
    """Remove one random class from each scene that has at least two removable classes.

    The result is None if the scenes of all processes have fewer. Structure classes such as walls,
    (classes,) bool, are never removed or ranked.
    """
    removable = batch.v * ~structure
    is_maskable = removable.sum(1) >= 2
    if not anywhere(is_maskable):
        return None
    batch, removable = batch.rows(is_maskable), removable[is_maskable]
    target = categorical(removable, generator)
    v = batch.v.scatter(1, target.unsqueeze(1), 0.0)
    absent = (v == 0) & ~structure
    return Masked(batch, v, target, absent, removable.sum(1))


class ObjectChains:
    """Persistent Gibbs chains over objects and hidden units, for machines of the local form.

    In the local form, the sum over relations is 1, so the chains contain only v, h1 and h2. The
    loss is a difference of free energies, in which h1 is summed out:

        mean F(data, h2) - mean F(chains, h2),   F = -b·v - c2·h2 - sum softplus(c1 + v'W + J h2)

    Each chain keeps the room type of a random training scene, which can be unknown. The chains and
    the data therefore have the same distribution of room types.

    Source: Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008).
    """

    def __init__(self, count: int, steps: int) -> None:
        self.count, self.steps = count, steps
        self.blocks: dict[str, Tensor] = {}

    def loss(
        self, machine: BoltzmannMachine, v: Tensor, room: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Run the chains, then return mean F(data) - mean F(chains). F is the free energy."""
        with torch.no_grad():
            h2 = bernoulli(mean_field(machine, Evidence(v, room=room)).h2, generator)
            if not self.blocks:
                self.blocks = self._start(machine, gather(v), gather(room), generator)
            clamp = Clamp(room=self.blocks["room"])
            state = bare_state(machine, *(self.blocks[name] for name in ("v", "h1", "h2")))
            state = run(machine, state, generator, self.steps, clamp, relations=False)
            self.blocks |= {"v": state.v, "h1": state.h1, "h2": state.h2}
        chains = self.blocks
        data = mean_part(machine.free_energy(v, h2=h2, room=room))
        model = machine.free_energy(chains["v"], h2=chains["h2"], room=chains["room"])
        return data - mean_part(model)

    def _start(
        self, machine: BoltzmannMachine, v: Tensor, room: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Start this process' chains at random scenes of the batch of all processes."""
        pick = share(torch.randint(len(v), (self.count,), generator=generator, device="cpu"))
        state = initial_state(machine, v[pick], generator, Clamp(room=room[pick]))
        return {"v": state.v, "h1": state.h1, "h2": state.h2, "room": room[pick]}


class CompositeLikelihood(Objective):
    """The loss ranking + presence_weight · presence + relation_weight · relations.

    With a `generative_weight` (local form), the loss also includes the term of `ObjectChains`.
    Without that term, samples of the trained machine differ from the training scenes.
    """

    def __init__(
        self, config: ObjectiveConfig, machine: BoltzmannMachine, structure: Tensor | None = None
    ) -> None:
        super().__init__(config, machine, structure)
        self.chains = ObjectChains(config.chains, config.k)

    def state(self) -> dict[str, Tensor]:
        return {name: gather(block) for name, block in self.chains.blocks.items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.chains.blocks = {name: share(block) for name, block in state.items()}

    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the weighted sum of the terms, averaged over the scenes of the batch."""
        total = machine.b.sum() * 0.0
        if self.config.relation_weight:
            relations = self.relation_part(machine, batch, generator)
            total = total + self.config.relation_weight * relations
        if self.config.generative_weight:
            room = withhold_rooms(batch, self.config.room_dropout, generator)
            chains = self.chains.loss(machine, batch.v, room, generator)
            total = total + self.config.generative_weight * chains
        masked = mask_one_class(batch, self.structure, generator)
        if masked is None:
            return total
        log_odds = self._log_odds(machine, masked, generator)
        target_log_odds = log_odds.gather(1, masked.target.unsqueeze(1)).squeeze(1)
        others = log_odds.masked_fill(~masked.absent, -torch.inf)
        ranking = others.logsumexp(1) - target_log_odds
        is_off = masked.absent.scatter(1, masked.target.unsqueeze(1), False)
        off = (softplus(log_odds) * is_off).sum(1)
        presence = masked.removable * softplus(-target_log_odds) + off
        return total + mean_part(ranking + self.config.presence_weight * presence)

    def _log_odds(
        self, machine: BoltzmannMachine, masked: Masked, generator: torch.Generator
    ) -> Tensor:
        """Return the log-odds of each class given the other classes, (scenes, classes)."""
        v, batch = masked.v, masked.batch
        if self.config.structure_dropout:
            drop = uniform(v.shape, generator) < self.config.structure_dropout
            v = v * ~(drop & self.structure)
        if self.config.object_dropout:
            v = v * (uniform(v.shape, generator) >= self.config.object_dropout)
        room = withhold_rooms(batch, self.config.room_dropout, generator)
        edges = None
        if machine.relations_act:
            classes = torch.where(v.gather(1, batch.classes.clamp(min=0)) > 0, batch.classes, -1)
            edges = machine.edges(classes, batch.counts)
        return object_log_odds(machine, Evidence(v, edges, room=room))

    def relation_part(
        self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator
    ) -> Tensor:
        """Return the relation term of the loss, averaged over the scenes of the batch."""
        annotated = batch.observed.flatten(1).any(1)
        if not anywhere(annotated):
            return machine.b.sum() * 0.0
        scenes = batch.rows(annotated)
        if self.config.unlisted == "off":
            scenes = unlisted_off(scenes, self.structure)
        room = withhold_rooms(scenes, self.config.room_dropout, generator)
        scenes = withhold_counts(scenes, self.config.count_dropout, generator)
        edges, r, observed = relation_units(machine, scenes)
        evidence = Evidence(scenes.v, machine.context_units(edges), room=room)
        h1 = mean_field(machine, evidence).y.sigmoid()
        logits = machine.relation_logits(edges, scenes.v, h1)
        counted = observed * machine.gate(edges, scenes.v)
        nll = relation_nll(machine, edges, logits, r, observed, counted, h1, generator)
        return nll / int(total(torch.tensor(len(batch))))


def unlisted_off(batch: Batch, structure: Tensor) -> Batch:
    """Return the batch with all unlisted relations of a scene false, except those of structure."""
    n = batch.classes.shape[1]
    thing = (batch.classes >= 0) & ~structure[batch.classes.clamp(min=0)]
    pairs = thing[:, :, None] & thing[:, None, :] & ~torch.eye(n, dtype=torch.bool)
    return replace(batch, observed=batch.observed | pairs[:, None])
