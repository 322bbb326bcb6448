"""Fit the calibration entries about room types.

rooms        Sharpness of the probabilities of room types (`/rooms`), fitted by maximum
             likelihood to parts of validation scenes of each number of classes, and to whole
             scenes.
rare_rooms   Room types of few training scenes (`rare_rooms`).
written_rooms
             Room types that only written sources show.
smallest, room_fit
             Limits of a generated scene of each room type.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import log_softmax
from torch import Tensor

from app.inference.chains import random_stream
from app.questions.generate import STEPS, room_fit
from app.questions.posterior import Posterior
from app.registry import Artifact, Sharpness
from training.datasets.array_types import Flags, Floats
from training.datasets.batches import SceneTensors, subset
from training.datasets.sources import source_of
from training.evaluation.asking import of_classes
from training.evaluation.parts import Size, draw_parts, exactly
from training.fit.long_chains import conditions_of

_LENGTHS = (1, 2, 3, 5, 8)  # numbers of listed classes in the fit of `rooms`
_LEAST_SCENES = 20  # validation scenes with a room type in that fit
# A room type of at least `_ENOUGH_SCENES` scenes is never rare; one of fewer than `_FEW_SCENES` is.
_ENOUGH_SCENES, _FEW_SCENES = 50, 10
_SPLITS = 20
_SAMPLES = 64
# Quantiles over real rooms of a room type. A generated scene is too small if its number of classes
# is below quantile `_SMALL`. A generated scene does not suit its room type if its `room_fit` is
# below quantile `_UNSUITED`. A room type needs `_ROOM_SCENES` scenes for separate limits.
_SMALL = 0.1
_UNSUITED = 0.15
_ROOM_SCENES = 20


def calibrate_rooms(
    artifact: Artifact, scenes: SceneTensors, train: SceneTensors, structure: Tensor
) -> dict[str, Any]:
    """Return the calibration entries about room types.

    Args:
        scenes: validation scenes of the served sources.
        train: training scenes with complete object lists.
    """
    return {
        "rooms": fit_rooms(artifact, scenes, structure),
        "rare_rooms": rare_rooms(artifact, train, structure),
        "written_rooms": written_rooms(train),
        "smallest": smallest_scenes(train, structure, artifact.spec.C),
        "room_fit": room_limits(artifact, train),
    }


def fit_rooms(artifact: Artifact, scenes: SceneTensors, structure: Tensor) -> Sharpness:
    """Fit the sharpness of room types; the default with fewer than 20 scenes of a known type."""
    scenes = subset(scenes, (scenes.room >= 0).nonzero().squeeze(1))
    if len(scenes) < _LEAST_SCENES:
        return Sharpness()
    sizes: list[Size] = [lambda n, _: n, *map(exactly, _LENGTHS)]
    parts = [draw_parts(scenes, structure, size) for size in sizes]
    v = torch.cat([part.v for part in parts])
    room = torch.cat([scenes.room[part.scene] for part in parts]).numpy()
    log_p = np.stack([posterior_of(artifact, row).room_log_p() for row in v])
    size = np.log(v.sum(1).numpy())

    def loss(weights: Floats) -> float:
        sharpness = np.maximum(weights[0] + weights[1] * size, 0.05)
        table = log_softmax(sharpness[:, None] * log_p, axis=1)
        return -float(table[np.arange(len(room)), room].mean())

    slope, log_count = minimize(loss, [1.0, 0.0], method="Nelder-Mead").x.round(4).tolist()
    return Sharpness(slope=slope, log_count=log_count)


def posterior_of(artifact: Artifact, v: Tensor) -> Posterior:
    """Return the posterior given the listed classes v, (classes,)."""
    return Posterior(artifact, of_classes(v.nonzero().squeeze(1).tolist()))


def written_rooms(train: SceneTensors) -> tuple[int, ...]:
    """Return the room types whose training scenes are all written, in ascending order."""
    is_written = torch.tensor([source_of(name).written for name in train.source_names])
    written = is_written[train.source]
    others = {-1, *train.room[~written].tolist()}
    return tuple(sorted(set(train.room[written].tolist()) - others))


def rare_rooms(
    artifact: Artifact, train: SceneTensors, structure: Tensor, seed: int = 0
) -> tuple[int, ...]:
    """Return the room types with too few training scenes to sample them, in ascending order.

    These are the types of fewer than 10 scenes. They are also the types of fewer than 50 scenes
    whose samples resemble the scenes less than two halves of the scenes resemble each other. The
    resemblance of two sets is sum_i min(p_i, q_i) / sum_i max(p_i, q_i), where p_i and q_i are the
    shares of scenes with class i.
    """
    rng, things = np.random.default_rng(seed), ~structure.numpy()
    rare = []
    for t in range(artifact.spec.C):
        v = train.v[train.room == t].numpy()[:, things] > 0
        if len(v) >= _ENOUGH_SCENES:
            continue
        if len(v) >= _FEW_SCENES:
            halves = [_resemblance(*np.array_split(rng.permutation(v), 2)) for _ in range(_SPLITS)]
            if _resemblance(_samples(artifact, t, seed)[:, things], v) >= np.mean(halves):
                continue
        rare.append(t)
    return tuple(rare)


def _samples(artifact: Artifact, room: int, seed: int) -> Flags:
    """Draw scenes of a room type as `/generate` does, without its tests, (samples, classes)."""
    chains = artifact.scene_chains.under(conditions_of(room))
    samples = np.zeros((_SAMPLES, artifact.spec.V), np.bool_)
    for k, row in enumerate(samples):
        row[chains.draw(STEPS, random_stream(seed, k)).classes] = True
    return samples


def _resemblance(first: Flags, second: Flags) -> float:
    p, q = first.mean(0), second.mean(0)
    return float(np.minimum(p, q).sum() / max(np.maximum(p, q).sum(), 1e-9))


def smallest_scenes(train: SceneTensors, structure: Tensor, rooms: int) -> tuple[int, ...]:
    """Return the 10 % quantile of the number of classes in a scene, for each room type.

    The last value is the quantile over all scenes. It also replaces the quantile of a room type
    with fewer than 20 scenes.
    """
    sizes = ((train.v > 0) & ~structure).sum(1).numpy()
    limit = int(np.quantile(sizes, _SMALL)) if len(sizes) else 0
    by_room = [sizes[train.room.numpy() == t] for t in range(rooms)]
    quantiles = [int(np.quantile(n, _SMALL)) if len(n) >= _ROOM_SCENES else limit for n in by_room]
    return (*quantiles, limit)


def room_limits(artifact: Artifact, train: SceneTensors) -> tuple[float, ...]:
    """Return the 15 % quantile of `room_fit` for each room type, (room types,).

    The value is -1e9 for a room type with fewer than 20 scenes.
    """
    limits = []
    for t in range(artifact.spec.C):
        room_scenes = train.v[train.room == t]
        limit = -1e9
        if len(room_scenes) >= _ROOM_SCENES:
            fits = [room_fit(artifact, v.nonzero().squeeze(1).tolist(), t) for v in room_scenes]
            limit = float(np.quantile(fits, _UNSUITED))
        limits.append(round(limit, 4))
    return tuple(limits)
