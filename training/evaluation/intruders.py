"""Intruders: add one absent class to a scene, to test the detection of outliers.

The class is drawn from one of three distributions over absent classes:

    uniform     all classes have the same probability
    popularity  see `by_popularity`
    signature   a class that is typical of another room type

Structure classes such as walls are never intruders. Scenes with fewer than three other classes are
skipped.

The lift of a class in a room type is p(class | room type) / p(class), over training scenes with a
known room type. The signature of a room type contains the ten classes with the highest lift, or
fewer. A signature class has a lift of at least 5 and occurs in at least 20 % of the scenes of the
room type. Room types with fewer than 20 training scenes are left out.

In a scene of room type r, a signature intruder is a signature class of another room type, which
occurs in less than 1 % of the training scenes of r. One uniform draw chooses among the room types
with such a class, and another among these classes.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_rng
from training.evaluation.setting import Structure

LAWS = ("uniform", "by popularity", "signature")  # distributions of intruders
SIGNATURE = 10  # maximum number of signature classes of a room type

_SCENES = 20
_LIFT = 5.0
_OFTEN = 0.2
_FOREIGN = 0.01


def by_popularity(scenes: SceneTensors, train: SceneTensors) -> Float[Tensor, "scenes V"]:
    """Return the number of training scenes with each class as weights of each scene."""
    return train.v.sum(0).expand(len(scenes), -1)


def draw_intruders(
    scenes: SceneTensors,
    structure: Structure,
    weights: Float[Tensor, "scenes V"] | None = None,
    seed: int = 0,
) -> Int[Tensor, " scenes"]:
    """Draw the class of an intruder for each scene by sampling weights; -1 skips the scene."""
    present = scenes.v > 0
    absent = (~present & ~structure).double()
    if weights is not None:
        absent = absent * weights
    is_usable = ((present & ~structure).sum(1) >= 3) & (absent.sum(1) > 0)
    intruders = torch.full((len(scenes),), -1, dtype=torch.int64)
    for k in is_usable.nonzero().squeeze(1).tolist():
        p = absent[k].numpy()
        intruders[k] = int(scene_rng(scenes.scenes[k], seed).choice(len(p), p=p / p.sum()))
    return intruders


def signatures(train: SceneTensors) -> tuple[Bool[NDArray, "C V"], Float[NDArray, "C V"]]:
    """Return a mask of signature classes, and p(class | room type): NaN with too few scenes."""
    has_room = (train.room >= 0).numpy()
    v, room = train.v.numpy()[has_room] > 0, train.room.numpy()[has_room]
    share = np.full((int(room.max(initial=-1)) + 1, v.shape[1]), np.nan)
    typical = np.zeros(share.shape, dtype=np.bool_)
    for r in np.flatnonzero(np.bincount(room) >= _SCENES):
        share[r] = v[room == r].mean(0)
        is_frequent = share[r] >= _OFTEN
        lift = np.divide(share[r], v.mean(0), where=is_frequent, out=np.zeros(v.shape[1]))
        ranked = np.argsort(-lift, kind="stable")[:SIGNATURE]
        typical[r, ranked[lift[ranked] >= _LIFT]] = True
    return typical, share


def by_signature(scenes: SceneTensors, train: SceneTensors) -> Float[Tensor, "scenes V"]:
    """Return the sampling probability of each signature intruder of each scene; else 0."""
    typical, share = signatures(train)
    weights, absent = np.zeros(scenes.v.shape), scenes.v.numpy() == 0
    for k, room in enumerate(scenes.room.tolist()):
        if not 0 <= room < len(typical) or np.isnan(share[room]).any():
            continue
        suitable = typical & absent[k] & (share[room] < _FOREIGN)
        suitable[room] = False
        suitable = suitable[suitable.any(1)]
        if len(suitable):
            weights[k] = (suitable / suitable.sum(1, keepdims=True)).mean(0)
    return torch.from_numpy(weights)


def intruder_weights(
    scenes: SceneTensors, train: SceneTensors | None
) -> dict[str, Float[Tensor, "scenes V"] | None]:
    """Return the sampling weights of each law; only uniform without `train`."""
    if train is None:
        return {"uniform": None}
    weights = (None, by_popularity(scenes, train), by_signature(scenes, train))
    return dict(zip(LAWS, weights, strict=True))


def draw_intruder_choices(
    scenes: SceneTensors, structure: Structure, train: SceneTensors | None, seed: int = 0
) -> dict[tuple[str, str], Int[NDArray, " choices"]]:
    """Draw an intruder of each law for each scene, by (source, scene id), for `ask_outliers`."""
    weights = intruder_weights(scenes, train).values()
    # `ask_outliers` uses `seed` itself. Another seed keeps the draws independent.
    columns = [draw_intruders(scenes, structure, weight, seed + 1) for weight in weights]
    rows = torch.stack(columns, 1).numpy()
    names = [(scene.source, scene.scene_id) for scene in scenes.scenes]
    return {name: row[row >= 0] for name, row in zip(names, rows, strict=True)}
