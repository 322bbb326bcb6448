"""Adapt the object weights of a trained machine to the scenes of one home.

The weights change little where the home says little. δ is the change of the bias of each class, and
Δ is the change of the rows of W of the recorded classes. The fit minimises

    sum over recorded scenes of [BCE(hidden classes | listed) - log p(t | listed)]
    + 2 n · mean over stored samples of the cross-entropy of the parent's answers and the new ones
    + ρ_δ |δ|² + ρ_Δ |Δ|²

- Random parts of the n recorded scenes ask for the rest, as in training (`training.fit.objects`).
- The second line is distillation: random parts of the samples that the artifact stores ask both
  machines for unlisted classes and room types. Without this line, the machine forgets other rooms.
- The parent does not know the new classes (`training.fit.extend`). So they have no part in the
  distillation, and the prior of their biases is weak.

Source of the distillation: Li and Hoiem, "Learning without forgetting" (2016).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, nll_loss

from app.inference import Weights
from training.fit.objects import Parts, random_parts
from training.machines import BoltzmannMachine
from training.machines.arrays import machine_of, weights_of

_STEPS = 80
_RATE = 0.03
_BATCH, _DISTILLED = 128, 64  # parts in a step: of recorded scenes, and of stored samples
_LEAVE_ONE_OUT = 0.3
_DISTILLATION = 2.0  # weight of a part of a stored sample, in parts of recorded scenes
_ROOM_SHARE = 0.5  # share of the parts that list their room type
# Precisions of the normal priors: of biases, of biases of new classes, and of other weights.
_BIAS, _NEW_BIAS, _WEIGHT = 3.0, 0.03, 0.3


@dataclass(frozen=True)
class HomeScenes:
    """N recorded scenes of a home.

    Attributes:
        v: presence of the classes, without structure, (N, V) 0 or 1.
        asked: True for classes whose presence or absence the scene teaches, (N, V) bool.
        room: index of the room type, (N,) int64; -1 where unknown.
    """

    v: Tensor
    asked: Tensor
    room: Tensor

    def __len__(self) -> int:
        return len(self.v)

    def rows(self, index: Tensor) -> HomeScenes:
        """Return the scenes at the indices, or where a mask is True."""
        return HomeScenes(*(tensor[index] for tensor in vars(self).values()))


def adapt(
    parent: Weights, scenes: HomeScenes, *, known: tuple[int, int] | None = None, seed: int = 0
) -> Weights:
    """Return the weights of a machine that knows the home.

    Scenes with fewer than two classes teach nothing.

    Args:
        parent: weights of V classes and C room types, with stored samples.
        known: number of classes and of room types that the parent learnt. The later ones are new.
            None means that all are known.

    Raises:
        ValueError: no scene has two classes, or the parent stores no samples.
    """
    scenes = scenes.rows(scenes.v.sum(1) >= 2)
    if not len(scenes):
        raise ValueError("no recorded scene has two known objects")
    if not parent.spec.N:
        raise ValueError("the model stores no samples, so its other rooms would be forgotten")
    spec = parent.spec
    fit = _Fit(parent, scenes, known or (spec.V, spec.C), seed)
    for _ in range(_STEPS):
        fit.step()
    return weights_of(fit.machine)


def home_loss(machine: BoltzmannMachine, scenes: HomeScenes, parts: Parts, room: Tensor) -> Tensor:
    """Return the log loss of the classes that random parts of N scenes do not list, (N,)."""
    log_odds = machine.object_log_odds(parts.listed, room=room, share=parts.share)
    hidden = scenes.v - parts.listed
    weight = scenes.asked * (1 - parts.listed)
    weight = weight * torch.where(hidden > 0, parts.weight.unsqueeze(1), 1.0)
    loss = binary_cross_entropy_with_logits(log_odds, hidden, weight, reduction="none")
    return loss.sum(1)


class _Fit:
    """The fit of one home. `known`: see `adapt`."""

    def __init__(
        self, parent: Weights, scenes: HomeScenes, known: tuple[int, int], seed: int
    ) -> None:
        self.parent, self.scenes, self.known = machine_of(parent), scenes, known
        self.machine = machine_of(weights_of(self.parent))
        samples = torch.from_numpy(parent.scenes)
        several = samples.sum(1) >= 2
        self._samples = samples[several]
        self._sample_rooms = torch.from_numpy(parent["fantasy_rooms"]).long()[several]
        self._generator = torch.Generator().manual_seed(seed)
        self._changes = self._changing()
        for weight in self._changes:
            weight.requires_grad_(True)
        self._start = {weight: weight.detach().clone() for weight in self._changes}
        self._optimiser = torch.optim.Adam(self._changes, lr=_RATE)

    def _changing(self) -> dict[Tensor, Tensor]:
        """Return the weights that change, with the precisions of their entries; inf is constant."""
        machine, (V, C) = self.machine, self.known
        recorded = (self.scenes.v > 0).any(0)
        bias = torch.full_like(machine.b, _BIAS)
        bias[V:] = _NEW_BIAS
        rows = torch.where(recorded, _WEIGHT, torch.inf).unsqueeze(1).expand_as(machine.W)
        changes: dict[Tensor, Tensor] = {machine.b: bias, machine.W: rows}
        if machine.spec.C > C:
            named = {"e": _NEW_BIAS, "Q": _WEIGHT, "Y": _WEIGHT}
            for name in ("e", "Q", "Y") if machine.spec.coupled else ("e", "Q"):
                weight = machine.get_parameter(name)
                table = torch.full_like(weight, torch.inf)
                table[C:] = named[name]
                changes[weight] = table
        return changes

    def step(self) -> None:
        """Update the weights by one batch."""
        loss = self._home_loss() + _DISTILLATION * self._distillation()
        loss = len(self.scenes) * loss + self._prior()
        self._optimiser.zero_grad()
        loss.backward()
        for weight, precision in self._changes.items():
            if weight.grad is not None:
                weight.grad[precision.isinf()] = 0
        self._optimiser.step()

    def _home_loss(self) -> Tensor:
        index = torch.randint(len(self.scenes), (_BATCH,), generator=self._generator)
        scenes = self.scenes.rows(index)
        parts = random_parts(scenes.v, _LEAVE_ONE_OUT, self._generator)
        room = self._some_rooms(scenes.room)
        loss = home_loss(self.machine, scenes, parts, room).mean()
        asked = (scenes.room >= 0) & (room < 0)
        if bool(asked.any()):
            log_p = self.machine.room_log_p(parts.listed[asked])
            loss = loss + nll_loss(log_p, scenes.room[asked], reduction="sum") / _BATCH
        return loss

    def _distillation(self) -> Tensor:
        index = torch.randint(len(self._samples), (_DISTILLED,), generator=self._generator)
        parts = random_parts(self._samples[index], _LEAVE_ONE_OUT, self._generator)
        room = self._some_rooms(self._sample_rooms[index])
        V = self.known[0]
        p, log_odds = (
            machine.object_log_odds(parts.listed, room=room, share=parts.share)[:, :V]
            for machine in (self.parent, self.machine)
        )
        weight = 1 - parts.listed[:, :V]
        loss = binary_cross_entropy_with_logits(log_odds, p.sigmoid(), weight, reduction="sum")
        if self.machine.spec.C:
            listed = parts.listed[room < 0]
            of_parent, log_p = (side.room_log_p(listed) for side in (self.parent, self.machine))
            loss = loss - (of_parent.exp() * log_p).sum()
        return loss / _DISTILLED

    def _prior(self) -> Tensor:
        total = torch.zeros(())
        for weight, precision in self._changes.items():
            change = torch.where(precision.isinf(), 0.0, weight - self._start[weight])
            total = total + (precision.nan_to_num(posinf=0.0) * change**2).sum()
        return total

    def _some_rooms(self, room: Tensor) -> Tensor:
        is_listed = torch.rand(len(room), generator=self._generator) < _ROOM_SHARE
        return torch.where(is_listed, room, -1)
