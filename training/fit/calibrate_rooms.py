"""Fit the calibration entries about room types.

rooms        Sharpness of the probabilities of room types (`/rooms`), fitted by maximum
             likelihood to parts of validation scenes of each number of classes, and to whole
             scenes.
rare_rooms   Room types of few training scenes (`rare_rooms`).
written_rooms
             Room types that only written sources show.
smallest, room_fit
             Limits of a generated scene of each room type, from parts of whole rooms (`limits`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import log_softmax
from torch import Tensor

from app.inference.chains import random_stream
from app.model import FitLimit, SceneModel, Sharpness
from app.model.calibration import NO_LIMIT
from app.questions.generate import STEPS, room_fit
from app.questions.posterior import Posterior
from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.batches import SceneTensors, subset
from training.datasets.sources import source_of
from training.evaluation.asking import of_classes
from training.evaluation.parts import Parts, Size, draw_parts, exactly
from training.fit.long_chains import conditions_of

_LENGTHS = (1, 2, 3, 5, 8)  # numbers of listed classes in the fit of `rooms`
_LEAST_SCENES = 20  # validation scenes with a room type in that fit
# A room type of at least `_ENOUGH_SCENES` scenes is never rare; one of fewer than `_FEW_SCENES` is.
_ENOUGH_SCENES, _FEW_SCENES = 50, 10
_SPLITS = 20
_SAMPLES = 64
# The limits of generated scenes are the quantile `_LEAST` over parts of whole rooms that list these
# shares of the classes. A room type needs `_ROOM_SCENES` scenes for separate limits.
_LEAST = 0.05
_PARTS = (0.3, 0.5, 0.75, 1.0)
_ROOM_SCENES = 20
_LONG_SCENES = 100  # of a room type, for a limit of the fit that grows with the list


def calibrate_rooms(
    artifact: SceneModel, scenes: SceneTensors, train: SceneTensors, structure: Tensor
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
        **limits(artifact, train, structure),
    }


def fit_rooms(artifact: SceneModel, scenes: SceneTensors, structure: Tensor) -> Sharpness:
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


def posterior_of(artifact: SceneModel, v: Tensor, room: int | None = None) -> Posterior:
    """Return the posterior given the listed classes v, (classes,), and the room type."""
    scene = of_classes(v.nonzero().squeeze(1).tolist())
    return Posterior(artifact, replace(scene, room_type=room))


def written_rooms(train: SceneTensors) -> tuple[int, ...]:
    """Return the room types whose training scenes are all written, in ascending order."""
    is_written = torch.tensor([source_of(name).written for name in train.source_names])
    written = is_written[train.source]
    others = {-1, *train.room[~written].tolist()}
    return tuple(sorted(set(train.room[written].tolist()) - others))


def rare_rooms(
    artifact: SceneModel, train: SceneTensors, structure: Tensor, seed: int = 0
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


def _samples(artifact: SceneModel, room: int, seed: int) -> Flags:
    """Draw scenes of a room type as `/generate` does, without its tests, (samples, classes)."""
    chains = artifact.scene_chains.under(conditions_of(room))
    samples = np.zeros((_SAMPLES, artifact.spec.V), np.bool_)
    for k, row in enumerate(samples):
        row[chains.draw(STEPS, random_stream(seed, k)).classes] = True
    return samples


def _resemblance(first: Flags, second: Flags) -> float:
    p, q = first.mean(0), second.mean(0)
    return float(np.minimum(p, q).sum() / max(np.maximum(p, q).sum(), 1e-9))


def refitted_limits(artifact: SceneModel, train: SceneTensors) -> SceneModel:
    """Return the model with limits of generated scenes that are fitted again.

    Args:
        train: training scenes with complete object lists.
    """
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    update = limits(artifact, train, structure)
    return replace(artifact, calibration=artifact.calibration.model_copy(update=update))


def limits(artifact: SceneModel, train: SceneTensors, structure: Tensor) -> dict[str, Any]:
    """Return the limits of a generated scene of each room type.

    A limit is a 5 % quantile over parts of whole rooms. The number of classes has the parts of 30 %
    of the classes, as a robot lists a room, so rooms in short real lists also reach the limits. The
    fit grows with the number of classes. For a room type of at least 100 scenes, its limit is the
    least-squares line through the quantiles of parts of 30, 50, 75 and 100 %, in the log of their
    mean numbers of classes. All sources have equal weight. Sources of frames, sentences or
    procedural rooms do not take part, except in data without whole rooms.

    Args:
        train: training scenes with complete object lists.

    Returns:
        The fields `smallest` and `room_fit` of a `Calibration`. A room type with fewer than 20
        scenes has the number of classes of all rooms, and a fit of at least -1e9.
    """
    rooms = whole_rooms(train)
    parts = [draw_parts(rooms, structure, _part_of(share)) for share in _PARTS]
    lists = [_ListedRooms.of(rooms, part) for part in parts]
    least = lists[0].smallest() if len(lists[0].size) else 0
    smallest, fits = [], []
    for t in range(artifact.spec.C):
        own = [each.of_type(t) for each in lists]
        if len(np.unique(own[0].scene)) < _ROOM_SCENES:
            smallest.append(least)
            fits.append(NO_LIMIT)
        else:
            smallest.append(own[0].smallest())
            fits.append(_fit_limit(artifact, own, t))
    return {"smallest": (*smallest, least), "room_fit": tuple(fits)}


class _ListedRooms(NamedTuple):
    """Listed parts of rooms.

    Attributes:
        listed: True for listed classes, (parts, classes).
        size: number of listed classes, (parts,).
        scene, source, room: index of the scene, of its source and of its room type, (parts,) each.
    """

    listed: Flags
    size: Ints
    scene: Ints
    source: Ints
    room: Ints

    @classmethod
    def of(cls, scenes: SceneTensors, parts: Parts) -> Self:
        listed, scene = parts.v.numpy() > 0, parts.scene.numpy()
        source, room = scenes.source.numpy()[scene], scenes.room.numpy()[scene]
        return cls(listed, listed.sum(1), scene, source, room)

    def of_type(self, room: int) -> Self:
        """Return the parts of scenes of a room type."""
        return type(self)(*(values[self.room == room] for values in self))

    def smallest(self) -> int:
        return int(_low_quantile(self.size.astype(np.float64), self.source))


def _fit_limit(artifact: SceneModel, lists: Sequence[_ListedRooms], room: int) -> FitLimit:
    """Return the limit of the fit from lists of a room type, one entry for each of `_PARTS`.

    With few scenes, the quantile of whole lists is that of the few worst. A small machine cannot
    follow them, so the limit is then that of the shortest lists at any length.
    """
    lists = lists if len(np.unique(lists[0].scene)) >= _LONG_SCENES else lists[:1]
    quantiles = []
    for parts in lists:
        fits = [room_fit(artifact, np.flatnonzero(row).tolist(), room) for row in parts.listed]
        quantiles.append(_low_quantile(np.array(fits), parts.source))
    sizes = np.log([parts.size.mean() for parts in lists])
    slope, intercept = np.polyfit(sizes, quantiles, 1) if np.ptp(sizes) else (0.0, quantiles[0])
    return FitLimit(intercept=round(float(intercept), 4), log_count=round(float(slope), 4))


def whole_rooms(scenes: SceneTensors) -> SceneTensors:
    """Return the scenes of sources of whole rooms, or all scenes if there are none."""
    is_whole = torch.tensor([source_of(name).whole_rooms for name in scenes.source_names])
    mask = is_whole[scenes.source] if len(scenes) else torch.zeros(0, dtype=torch.bool)
    return subset(scenes, mask.nonzero().squeeze(1)) if mask.any() else scenes


def _part_of(share: float) -> Size:
    return lambda classes, _: max(1, round(share * classes))


def _low_quantile(values: Floats, source: Ints) -> float:
    """Return the quantile `_LEAST` of the values, in which all sources have equal weight."""
    return quantile_of(values, 1 / np.bincount(source)[source], _LEAST)


def quantile_of(values: Floats, weights: Floats, share: float) -> float:
    """Return the smallest value below or at which the given share of the weights lies."""
    return float(np.quantile(values, share, weights=weights, method="inverted_cdf"))
