"""The posterior of any scene under any machine, from weighted draws of the hidden units."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.questions.posterior import Present, pull_of, with_unlisted
from app.registry.artifact import Artifact
from app.scene.scene import Scene
from training.fit.oracle.evidence import DRAWS, draw_context, observe
from training.fit.oracle.units import NO_UNIT, Units, mean_log_p, units_between
from training.machines.arrays import machine_of
from training.machines.draws import HiddenDraws
from training.machines.log_odds import object_log_odds, presence_log_odds, weights_with

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.int64]

# Maximum number of values (relation units × draws) in a block of rows or candidates.
_BLOCK = 1 << 22


class _Between(NamedTuple):
    """The relation units between the classes of a scene.

    Attributes:
        logits: logit of each relation unit, (draws, units).
        said: change of the log-weights of the draws that removes the observation of a unit, (draws,
            units). It is 0 without observed relations.
        holds: 1 where a relation is observed as true, else 0, (1, units). None means that no
            relation is observed.
    """

    units: Units
    logits: Tensor
    said: Tensor
    holds: Tensor | None


class DrawnPosterior:
    """An implementation of `app.questions.posterior.Posterior` by weighted draws of h1.

    The energy has two forms, seed and local (`training.machines.machine`). In the local form
    without observed relations, the log-odds of objects have a closed form.
    """

    def __init__(self, artifact: Artifact, scene: Scene) -> None:
        self.observation = observe(machine_of(artifact.weights), scene)
        self.present: Present = self.observation.scene
        self._artifact, self._room = artifact, scene.room_type
        self._pull = pull_of(scene, artifact.calibration.evidence)

    @property
    def unit_count(self) -> int:
        """Number of relation units in the evidence. The seed form has units between all classes."""
        return self.observation.unit_count

    @cached_property
    def draws(self) -> HiddenDraws:
        """Draws of h1 given the evidence, for questions about relations."""
        observation, pull = self.observation, self._pull.relations
        return draw_context(observation.machine, observation.evidence, pull=pull)

    @cached_property
    def object_draws(self) -> HiddenDraws:
        """Draws of h1 given the evidence, for questions about objects."""
        observation, pull = self.observation, self._pull
        if pull.objects == pull.relations or observation.evidence.edges is None:
            return self.draws
        return draw_context(observation.machine, observation.evidence, pull=pull.objects)

    @torch.inference_mode()
    def absent_log_odds(self, absent: Places) -> Floats:
        """Implement `Posterior.absent_log_odds`, by a closed form where one exists."""
        machine, evidence = self.observation.machine, self.observation.evidence
        where = torch.from_numpy(np.asarray(absent, dtype=np.int64))
        if not machine.relations_act and evidence.edges is None:
            y = self.object_draws.field.y[0].numpy()
            gain = self._artifact.scorer.gain(y)
            return _numpy(machine.b[where] + torch.from_numpy(gain)[where])
        draws = self.object_draws
        return _numpy(presence_log_odds(machine, evidence, where.unsqueeze(0), draws)[0])

    @torch.inference_mode()
    def absent_posterior(self, absent: Places, coverage: float) -> Floats:
        """Implement `Posterior.absent_posterior`. A second hidden layer stays at its mean field."""
        log_odds, y = self.absent_log_odds(absent), self.object_draws.field.y[0].numpy()
        closed = None
        if self._artifact.completions is not None:
            closed = (self._artifact.weights["b"] + self._artifact.scorer.gain(y))[absent]
        return with_unlisted(
            *(self._artifact, log_odds, absent, y, self.present, self._room, coverage), closed
        )

    @torch.inference_mode()
    def relation_log_odds(self) -> Floats:
        """Return the log-odds of every relation e between the classes of the scene.

            p(r_e = 1 | rest) = E[ sigmoid(ℓ_e(h1) + x_e) ],   h1 from p(h1 | rest)

        "rest" means all other observed units. x_e is the change of the logit due to the observed
        relations. The draws of h1 are conditioned on all observed units. If r_e is observed, the
        weights w ← w / p(r_e | v, h1) remove r_e from the condition. A relation without a unit has
        the log-odds `NO_UNIT`.
        """
        between = self._between
        weight = torch.softmax(self.draws.log_weight + between.said, dim=0)
        on, off = mean_log_p(weight, between.logits + self._implied(apart=False))
        return _numpy(between.units.grid((on - off).clamp(min=NO_UNIT), NO_UNIT))

    @torch.inference_mode()
    def log_odds_apart(self, one: Places, other: Places) -> tuple[Floats, Floats]:
        """Implement `Posterior.log_odds_apart`.

        New weights of the draws remove all relations of the pair, in both directions.
        """
        units, said = self._between.units, self._between.said
        logits = self._between.logits + self._implied(apart=True)
        ends = torch.from_numpy(one), torch.from_numpy(other)
        ways = units.of_pairs(*ends), units.of_pairs(*ends[::-1])
        log_weight = self.draws.log_weight
        if said.dim():
            forward, backward = (way.grid(said, 0.0).sum(1) for way in ways)
            # If both classes of a pair are equal, both directions use the same relation units.
            log_weight = log_weight + forward + backward * (ends[0] != ends[1])
        weight = torch.softmax(log_weight, dim=0).unsqueeze(1)
        found = []
        for way in ways:
            on, off = mean_log_p(weight, way.grid(logits, NO_UNIT))
            log_odds = (on - off).clamp(min=NO_UNIT)
            found.append(_numpy(torch.where(way.exists, log_odds, NO_UNIT)))
        return found[0], found[1]

    @cached_property
    def _between(self) -> _Between:
        observation = self.observation
        machine, evidence = observation.machine, observation.evidence
        classes, counts = observation.classes, observation.counts
        units = units_between(machine, classes, classes, counts, counts)
        logits = machine.relation_logits(units.edges, evidence.v, self.draws.h1).squeeze(1)
        if not bool(observation.observed.any()):
            return _Between(units, logits, logits.new_zeros(()), None)
        observed = units.flat(observation.observed)
        r = units.flat(observation.holds).to(logits.dtype)
        gate = machine.gate(units.edges, evidence.v)
        unseen = machine.relation_term(logits, gate, r, torch.zeros_like(observed))
        # For an unobserved unit, the difference is zero, so the weights of the draws stay the same.
        said = self._pull.relations * (unseen - machine.relation_term(logits, gate, r, observed))
        return _Between(units, logits, said, (r * observed).unsqueeze(0))

    def _implied(self, *, apart: bool) -> Tensor:
        """Return the change of each relation logit due to the observed relations, (units,)."""
        between = self._between
        if between.holds is None:
            return between.logits.new_zeros(())
        machine, edges = self.observation.machine, between.units.edges
        return self.draws.implied(machine, edges, between.holds, apart=apart).squeeze(0)

    def unit_log_odds(self, relation: Places, subject: Places, object_: Places) -> Floats:
        """Implement `Posterior.unit_log_odds`, by selection from the log-odds of all relations."""
        return self.relation_log_odds()[relation, subject, object_]

    @torch.inference_mode()
    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Implement `Posterior.placement_log_odds`.

        The draws have weights as if the candidate object were present.
        """
        size = 2 * self.observation.machine.spec.A * max(1, len(anchors)) * len(self.draws.h1)
        places = torch.from_numpy(np.asarray(anchors, dtype=np.int64))
        found: tuple[list[Tensor], list[Tensor]] = ([], [])
        for part in torch.from_numpy(np.asarray(candidates, dtype=np.int64)).split(_rows(size)):
            for outgoing, parts in zip((True, False), found, strict=True):
                on, off = self._log_p(part, places, outgoing=outgoing)
                parts.append((on - off).clamp(min=NO_UNIT).transpose(0, 1))
        forward, backward = (_numpy(torch.cat(parts)) for parts in found)
        return forward, backward

    @torch.inference_mode()
    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """Implement `Posterior.placed_log_p`.

        The draws have weights as if the candidate object were present.
        """
        where = torch.from_numpy(np.asarray(candidates, dtype=np.int64))
        on, _ = self._log_p(where, torch.tensor([anchor]), outgoing=outgoing)
        return _numpy(on[relation, :, 0].clamp(min=NO_UNIT))

    def _log_p(
        self, candidates: Tensor, anchors: Tensor, *, outgoing: bool
    ) -> tuple[Tensor, Tensor]:
        """Return log p and log (1 - p) of the relations between candidates and present objects.

        Both results have the shape (relations, candidates, anchors), where an anchor is a present
        object.
        """
        observation, draws = self.observation, self.draws
        machine, evidence = observation.machine, observation.evidence
        classes, counts = observation.classes[anchors], observation.counts[anchors]
        # Each relation unit involves only one candidate, so all candidates can be present at once.
        v = evidence.v.clone()
        v[:, candidates] = 1.0
        weight = weights_with(machine, evidence, draws, candidates)
        if outgoing:
            units = units_between(machine, candidates, classes, None, counts)
            weight = weight[:, None, :, None]
        else:
            units = units_between(machine, classes, candidates, counts, None)
            weight = weight[:, None, None, :]
        logits = machine.relation_logits(units.edges, v, draws.h1).squeeze(1)
        on, off = mean_log_p(weight, units.grid(logits, NO_UNIT))
        return (on, off) if outgoing else (on.mT, off.mT)

    @torch.inference_mode()
    def log_odds_given_rest(self) -> Floats:
        """Implement `Posterior.log_odds_given_rest`.

        If relations are observed, each class has its own draws.
        """
        observation = self.observation
        machine, n = observation.machine, len(observation.classes)
        alone = torch.eye(n, dtype=torch.bool)
        parts = []
        for classes in torch.arange(n).split(_rows(observation.unit_count * DRAWS)):
            rest = observation.without(alone[classes])
            draws = None
            if rest.edges is not None:
                draws = draw_context(machine, rest, rows=n, pull=self._pull.objects)
            candidates = observation.classes[classes].unsqueeze(1)
            parts.append(presence_log_odds(machine, rest, candidates, draws).squeeze(1))
        return _numpy(torch.cat(parts))

    @torch.inference_mode()
    def reasons(self, rows: Places) -> Floats:
        """Implement `Posterior.reasons`, with mean-field estimates of both log-odds.

        A reason is a difference of two log-odds. With draws, the noise of the estimates would
        exceed the difference. A scene without the classes i and j gives two log-odds: of i without
        j, and of j without i.
        """
        observation = self.observation
        machine, n = observation.machine, len(observation.classes)
        places = torch.from_numpy(np.asarray(rows, dtype=np.int64))
        wanted = torch.zeros(n, dtype=torch.bool)
        wanted[places] = True
        pairs = (wanted.unsqueeze(1) | wanted).triu().nonzero().contiguous()
        alone = torch.eye(n, dtype=torch.bool)
        parts = [
            object_log_odds(
                machine,
                observation.without(alone[part].any(1)),
                candidates=observation.classes[part],
                pull=self._pull.objects,
            )
            for part in pairs.split(_rows(observation.unit_count))
        ]
        log_odds = torch.cat(parts)
        without = log_odds.new_zeros(n, n)
        i, j = pairs.unbind(1)
        without[i, j], without[j, i] = log_odds.unbind(1)
        without = without[places]
        # The diagonal contains the log-odds of each class given all other classes.
        change = without.gather(1, places.unsqueeze(1)) - without
        change[torch.arange(len(places)), places] = 0.0
        return _numpy(change)

    @torch.inference_mode()
    def reasons_for_absent(self, candidates: Places) -> Floats:
        """Implement `Posterior.reasons_for_absent`, with mean-field estimates as in `reasons`."""
        observation = self.observation
        machine, n = observation.machine, len(observation.classes)
        where = torch.from_numpy(np.asarray(candidates, dtype=np.int64)).unsqueeze(0)
        # The first row keeps all classes. Each other row removes one class of the scene.
        removed = torch.eye(n + 1, dtype=torch.bool)[:, 1:]
        size = observation.unit_count + where.shape[1] * max(1, machine.spec.H1)
        log_odds = torch.cat(
            [
                object_log_odds(
                    machine, observation.without(part), candidates=where, pull=self._pull.objects
                )
                for part in removed.split(_rows(size))
            ]
        )
        return _numpy((log_odds[0] - log_odds[1:]).T)


def _rows(size: int) -> int:
    """Return how many rows of `size` values fit in a block of `_BLOCK` values, at least 1."""
    return max(1, _BLOCK // max(1, size))


def _numpy(values: Tensor) -> Floats:
    """Return the values as a contiguous array, because the compiled functions need one."""
    found: Floats = values.contiguous().numpy()
    return found
