"""Intruders: one absent class is added to a scene, drawn by one of four laws.

    uniform     from the absent, non-structure classes
    popularity  by how many training scenes have the class
    room        uniformly from the classes that training saw in the same room type
    signature   typical of another room type

Scenes under three classes have no intruder.

The lift of a class in a room type is p(class | room type) / p(class), by shares of training scenes
whose room type is known. A room type's signature are the ten classes of highest lift there, of
those in at least a fifth of its scenes and with a lift of at least 5: often there, seldom
elsewhere. The intruder of a scene of room type r is drawn in two steps: uniformly one of the other
room types that have a suitable class, then uniformly one of its suitable ones: signature classes
that are absent from the scene, no structure, and in less than 1 % of the training scenes of type r.
Room types of under 20 training scenes are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from training.batches import SceneTensors
from training.cases import scene_rng
from training.evaluation.metrics import Flags, Floats, Ints, Items, Ratio

SIGNATURE = 10
"""Classes that a room type is known by, at most."""

_SCENES = 20
_LIFT = 5.0
_OFTEN = 0.2
_FOREIGN = 0.01

# Weights (N, V) of the classes to draw from, of scenes and training scenes.
Law = Callable[[SceneTensors, SceneTensors], Tensor]


def by_popularity(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Weights (N, V): in how many of the training scenes each class is."""
    return train.v.sum(0).expand(len(scenes), -1)


def by_room(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Weights (N, V): 1 for classes that training saw in the scene's room type; 0 if unknown."""
    weights = torch.zeros_like(scenes.v)
    for room in scenes.room.unique().tolist():
        if room >= 0:
            seen = (train.v[train.room == room] > 0).any(0)
            weights[scenes.room == room] = seen.to(weights.dtype)
    return weights


def draw_intruders(
    scenes: SceneTensors, structure: Tensor, weights: Tensor | None = None, seed: int = 0
) -> Tensor:
    """An intruder for each scene, (N,) int64; -1 where a scene is skipped.

    Args:
        structure: (V,) bool.
        weights: (N, V) or None for uniform, how likely each class is to be drawn if absent.
    """
    present = scenes.v > 0
    absent = (~present & ~structure).double()
    if weights is not None:
        absent = absent * weights
    enough = ((present & ~structure).sum(1) >= 3) & (absent.sum(1) > 0)
    intruders = torch.full((len(scenes),), -1, dtype=torch.int64)
    for k in enough.nonzero().squeeze(1).tolist():
        p = absent[k].numpy()
        rng = scene_rng(scenes.scenes[k], seed)
        intruders[k] = int(rng.choice(len(p), p=p / p.sum()))
    return intruders


@dataclass(frozen=True, eq=False)
class Signatures:
    """What training scenes say of R room types.

    Attributes:
        typical: (R, V) bool, the signature of each.
        share: (R, V) p(class | room type), nan for a room type of too few scenes.
    """

    typical: Flags
    share: Floats


def signatures(train: SceneTensors) -> Signatures:
    """The signature of every room type."""
    known = (train.room >= 0).numpy()
    v, room = train.v.numpy()[known] > 0, train.room.numpy()[known]
    rooms = int(room.max(initial=-1)) + 1
    share = np.full((rooms, v.shape[1]), np.nan)
    typical = np.zeros(share.shape, dtype=np.bool_)
    popularity = v.mean(0) if len(v) else np.zeros(v.shape[1])
    for r in range(rooms):
        own = v[room == r]
        if len(own) < _SCENES:
            continue
        share[r] = own.mean(0)
        often = share[r] >= _OFTEN
        lift = np.divide(share[r], popularity, where=often, out=np.zeros(v.shape[1]))
        best = np.argsort(-lift, kind="stable")[:SIGNATURE]
        typical[r, best[lift[best] >= _LIFT]] = True
    return Signatures(typical, share)


def by_signature(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Weights (N, V): the probability of each class to be drawn; 0 throughout for no intruder."""
    found = signatures(train)
    weights = np.zeros(scenes.v.shape)
    absent = scenes.v.numpy() == 0
    for k, room in enumerate(scenes.room.tolist()):
        if not 0 <= room < len(found.typical) or np.isnan(found.share[room]).any():
            continue
        suitable = found.typical & absent[k] & (found.share[room] < _FOREIGN)
        suitable[room] = False
        sizes = suitable.sum(1)
        some = sizes > 0
        if some.any():
            weights[k] = (suitable[some] / sizes[some, None]).mean(0)
    return torch.from_numpy(weights)


def kinds_of_intruders(
    scenes: SceneTensors, structure: Tensor, train: SceneTensors | None, seed: int = 0
) -> dict[tuple[str, str], Ints]:
    """One intruder of each kind for every scene, by its source and id.

    The kinds are those of calibration: uniform, by popularity, and by signature.
    """
    laws: list[Tensor | None] = [None]
    if train is not None:
        laws += [by_popularity(scenes, train), by_signature(scenes, train)]
    # `answers.ask_outliers` draws from the scene's numbers of the same seed.
    drawn = [draw_intruders(scenes, structure, weights, seed + 1) for weights in laws]
    each = torch.stack(drawn, 1).numpy()
    names = [(scene.source, scene.scene_id) for scene in scenes.scenes]
    return {name: own[own >= 0] for name, own in zip(names, each, strict=True)}


@dataclass(frozen=True, eq=False)
class IntruderScores:
    """Log-odds of each object given the rest, for clean scenes and for the same with an intruder.

    Attributes:
        scene: (N,) position of the scene; thing: (N,) the class; log_odds: (N,); intruder: (N,)
            bool; size: (N,) number of distinct classes in the scene as scored; clean: (N,) bool,
            scored without an intruder.
        scenes: how many were given; skipped: too small, or without a class to add.
    """

    scene: Ints
    thing: Ints
    log_odds: Floats
    intruder: Flags
    size: Ints
    clean: Flags
    scenes: int
    skipped: int

    @property
    def listed(self) -> Ints:
        """(N,) number of distinct classes in the scene as scored, structure aside."""
        as_scored = 2 * self.scene + self.clean
        counts: Ints = np.bincount(as_scored)[as_scored]
        return counts

    def with_prior(self, prior: Floats) -> IntruderScores:
        """With the log-odds of being an intruder taken from each class, (V,)."""
        return replace(self, log_odds=self.log_odds - prior[self.thing])

    @property
    def dirty(self) -> Items:
        """The objects of scenes with an intruder, by -log-odds; it alone is true."""
        rows = ~self.clean
        score, truth = -self.log_odds[rows], self.intruder[rows]
        return Items(self.scene[rows], score, truth, self.scenes, self.skipped)

    def hit_at_1(self) -> Ratio:
        """Share of scenes whose intruder has the lowest log-odds (ties in expectation)."""
        return self.dirty.hit_at_1()

    def false_alarms(self, loud: Flags) -> Ratio:
        """Share of untouched scenes in which some object is loud, (N,)."""
        return self._alarms(loud, self.clean)

    def caught(self, loud: Flags) -> Ratio:
        """Share of intruders that are loud, (N,)."""
        return self._alarms(loud, self.intruder)

    def _alarms(self, loud: Flags, judged: Flags) -> Ratio:
        there = np.bincount(self.scene[judged], minlength=self.scenes) > 0
        alarm = np.bincount(self.scene[judged & loud], minlength=self.scenes) > 0
        return Ratio.of_scenes(alarm, there)


@torch.no_grad()
def intruder_scores(
    scenes: SceneTensors,
    structure: Tensor,
    score: Callable[[Tensor], Tensor],
    *,
    weights: Tensor | None = None,
    seed: int = 0,
) -> IntruderScores:
    """Score every object of every scene, clean and with one intruder; see `draw_intruders`.

    Every relation is unobserved.
    """
    added = draw_intruders(scenes, structure, weights, seed)
    kept = (added >= 0).nonzero().squeeze(1)
    parts = []
    for index in kept.split(32):
        clean, intruder = scenes.v[index], added[index]
        dirty = clean.scatter(1, intruder.unsqueeze(1), 1.0)
        parts.append(_scored(clean, index, torch.full_like(intruder, -1), structure, score))
        parts.append(_scored(dirty, index, intruder, structure, score))
    return _joined(parts, len(scenes), len(kept))


@torch.no_grad()
def clean_scores(v: Tensor, structure: Tensor, score: Callable[[Tensor], Tensor]) -> IntruderScores:
    """Score every object of every scene (N, V) as it is."""
    parts = [
        _scored(v[index], index, torch.full_like(index, -1), structure, score)
        for index in torch.arange(len(v)).split(64)
    ]
    return _joined(parts, len(v), len(v))


def _scored(
    v: Tensor,
    index: Tensor,
    added: Tensor,
    structure: Tensor,
    score: Callable[[Tensor], Tensor],
) -> tuple[Tensor, ...]:
    """Columns of `IntruderScores` of some scenes; `added` is -1 in clean ones."""
    row, thing = ((v > 0) & ~structure).nonzero(as_tuple=True)
    odds = torch.zeros(0)
    if len(row):
        rest = v[row].scatter(1, thing.unsqueeze(1), 0.0)
        odds = score(rest).gather(1, thing.unsqueeze(1)).squeeze(1)
    size, clean = (v > 0).sum(1)[row], added[row] < 0
    return index[row], thing, odds.double(), thing == added[row], size, clean


def _joined(parts: list[tuple[Tensor, ...]], scenes: int, kept: int) -> IntruderScores:
    names = ("scene", "thing", "log_odds", "intruder", "size", "clean")
    columns = (torch.cat(column).numpy() for column in zip(*parts, strict=True))
    values: dict[str, Any] = dict(zip(names, columns, strict=True))
    return IntruderScores(**values, scenes=scenes, skipped=scenes - kept)
