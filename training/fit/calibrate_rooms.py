"""Fit the calibration entries about room types.

rooms          Sharpness of the probabilities of `/rooms`, by maximum likelihood on parts of
               validation scenes of each number of classes, and on whole scenes.
several_rooms  Gain of several rooms over one that few scenes of any large source reach.
rare_rooms     Room types of few training scenes (`rare_rooms`).
written_rooms  Room types that only written sources show.
smallest, room_fit
               Limits of a generated scene of each room type, from parts of whole rooms (`limits`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax
from torch import Tensor

from app.inference.chains import random_stream
from app.model import FitLimit, SceneModel, Sharpness
from app.model.calibration import NO_LIMIT
from app.questions.doubt import believed, room_odds
from app.questions.generate import STEPS, room_fit
from app.questions.posterior import Posterior
from app.questions.several_rooms import gain
from app.scene import Scene
from training.datasets.array_types import Table
from training.datasets.batches import SceneTensors, subset
from training.datasets.sources import source_of
from training.evaluation.parts import Parts, Size, draw_parts, exactly, of_classes
from training.fit.long_chains import conditions_of
from training.fit.regression import LEAST_SCENES, quantile_of, structure_of

_LENGTHS = (1, 2, 3, 5, 8)  # numbers of listed classes in the fit of `rooms`
# A room type of at least `_ENOUGH_SCENES` scenes is never rare; one of fewer than `_FEW_SCENES` is.
_ENOUGH_SCENES, _FEW_SCENES = 50, 10
_SPLITS = 20
_SAMPLES = 64
# The limits of generated scenes are the quantile `_LEAST` over parts of whole rooms that list these
# shares of the classes. A room type needs `_ROOM_SCENES` scenes for separate limits.
_LEAST = 0.05
_PARTS = (0.3, 0.5, 0.75, 1.0)
_ROOM_SCENES = 20
_ONE_ROOM, _LARGE_SOURCE = 0.985, 50
_LONG_SCENES = 100  # of a room type, for a limit of the fit that grows with the list


def calibrate_rooms(
    artifact: SceneModel, scenes: SceneTensors, train: SceneTensors
) -> dict[str, Any]:
    """Return the entries about room types, from validation and complete training scenes."""
    return {
        "rooms": fit_rooms(artifact, scenes),
        "several_rooms": fit_several_rooms(artifact, scenes),
        "rare_rooms": rare_rooms(artifact, train),
        "written_rooms": written_rooms(train),
        **limits(artifact, train),
    }


def fit_rooms(artifact: SceneModel, scenes: SceneTensors) -> Sharpness:
    """Fit the sharpness of room types; the default with fewer than 20 scenes with a room type."""
    scenes = subset(scenes, scenes.room >= 0)
    if len(scenes) < LEAST_SCENES:
        return Sharpness()
    sizes: list[Size] = [lambda n, _: n, *map(exactly, _LENGTHS)]
    parts = [draw_parts(scenes, structure_of(artifact), size) for size in sizes]
    v = torch.cat([part.v for part in parts])
    room = torch.cat([scenes.room[part.scene] for part in parts]).numpy()
    log_p = np.stack([room_odds(artifact, listed_scene(row)).log_p for row in v])
    size = np.log(v.sum(1).numpy())

    def loss(weights: NDArray[np.float64]) -> float:
        sharpness = np.maximum(weights[0] + weights[1] * size, 0.05)
        table = log_softmax(sharpness[:, None] * log_p, axis=1)
        return -float(table[np.arange(len(room)), room].mean())

    slope, log_count = minimize(loss, [1.0, 0.0], method="Nelder-Mead").x.round(4).tolist()
    return Sharpness(slope=slope, log_count=log_count)


def fit_several_rooms(artifact: SceneModel, scenes: SceneTensors) -> float | None:
    """Return the least gain of a warning; None without room types or a source of many scenes.

    `_ONE_ROOM` is the share of the scenes of each source of at least 50 scenes with a smaller gain.
    """
    if artifact.spec.C < 2:
        return None
    limits = list[float]()
    for source in scenes.source.unique().tolist():
        listed = map(np.flatnonzero, scenes.v[scenes.source == source].numpy() > 0)
        gains = [gain(*artifact.room_evidence, classes, 0.0)[0] for classes in listed]
        gains = [one for one in gains if one > -np.inf]
        if len(gains) >= _LARGE_SOURCE:
            limits.append(float(np.quantile(gains, _ONE_ROOM)))
    return max(limits, default=None)


def posterior_of(artifact: SceneModel, v: Float[Tensor, "V"], room: int | None = None) -> Posterior:
    """Return the posterior given the listed classes v and the room type, weighted by doubt."""
    return believed(artifact, listed_scene(v, room))


def listed_scene(v: Float[Tensor, "V"], room: int | None = None) -> Scene:
    """Return a scene with one object of each listed class."""
    return replace(of_classes(v.nonzero().squeeze(1).tolist()), room_type=room)


def of_sources(scenes: SceneTensors, attribute: str) -> Bool[Tensor, "B"]:
    """Return True for scenes whose `Source` has an attribute, such as "written"."""
    values = [getattr(source_of(name), attribute) for name in scenes.source_names]
    return torch.tensor(values, dtype=torch.bool)[scenes.source]


def written_rooms(train: SceneTensors) -> tuple[int, ...]:
    """Return the room types whose training scenes are all written, in ascending order."""
    written = of_sources(train, "written")
    others = {-1, *train.room[~written].tolist()}
    return tuple(sorted(set(train.room[written].tolist()) - others))


def rare_rooms(artifact: SceneModel, train: SceneTensors, seed: int = 0) -> tuple[int, ...]:
    """Return the room types whose samples resemble scenes less than halves of the scenes do."""
    rng, things = np.random.default_rng(seed), ~artifact.vocabulary.structure
    rare = []
    for t in range(artifact.spec.C):
        v = train.v[train.room == t].numpy()[:, things] > 0  # scenes of the room type
        if len(v) >= _ENOUGH_SCENES:
            continue
        if len(v) >= _FEW_SCENES:
            halves = [_resemblance(*np.array_split(rng.permutation(v), 2)) for _ in range(_SPLITS)]
            if _resemblance(_samples(artifact, t, seed)[:, things], v) >= np.mean(halves):
                continue
        rare.append(t)
    return tuple(rare)


def _samples(artifact: SceneModel, room: int, seed: int) -> Bool[NDArray, "N V"]:
    """Draw scenes of a room type as `/generate` does, without its tests."""
    chains = artifact.scene_chains.under(conditions_of(room))
    samples = np.zeros((_SAMPLES, artifact.spec.V), np.bool_)
    for k, row in enumerate(samples):
        row[chains.draw(STEPS, random_stream(seed, k)).classes] = True
    return samples


def _resemblance(first: Bool[NDArray, "N V"], second: Bool[NDArray, "M V"]) -> float:
    """Return sum_i min(p_i, q_i) / sum_i max(p_i, q_i) of the shares p and q of each class i."""
    p, q = first.mean(0), second.mean(0)
    return float(np.minimum(p, q).sum() / max(np.maximum(p, q).sum(), 1e-9))


def limits(artifact: SceneModel, train: SceneTensors) -> dict[str, Any]:
    """Return the entries `smallest` and `room_fit`: limits of a generated scene by room type.

    A limit is a 5 % quantile over parts of whole rooms, or of all scenes without sources of these.
    All sources have equal weight. `smallest` has parts of 30 % of the classes, as a robot lists a
    room. The limit of the fit grows with the log of the number of classes. A room type of few
    scenes has the smallest number of all rooms.
    """
    of_whole_rooms = of_sources(train, "whole_rooms")
    rooms = subset(train, of_whole_rooms) if of_whole_rooms.any() else train
    parts = [draw_parts(rooms, structure_of(artifact), _part_of(share)) for share in _PARTS]
    lists = [_ListedRooms.of(rooms, part) for part in parts]
    smallest_of_all = lists[0].smallest() if len(lists[0].size) else 0
    smallest, fits = [], []
    for t in range(artifact.spec.C):
        of_type = [rooms_of_share.rows(rooms_of_share.room == t) for rooms_of_share in lists]
        if len(np.unique(of_type[0].scene)) < _ROOM_SCENES:
            smallest.append(smallest_of_all)
            fits.append(NO_LIMIT)
        else:
            smallest.append(of_type[0].smallest())
            fits.append(_fit_limit(artifact, of_type, t))
    return {"smallest": (*smallest, smallest_of_all), "room_fit": tuple(fits)}


@dataclass(frozen=True, eq=False)
class _ListedRooms(Table):
    """N listed parts of rooms."""

    listed: Bool[NDArray, "N V"]
    size: Int[NDArray, "N"]  # number of listed classes
    scene: Int[NDArray, "N"]
    source: Int[NDArray, "N"]
    room: Int[NDArray, "N"]  # room type

    @classmethod
    def of(cls, scenes: SceneTensors, parts: Parts) -> Self:
        listed, scene = parts.v.numpy() > 0, parts.scene.numpy()
        source, room = scenes.source.numpy()[scene], scenes.room.numpy()[scene]
        return cls(listed, listed.sum(1), scene, source, room)

    def smallest(self) -> int:
        return int(_low_quantile(self.size.astype(np.float64), self.source))


def _fit_limit(artifact: SceneModel, lists: Sequence[_ListedRooms], room: int) -> FitLimit:
    """Return the limit of the fit from lists of a room type, one entry for each of `_PARTS`."""
    # The quantile over few whole rooms is the worst room, so only the smallest parts count then.
    lists = lists if len(np.unique(lists[0].scene)) >= _LONG_SCENES else lists[:1]
    fits = [
        np.array([room_fit(artifact, np.flatnonzero(row).tolist(), room) for row in parts.listed])
        for parts in lists
    ]
    quantiles = [_low_quantile(fit, x.source) for fit, x in zip(fits, lists, strict=True)]
    sizes = np.log([parts.size.mean() for parts in lists])
    slope = round(float(np.polyfit(sizes, quantiles, 1)[0]), 4) if np.ptp(sizes) else 0.0
    # Among few room types, the fit of long lists stops to grow, so a line through the quantiles
    # would refuse most whole rooms. Below this line is at most the share `_LEAST` of each kind.
    intercept = min(
        _low_quantile(fit - slope * np.log(x.size), x.source)
        for fit, x in zip(fits, lists, strict=True)
    )
    # Many rooms are equal, so the limit is rounded down: it must not refuse those at the quantile.
    return FitLimit(intercept=math.floor(intercept * 1e4) / 1e4, log_count=slope)


def _part_of(share: float) -> Size:
    return lambda classes, _: max(1, round(share * classes))


def _low_quantile(values: Float[NDArray, "N"], source: Int[NDArray, "N"]) -> float:
    """Return the quantile `_LEAST` of the values, in which all sources have equal weight."""
    return quantile_of(values, 1 / np.bincount(source)[source], _LEAST)
