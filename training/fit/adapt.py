"""Adapt the object weights of a trained machine to the scenes of one home.

δ is the change of the bias of each class, and Δ that of the other weights of the recorded classes:
their rows of W and columns of Y. The fit minimises

    n · [mean over parts of recorded scenes of (BCE(hidden classes | listed) - log p(t | listed))
         + 2 · mean over parts of stored samples of the cross-entropy of the parent and the home]
    + ρ_δ |δ|² + ρ_Δ |Δ|²

- Random parts of the recorded scenes predict the rest, as in training (`training.fit.objects`). The
  fit draws scenes in proportion to their weights, and n is the sum of the weights.
- The second line is distillation: both machines predict unlisted classes and room types of the
  stored samples. Without it, the machine forgets other rooms. The usual classes of a recorded room
  type (`_usual`) have no part in the samples of that type, because the home knows better.
- Few scenes without a class k do not prove that the home lacks it. Let the parent expect the class
  in E_k of the n scenes. If no scene shows it, its target is the answer of the parent, divided by
  1 + E_k: the posterior mean of a rate with the prior exp(-rate), given no event. Only δ_k follows
  this target. W keeps the parent's answer, because weights that lower a class which the home lacks
  would also raise alarms about it.
- Usual classes that the parent hardly expects (`_UNEXPECTED`) are habits. The prior of their Δ is
  weak.
- New classes (`extended`) and rare ones of the parent have no part in the distillation
  if they are recorded. The prior of their biases is weak, and their biases start at least at the
  log-odds of the share of scenes that show the class.

`extended` adds new classes and room types before the fit. They follow those of the model. Their
weights are 0: such a class does not change the log-odds of others, and its relations are those of
an average pair. The biases make it rare.

Source of the distillation: Li and Hoiem, "Learning without forgetting" (2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, one_hot

from app.inference import Weights
from app.model import Calibration, Counts, Offsets, Places, Possibility, SceneModel
from app.model.calibration import NO_LIMIT
from app.model.possibility import UNKNOWN
from app.model.statistics import ROOM
from app.scene import CANONICAL, ObjectClass, Vocabulary
from training.datasets.array_types import Table
from training.fit.objects import Parts, random_parts
from training.machines import machine_of, weights_of

_STEPS = 80
_RATE = 0.03
_BATCH, _DISTILLED = 96, 48  # parts in a step: of recorded scenes, and of stored samples
_LEAVE_ONE_OUT = 0.3
_DISTILLATION = 2.0  # weight of a part of a stored sample, in parts of recorded scenes
_ROOM_SHARE = 0.5  # share of the parts that list their room type
_USUAL_SCENES, _USUAL_SHARE = 3, 0.5  # of a class, in the recorded scenes of a room type
_REPEATS = 4  # random parts of each recorded scene that give E_k
_UNEXPECTED = 3  # a usual class of a room is a habit if so many times E_k of the scenes show it
# Precisions of the normal priors: of biases, of biases of new classes, of other weights, and of
# other weights of habits.
_BIAS, _NEW_BIAS, _WEIGHT, _HABIT = 3.0, 0.03, 0.3, 0.03


@dataclass(frozen=True)
class TrainedOn:
    """The classes and room types of the parent that its training scenes show."""

    classes: Bool[Tensor, "V"]  # True for the classes that they show often enough
    rooms: int  # number of room types; the later ones are new


@dataclass(frozen=True)
class HomeScenes(Table):
    """N recorded scenes of a home."""

    v: Float[Tensor, "N V"]  # presence of the classes, without structure
    observed: Bool[Tensor, "N V"]  # classes whose presence or absence the scene shows
    room: Int[Tensor, "N"]  # room type; -1 where unknown
    weight: Float[Tensor, "N"]  # in scenes


def adapt(
    parent: Weights, scenes: HomeScenes, *, trained_on: TrainedOn | None = None, seed: int = 0
) -> Weights:
    """Return the parent's weights, adapted to scenes. Default of `trained_on`: everything."""
    scenes = scenes.rows(scenes.v.sum(1) >= 2)
    if not len(scenes):
        raise ValueError("no recorded scene has two known objects")
    if not parent.spec.N:
        raise ValueError("the model stores no samples, so its other rooms would be forgotten")
    everything = TrainedOn(torch.ones(parent.spec.V, dtype=torch.bool), parent.spec.C)
    fit = _Fit(parent, scenes, trained_on or everything, seed)
    for _ in range(_STEPS):
        fit.step()
    return weights_of(fit.machine)


def part_loss(
    log_odds: Float[Tensor, "N V"], target: Float[Tensor, "N V"], scenes: HomeScenes, parts: Parts
) -> Float[Tensor, "N"]:
    """Return the cross-entropy of the unlisted classes of parts; targets are probabilities."""
    weight = scenes.observed * (1 - parts.listed)
    weight = weight * torch.where(scenes.v > 0, parts.weight.unsqueeze(1), 1.0)
    return binary_cross_entropy_with_logits(log_odds, target, weight, reduction="none").sum(1)


class _Fit:
    """The fit of one home: `machine` starts as a copy of `parent`, and each step changes it."""

    def __init__(
        self, parent: Weights, scenes: HomeScenes, trained_on: TrainedOn, seed: int
    ) -> None:
        self.parent, self.scenes = machine_of(parent), scenes
        self.machine = machine_of(weights_of(self.parent))
        self._generator = torch.Generator().manual_seed(seed)
        self._recorded = (scenes.v > 0).any(0)
        new = self._recorded & ~trained_on.classes
        # The stored samples do not show new classes, so these are unobserved there.
        samples = torch.from_numpy(parent.chain_samples)
        rooms = torch.from_numpy(parent["fantasy_rooms"]).long()
        usual = _usual(scenes, max(parent.spec.C, 1))
        hides = new | (usual[rooms] & (rooms >= 0).unsqueeze(1))
        self._samples = HomeScenes(samples, ~hides, rooms, torch.ones(len(samples)))
        self._samples = self._samples.rows(samples.sum(1) >= 2)
        expected = self._expected()
        self._unseen_factor = 1 / (1 + expected)
        self._habits = usual.any(0) & (scenes.weight @ scenes.v > _UNEXPECTED * expected)
        self._precisions = self._changing(new, trained_on.rooms)
        self._start = {weight: weight.clone() for weight in self._precisions}
        # One added scene without the class keeps the share, and so the bias, finite.
        share = scenes.weight @ scenes.v / (scenes.weight @ scenes.observed.float() + 1)
        self.machine.b[new] = self.machine.b.maximum(share.logit())[new]
        for weight in self._precisions:
            weight.requires_grad_(True)
        self._optimiser = torch.optim.Adam(self._precisions, lr=_RATE)

    def _expected(self) -> Float[Tensor, "V"]:
        """Return E_k: in how many recorded scenes the parent expects each class."""
        repeated = self.scenes.rows(torch.arange(len(self.scenes)).repeat(_REPEATS))
        parts = random_parts(repeated.v, _LEAVE_ONE_OUT, self._generator)
        log_odds = self.parent.object_log_odds(parts.listed, room=repeated.room, share=parts.share)
        return repeated.weight @ (repeated.observed * log_odds.sigmoid()) / _REPEATS

    def _changing(self, new: Bool[Tensor, "V"], old_rooms: int) -> dict[Tensor, Tensor]:
        """Return the weights that change, with the prior precision of each entry; 0 is constant."""
        # Constant are the entries of unrecorded classes, except in Y for the room types from
        # `old_rooms` on, and e and Q of the earlier room types.
        machine = self.machine
        bias = torch.where(new, _NEW_BIAS, _BIAS)
        of_class = torch.where(self._habits, _HABIT, _WEIGHT) * self._recorded
        rows = of_class.unsqueeze(1).expand_as(machine.W)
        precisions: dict[Tensor, Tensor] = {machine.b: bias, machine.W: rows}
        if machine.spec.coupled:
            precisions[machine.Y] = of_class.repeat(machine.spec.C, 1)
            precisions[machine.Y][old_rooms:] = _WEIGHT
        if old_rooms < machine.spec.C:
            for weight, value in ((machine.e, _NEW_BIAS), (machine.Q, _WEIGHT)):
                precisions[weight] = torch.zeros_like(weight)
                precisions[weight][old_rooms:] = value
        return precisions

    def step(self) -> None:
        """Update the weights by one step of Adam. Constant entries have no gradient."""
        loss = self.scenes.weight.sum() * self._batch_loss() + self._prior()
        self._optimiser.zero_grad()
        loss.backward()
        for weight, precision in self._precisions.items():
            if weight.grad is not None:
                weight.grad[precision == 0] = 0
        self._optimiser.step()

    def _batch_loss(self) -> Tensor:
        """Return the loss of `_BATCH` parts of recorded scenes, then `_DISTILLED` of samples."""
        blocks = self._draw(self.scenes, _BATCH), self._draw(self._samples, _DISTILLED)
        columns = zip(*(block.columns for block in blocks), strict=True)
        scenes = HomeScenes(*map(torch.cat, columns))
        of_home = (torch.arange(len(scenes)) < _BATCH).unsqueeze(1)
        scale = torch.where(of_home.squeeze(1), 1 / _BATCH, _DISTILLATION / _DISTILLED)
        parts = random_parts(scenes.v, _LEAVE_ONE_OUT, self._generator)
        listed_room = torch.rand(len(scenes), generator=self._generator) < _ROOM_SHARE
        room = torch.where(listed_room, scenes.room, -1)
        of_parent, log_odds = (
            machine.object_log_odds(parts.listed, room=room, share=parts.share)
            for machine in (self.parent, self.machine)
        )
        loss = (scale * self._object_loss(of_parent, log_odds, scenes, parts, of_home)).sum()
        is_hidden = (room < 0) & (scenes.room >= 0)
        if bool(is_hidden.any()):
            parent_log_p, log_p = (
                machine.room_log_p(parts.listed[is_hidden])
                for machine in (self.parent, self.machine)
            )
            true = one_hot(scenes.room[is_hidden], self.machine.spec.C)
            target = torch.where(of_home[is_hidden], true, parent_log_p.exp())
            loss = loss - (scale[is_hidden].unsqueeze(1) * target * log_p).sum()
        return loss

    def _object_loss(
        self,
        of_parent: Float[Tensor, "N V"],  # log-odds of the parent
        log_odds: Float[Tensor, "N V"],
        scenes: HomeScenes,
        parts: Parts,
        of_home: Bool[Tensor, "N 1"],  # False for stored samples
    ) -> Float[Tensor, "N"]:
        """Return the loss of the unlisted classes of parts.

        The changed biases of unrecorded classes have a loss of their own, beside the parent's
        weights. The other loss is without these changes.
        """
        parent_p, hidden = of_parent.sigmoid(), scenes.v - parts.listed
        change = torch.where(self._recorded, 0.0, self.machine.b - self._start[self.machine.b])
        target = torch.where(of_home & self._recorded, hidden, parent_p)
        loss = part_loss(log_odds - change, target, scenes, parts)
        unrecorded = replace(scenes, observed=scenes.observed & ~self._recorded)
        target = torch.where(of_home, self._unseen_factor, 1.0) * parent_p
        return loss + part_loss(of_parent + change, target, unrecorded, parts)

    def _draw(self, scenes: HomeScenes, size: int) -> HomeScenes:
        drawn = scenes.weight.multinomial(size, replacement=True, generator=self._generator)
        return scenes.rows(drawn)

    def _prior(self) -> Tensor:
        total = torch.zeros(())
        for weight, precision in self._precisions.items():
            total = total + (precision * (weight - self._start[weight]) ** 2).sum()
        return total


def _usual(scenes: HomeScenes, C: int) -> Bool[Tensor, "C V"]:
    """Return the classes that most recorded scenes of each room type show, and at least three."""
    of_room = one_hot(scenes.room[scenes.room >= 0], C).float().T
    shown, total = of_room @ scenes.v[scenes.room >= 0], of_room.sum(1, keepdim=True)
    return (shown >= _USUAL_SCENES) & (shown > _USUAL_SHARE * total)


_RARE: Final = 0.1  # quantile of the old biases that a new class or room type gets
# Arrays whose new entries are the mean of the old ones: changes of biases by listed share and in
# whole scenes, and log numbers of instances. Their typical value is not 0.
_AVERAGED: Final = ("kappa", "u", "usual")


def extended(
    artifact: SceneModel, classes: Sequence[ObjectClass], rooms: Sequence[str]
) -> SceneModel:
    """Return the model in memory with further classes and room types at the end.

    Raises:
        ValueError: a name is that of a class or room type of the model.
    """
    if not classes and not rooms:
        return artifact
    old = artifact.vocabulary
    vocabulary = Vocabulary((*old.objects, *classes), (*old.room_types, *rooms), old.room_aliases)
    V, C = len(old), len(old.room_types)
    return replace(
        artifact,
        vocabulary=vocabulary,
        weights=_weights(artifact.weights, len(vocabulary), len(vocabulary.room_types)),
        calibration=_calibration(artifact.calibration, len(classes), C, len(rooms)),
        offsets=artifact.offsets and _offsets(artifact.offsets, V, len(vocabulary)),
        counts=artifact.counts and _counts(artifact.counts, C, len(rooms), len(classes)),
        places=artifact.places and _places(artifact.places, V, len(vocabulary)),
        possibility=artifact.possibility and _described(artifact.possibility, len(classes)),
    )


def _weights(weights: Weights, V: int, C: int) -> Weights:
    """Return the weights for V classes and C room types: new biases are low, most others 0."""
    old, larger = weights.spec, weights.enlarged(V, C if weights.spec.C else 0)
    arrays = larger.arrays
    arrays["b"][old.V :] = np.quantile(weights["b"], _RARE)
    if old.C:
        arrays["e"][old.C :] = np.quantile(weights["e"], _RARE)
    for name in _AVERAGED:
        if name in arrays:
            arrays[name][..., old.V :] = weights[name].mean(-1, keepdims=True)
    return larger


def _calibration(calibration: Calibration, classes: int, C: int, rooms: int) -> Calibration:
    """Return the calibration with further classes, and room types after the first C."""
    update: dict[str, Any] = {
        "popularity": calibration.popularity and (*calibration.popularity, *[None] * classes),
        "rare_rooms": (*calibration.rare_rooms, *range(C, C + rooms)),
    }
    if calibration.smallest:
        of_rooms, unknown = calibration.smallest[:-1], calibration.smallest[-1]
        update["smallest"] = (*of_rooms, *[unknown] * rooms, unknown)
    if calibration.room_fit:
        update["room_fit"] = (*calibration.room_fit, *[NO_LIMIT] * rooms)
    return calibration.model_copy(update=update)


def _offsets(offsets: Offsets, old: int, new: int) -> Offsets:
    """Return the offsets for `new` instead of `old` classes. Effects of new classes are 0."""
    A, more = len(offsets.relation), ((0, 0), (0, new - old), (0, 0))
    return replace(
        offsets,
        subject=np.pad(offsets.subject, more),
        object=np.pad(offsets.object, more),
        pair=_triple_keys(offsets.pair, old, new, A),
    )


def _triple_keys(keys: NDArray[Any], old: int, new: int, A: int) -> NDArray[Any]:
    """Return keys (a V + i) V + j of relation a and classes i and j, for V = new instead of old."""
    a, i, j = np.unravel_index(keys.astype(np.int64), (A, old, old))
    rekeyed: NDArray[Any] = ((a * new + i) * new + j).astype(keys.dtype)
    return rekeyed


def _counts(counts: Counts, C: int, rooms: int, classes: int) -> Counts:
    """Return the counts with further room types, after the first C, and further classes."""
    # The columns are the fixed features, the room types and the classes.
    fixed, of_classes = np.split(counts.weights, [ROOM + C], axis=-1)
    fixed, of_classes = (
        np.pad(part, ((0, 0), (0, 0), (0, more)))
        for part, more in ((fixed, rooms), (of_classes, classes))
    )
    return replace(counts, weights=np.concatenate([fixed, of_classes], axis=-1))


def _described(prior: Possibility, classes: int) -> Possibility:
    """Return the prior of possibility with further classes, which have no description."""
    width = len(prior.stands[0])
    return replace(
        prior,
        stands=np.pad(prior.stands, ((0, classes), (0, 0)), constant_values=1 / width),
        traits=np.pad(prior.traits, ((0, classes), (0, 0)), constant_values=UNKNOWN),
        spread=np.pad(prior.spread, (0, classes), constant_values=float(np.median(prior.spread))),
    )


def _places(places: Places, old: int, new: int) -> Places:
    """Return the places for `new` instead of `old` classes. New ones get the lowest frequency."""

    def averaged(table: NDArray[Any]) -> NDArray[Any]:
        mean = table.mean(0, keepdims=True).repeat(new - old, 0)
        return np.concatenate([table, mean.astype(table.dtype)])

    frequency = np.pad(places.frequency, (0, new - old), constant_values=places.frequency.min())
    return replace(
        places,
        triple=_triple_keys(places.triple, old, new, len(CANONICAL)),
        role_pair=_triple_keys(places.role_pair, old, new, 1),
        frequency=frequency,
        role_anchor=averaged(places.role_anchor),
        stands=averaged(places.stands),
        within=averaged(places.within),
    )
