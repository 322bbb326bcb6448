"""Intruders: add one absent class to a scene, to test the detection of outliers.

The class is drawn from one of four distributions over absent classes:

    uniform     all classes have the same probability
    popularity  see `by_popularity`
    room        see `by_room`
    signature   a class that is typical of another room type

Structure classes such as walls are never intruders. Scenes with fewer than three other classes are
skipped.

The lift of a class in a room type is p(class | room type) / p(class), over training scenes with a
known room type. The signature of a room type contains the ten classes with the highest lift, or
fewer. A signature class has a lift of at least 5 and occurs in at least 20 % of the scenes of the
room type. Room types with fewer than 20 training scenes are left out.

In a scene of room type r, a signature intruder must be a signature class of another room type. It
must also occur in less than 1 % of the training scenes of room type r. The intruder is drawn in two
steps. The first step draws one of the room types that have such a class. The second step draws one
of these classes. Both draws are uniform.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_rng
from training.evaluation.metrics import Items, Ratio

SIGNATURE = 10
"""Maximum number of signature classes of a room type."""

_SCENES = 20
_LIFT = 5.0
_OFTEN = 0.2
_FOREIGN = 0.01

# Function that takes scenes and training scenes, and returns sampling weights (scenes, classes).
Law = Callable[[SceneTensors, SceneTensors], Tensor]


def by_popularity(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Return weights (scenes, classes): the number of training scenes with each class."""
    return train.v.sum(0).expand(len(scenes), -1)


def by_room(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Return 1 for classes that training scenes of the room type contain, (scenes, classes)."""
    weights = torch.zeros_like(scenes.v)
    for room in scenes.room.unique().tolist():
        if room >= 0:
            is_in_room = (train.v[train.room == room] > 0).any(0)
            weights[scenes.room == room] = is_in_room.to(weights.dtype)
    return weights


def draw_intruders(
    scenes: SceneTensors, structure: Tensor, weights: Tensor | None = None, seed: int = 0
) -> Tensor:
    """Draw an intruder for each scene. Return its class, (scenes,) int64; -1 skips the scene.

    Args:
        weights: (scenes, classes) sampling weights. None means equal weights.
    """
    present = scenes.v > 0
    absent = (~present & ~structure).double()
    if weights is not None:
        absent = absent * weights
    is_usable = ((present & ~structure).sum(1) >= 3) & (absent.sum(1) > 0)
    intruders = torch.full((len(scenes),), -1, dtype=torch.int64)
    for k in is_usable.nonzero().squeeze(1).tolist():
        p = absent[k].numpy()
        rng = scene_rng(scenes.scenes[k], seed)
        intruders[k] = int(rng.choice(len(p), p=p / p.sum()))
    return intruders


def signatures(train: SceneTensors) -> tuple[Flags, Floats]:
    """Return the signature classes and the class frequencies of every room type.

    Returns:
        typical: (room types, classes) bool, True for the signature classes of each room type.
        share: (room types, classes) p(class | room type). NaN for a room type with too few scenes.
    """
    has_room = (train.room >= 0).numpy()
    v, room = train.v.numpy()[has_room] > 0, train.room.numpy()[has_room]
    rooms = int(room.max(initial=-1)) + 1
    share = np.full((rooms, v.shape[1]), np.nan)
    typical = np.zeros(share.shape, dtype=np.bool_)
    popularity = v.mean(0) if len(v) else np.zeros(v.shape[1])
    for r in range(rooms):
        room_scenes = v[room == r]
        if len(room_scenes) < _SCENES:
            continue
        share[r] = room_scenes.mean(0)
        is_frequent = share[r] >= _OFTEN
        lift = np.divide(share[r], popularity, where=is_frequent, out=np.zeros(v.shape[1]))
        ranked = np.argsort(-lift, kind="stable")[:SIGNATURE]
        typical[r, ranked[lift[ranked] >= _LIFT]] = True
    return typical, share


def by_signature(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Return the sampling probability of each signature intruder, (scenes, classes), or 0."""
    typical, share = signatures(train)
    weights = np.zeros(scenes.v.shape)
    absent = scenes.v.numpy() == 0
    for k, room in enumerate(scenes.room.tolist()):
        if not 0 <= room < len(typical) or np.isnan(share[room]).any():
            continue
        suitable = typical & absent[k] & (share[room] < _FOREIGN)
        suitable[room] = False
        suitable = suitable[suitable.any(1)]
        if len(suitable):
            weights[k] = (suitable / suitable.sum(1, keepdims=True)).mean(0)
    return torch.from_numpy(weights)


def draw_intruder_choices(
    scenes: SceneTensors, structure: Tensor, train: SceneTensors | None, seed: int = 0
) -> dict[tuple[str, str], Ints]:
    """Draw up to three classes for each scene, by (source, scene id), for `ask_outliers`.

    They are a uniform, a popular and a signature intruder; without `train`, only a uniform one.
    """
    weights: list[Tensor | None] = [None]
    if train is not None:
        weights += [by_popularity(scenes, train), by_signature(scenes, train)]
    # `ask_outliers` uses `seed` itself. Another seed keeps the draws independent.
    columns = [draw_intruders(scenes, structure, weight, seed + 1) for weight in weights]
    rows = torch.stack(columns, 1).numpy()
    names = [(scene.source, scene.scene_id) for scene in scenes.scenes]
    return {name: row[row >= 0] for name, row in zip(names, rows, strict=True)}


@dataclass(frozen=True, eq=False)
class IntruderScores:
    """Log-odds of each object given the other objects, for scenes without and with an intruder.

    A scene is scored twice: once as it is (clean), and once with its intruder. The arrays have one
    entry for each object of each scored scene.

    Attributes:
        scene: (objects,) index of the scene.
        thing: (objects,) class of the object.
        log_odds: (objects,) log-odds of the object.
        intruder: (objects,) bool, True if the object is the intruder.
        size: (objects,) number of distinct classes in the scored scene.
        clean: (objects,) bool, True if the scored scene has no intruder.
        skipped: number of scenes that are too small or have no possible intruder.
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
        """(objects,) number of distinct classes in the scored scene, without structure classes."""
        as_scored = 2 * self.scene + self.clean
        counts: Ints = np.bincount(as_scored)[as_scored]
        return counts

    def with_prior(self, prior: Floats) -> IntruderScores:
        """Subtract the prior log-odds that a class is an intruder, `prior` (classes,)."""
        return replace(self, log_odds=self.log_odds - prior[self.thing])

    @property
    def dirty(self) -> Items:
        """The objects of scenes with an intruder as items: negated log-odds, true for intruders."""
        rows = ~self.clean
        score, truth = -self.log_odds[rows], self.intruder[rows]
        return Items(self.scene[rows], score, truth, self.scenes, self.skipped)

    def hit_at_1(self) -> Ratio:
        """Return the share of scenes whose intruder has the lowest log-odds; expected over ties."""
        return self.dirty.hit_at_1()

    def false_alarms(self, alarms: Flags) -> Ratio:
        """Return the share of clean scenes with an alarm, for the alarms `alarms` (objects,)."""
        return self._alarms(alarms, self.clean)

    def caught(self, alarms: Flags) -> Ratio:
        """Return the share of intruders with an alarm, for the alarms `alarms` (objects,)."""
        return self._alarms(alarms, self.intruder)

    def _alarms(self, alarms: Flags, judged: Flags) -> Ratio:
        has_object = np.bincount(self.scene[judged], minlength=self.scenes) > 0
        has_alarm = np.bincount(self.scene[judged & alarms], minlength=self.scenes) > 0
        return Ratio.of_scenes(has_alarm, has_object)


Score = Callable[[Tensor], Tensor]


@torch.no_grad()
def intruder_scores(
    scenes: SceneTensors,
    structure: Tensor,
    score: Score,
    *,
    weights: Tensor | None = None,
    seed: int = 0,
) -> IntruderScores:
    """Score every object of every scene, without an intruder and with an intruder.

    All relations are unobserved.

    Args:
        score: function that takes presence (rows, classes) and returns log-odds (rows, classes).
    """
    added = draw_intruders(scenes, structure, weights, seed)
    blocks = []
    for index in (added >= 0).nonzero().squeeze(1).split(32):
        clean, intruder = scenes.v[index], added[index]
        blocks.append((clean, index, torch.full_like(intruder, -1)))
        blocks.append((clean.scatter(1, intruder.unsqueeze(1), 1.0), index, intruder))
    return _scores(blocks, structure, score, len(scenes), int((added < 0).sum()))


@torch.no_grad()
def clean_scores(v: Tensor, structure: Tensor, score: Score) -> IntruderScores:
    """Score every object of the scenes `v` (scenes, classes), without intruders."""
    blocks = [
        (v[index], index, torch.full_like(index, -1)) for index in torch.arange(len(v)).split(64)
    ]
    return _scores(blocks, structure, score, len(v), 0)


def _scores(
    blocks: list[tuple[Tensor, Tensor, Tensor]],
    structure: Tensor,
    score: Score,
    scenes: int,
    skipped: int,
) -> IntruderScores:
    """Score the objects of blocks of (presence, scene indices, intruders or -1)."""
    parts = []
    for v, index, added in blocks:
        row, things = ((v > 0) & ~structure).nonzero(as_tuple=True)
        log_odds = torch.zeros(0)
        if len(row):
            other_objects = v[row].scatter(1, things.unsqueeze(1), 0.0)
            log_odds = score(other_objects).gather(1, things.unsqueeze(1)).squeeze(1)
        parts.append(
            {
                "scene": index[row],
                "thing": things,
                "log_odds": log_odds.double(),
                "intruder": things == added[row],
                "size": (v > 0).sum(1)[row],
                "clean": added[row] < 0,
            }
        )
    columns = {name: torch.cat([part[name] for part in parts]).numpy() for name in parts[0]}
    return IntruderScores(**columns, scenes=scenes, skipped=skipped)
