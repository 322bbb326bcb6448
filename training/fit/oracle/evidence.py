"""Convert a scene to evidence in the tensor layout of a machine.

A class seen with confidence c < 1 has the presence v = c. The energy is linear in v_i, so v = c
gives the mean energy over v_i ~ Bernoulli(c). The hidden units are computed once from v = c instead
of averaged over v_i, which is a first-order approximation. Unseen classes have v = 0.

Listed relations and relations derived from poses are observed. All other relations are unobserved.
In the local form of the energy (`training.machines.machine`), unobserved relations have no effect,
so only classes with an observed relation have relation units. A relation for which the machine has
no unit is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from app.questions.posterior import Present, present
from app.scene.scene import Scene, class_evidence
from training.fit.oracle.units import Units, units_between
from training.machines import BoltzmannMachine
from training.machines.draws import HiddenDraws, draw_hidden
from training.machines.mean_field import Evidence

DRAWS = 64
"""Number of draws of the hidden units for an estimate. A power of two suits a Sobol sequence."""

# Minimum number of draws. Scenes with very many relations use fewer draws to limit the time.
_FEWEST_DRAWS = 8
_RELATION_DRAWS = 1 << 25


def draw_context(
    machine: BoltzmannMachine, evidence: Evidence, *, rows: int | None = None, pull: float = 1.0
) -> HiddenDraws:
    """Return weighted draws of h1 given the evidence. Equal evidence gives equal draws.

    The number of draws is `DRAWS`, or smaller if rows × relation units × draws would exceed a
    bound.

    Args:
        rows: total number of evidence rows of the request. The default is the rows of `evidence`.
        pull: exponent of the likelihood of the observed relations, from 0 to 1.
    """
    units = 0 if evidence.edges is None else evidence.edges.shape[-1]
    size = (len(evidence.v) if rows is None else rows) * units
    draws = DRAWS
    while draws > _FEWEST_DRAWS and draws * size > _RELATION_DRAWS:
        draws //= 2
    return draw_hidden(machine, evidence, draws=draws, pull=pull)


@dataclass(frozen=True)
class Observation:
    """One scene in the tensor layout of a machine.

    Attributes:
        scene: classes of the scene as arrays.
        classes: indices of the n distinct classes in ascending order, (n,) int64.
        counts: number of instances of each class, (n,) int64.
        holds, observed: values and observed flags of the relations, (relations, n, n) bool.
        evidence: the scene as evidence with one row.
        units: layout of the relation units in the evidence. None means that relations do not affect
            the hidden units.
        touched: True for classes with a relation unit in `units`, (n,) bool.
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
        """Number of relation units in the evidence."""
        return 0 if self.units is None else self.units.edges.shape[-1]

    def without(self, removed: Tensor) -> Evidence:
        """Return the scene without some classes and without the relations of these classes.

        Args:
            removed: True for classes to remove, (rows of the result, classes of the scene) bool.
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
            # In the seed form, unobserved relations also have an effect, so each row needs units
            # between its own classes.
            edges = edges.expand(size)
        return Evidence(v, edges, evidence.r.expand(size, -1), observed, room)


def observe(machine: BoltzmannMachine, scene: Scene) -> Observation:
    """Convert a scene to the tensor layout of a machine.

    Raises:
        ValueError: the machine does not have the class of an object, or the room type.
    """
    spec = machine.spec
    found = class_evidence(scene)
    classes, counts = torch.from_numpy(found.classes), torch.from_numpy(found.counts)
    v = torch.zeros(1, spec.V, dtype=machine.b.dtype)
    v[0, classes] = torch.from_numpy(found.confidence).to(v.dtype)
    room = None if scene.room_type is None else torch.tensor([scene.room_type])
    # A machine can have fewer relations than the vocabulary, so the extra relations are cut off.
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
