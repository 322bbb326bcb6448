"""A scene as evidence for one machine: names and positions end here, tensors begin.

Presence is soft: a class seen with confidence c < 1 enters as v = c. That is a first-order
treatment: the energy is linear in v_i, so v = c stands for its mean over v_i ~ Bernoulli(c), but
what the context makes of either value is not averaged. Classes that nobody saw enter as v = 0.

Relations: what the scene states or shows is observed, everything else is unobserved. In the local
form unobserved relations drop out, so only classes that an observed relation touches get units. A
relation that has no unit in the machine carries no evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from app.questions.posterior import Present, present
from app.scene.evidence import class_evidence
from app.scene.scene import Scene
from training.machines import BoltzmannMachine
from training.machines.draws import HiddenDraws, draw_hidden
from training.machines.mean_field import Evidence
from training.oracle.units import Units, units_between

DRAWS = 64
"""Draws of the context behind an estimate; a power of two keeps the Sobol sequence balanced."""

# Evidence of very many relations gets fewer draws, down to a few, so that a question stays bounded.
_FEWEST_DRAWS = 8
_RELATION_DRAWS = 1 << 25


def draw_context(
    machine: BoltzmannMachine,
    evidence: Evidence,
    *,
    rows: int | None = None,
    pull: float = 1.0,
) -> HiddenDraws:
    """The fixed, weighted draws of h1 that every estimate uses.

    `DRAWS` of them, or fewer where rows × relation units × draws would exceed a bound.

    Args:
        rows: how many rows the question has in all; those of the evidence by default.
        pull: weight of the observed relations, see `draw_hidden`.
    """
    units = 0 if evidence.edges is None else evidence.edges.shape[-1]
    size = (len(evidence.v) if rows is None else rows) * units
    draws = DRAWS
    while draws > _FEWEST_DRAWS and draws * size > _RELATION_DRAWS:
        draws //= 2
    return draw_hidden(machine, evidence, draws=draws, pull=pull)


@dataclass(frozen=True)
class Observation:
    """One scene, for one machine.

    Attributes:
        machine: whose units these are.
        scene: its classes, in arrays.
        classes, counts: (n,) int64, the distinct classes, ascending, and their instances.
        holds, observed: (A, n, n) bool.
        evidence: the same in the machine's layout, one row.
        units: layout of the evidence's relations; None where relations say nothing.
        touched: (n,) bool, the classes that `units` speak of.
    """

    machine: BoltzmannMachine
    scene: Present
    classes: Tensor
    counts: Tensor
    holds: Tensor
    observed: Tensor
    evidence: Evidence
    units: Units | None
    touched: Tensor

    @property
    def unit_count(self) -> int:
        """E, the relation units of the evidence."""
        return 0 if self.units is None else self.units.edges.shape[-1]

    def without(self, removed: Tensor) -> Evidence:
        """The scene with some classes, and every relation that touches them, taken out.

        Args:
            removed: (B, n) bool, one row for each way of taking out.
        """
        evidence, size = self.evidence, len(removed)
        v = evidence.v.repeat(size, 1)
        v[:, self.classes] = torch.where(removed, 0.0, v[:, self.classes])
        room = None if evidence.room is None else evidence.room.expand(size)
        if self.units is None or evidence.r is None or evidence.observed is None:
            return Evidence(v, room=room)
        gone = removed[:, self.touched]
        kept = ~(gone.unsqueeze(2) | gone.unsqueeze(1)).unsqueeze(1)
        kept = kept.expand(-1, self.machine.spec.A, -1, -1)
        observed = evidence.observed & self.units.flat(kept)
        edges = self.units.edges
        if self.machine.relations_act:
            # Unobserved relations attract, and a candidate's anchors go row by row.
            edges = edges.expand(size)
        return Evidence(v, edges, evidence.r.expand(size, -1), observed, room)


def observe(machine: BoltzmannMachine, scene: Scene) -> Observation:
    """Read a scene.

    Raises:
        ValueError: an object outside the machine's classes, or a room type it does not have.
    """
    spec = machine.spec
    found = class_evidence(scene)
    classes, counts = torch.from_numpy(found.classes), torch.from_numpy(found.counts)
    v = torch.zeros(1, spec.V, dtype=machine.b.dtype)
    v[0, classes] = torch.from_numpy(found.confidence).to(v.dtype)
    room = None if scene.room_type is None else torch.tensor([scene.room_type])
    # A machine may know fewer relations than there are.
    holds = torch.from_numpy(found.holds[: spec.A])
    observed = torch.from_numpy(found.observed[: spec.A])
    observation = Observation(
        machine=machine,
        scene=present(scene, spec),
        classes=classes,
        counts=counts,
        holds=holds,
        observed=observed,
        evidence=Evidence(v, room=room),
        units=None,
        touched=torch.ones(len(classes), dtype=torch.bool),
    )
    return _with_relations(observation)


def _with_relations(scene: Observation) -> Observation:
    touched, machine = scene.touched, scene.machine
    if not machine.relations_act:
        pairs = scene.observed.any(0)
        touched = pairs.any(0) | pairs.any(1)
        if not bool(touched.any()):
            return scene
    classes, counts = scene.classes[touched], scene.counts[touched]
    units = units_between(machine, classes, classes, counts, counts)
    holds = units.flat(scene.holds[:, touched][:, :, touched])
    observed = units.flat(scene.observed[:, touched][:, :, touched])
    evidence = replace(
        scene.evidence,
        edges=units.edges,
        r=holds.unsqueeze(0).to(scene.evidence.v.dtype),
        observed=observed.unsqueeze(0),
    )
    return replace(scene, evidence=evidence, units=units, touched=touched)
