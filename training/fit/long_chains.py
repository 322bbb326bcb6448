"""Long Gibbs chains that start at scenes, and the test that served scenes stay like these scenes.

A machine whose chains drift away from the scenes learnt a wrong distribution: the samples of
`/generate` are then good only as long as the chains are short. The test applies the filter of
`/generate` to the states of long chains.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
import torch

from app.inference.chains import Conditions, SceneChains, random_stream
from app.inference.weights import Weights
from app.model import SceneModel
from app.questions.generate import ATTEMPTS, STEPS, is_plausible
from app.registry import Metric
from app.scene import Scene
from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.sources import source_of
from training.fit.configuration import ObjectsConfig
from training.fit.objects import ObjectScenes, served_weights

T = TypeVar("T")

RECORDED: Final = 5
"""Number of sweeps between two recorded states."""

_CHAINS, _SWEEPS = 256, 3000
_SETTLED = 2000  # sweeps before the first recorded state of the test
_COMMONEST = 50
_SIZE_LIMIT, _SHARE_LIMIT = 0.10, 0.20
_MIX: Final = "served mix"
_CERTAIN = 3.0  # standard errors beyond a limit


@dataclass(frozen=True, eq=False)
class Population:
    """The scenes that the chains of one row of u should draw.

    Attributes:
        profile: index of the data source, or None for the served mix.
        weight: weight of each scene, (scenes,). The sum is 1.
        room: room type of each scene, (scenes,). -1 means unknown.
        shows: True for classes that the scenes can show, (classes,).
        p: share of the scenes with each class, (classes,).
    """

    profile: int | None
    weight: Floats
    room: Ints
    shows: Flags
    p: Floats

    def draw(self, count: int, rng: np.random.Generator) -> Ints:
        """Return indices of scenes, (count,), drawn in proportion to their weights.

        The draw is systematic: each room type has its share of the scenes, rounded.
        """
        order = np.lexsort((rng.random(len(self.room)), self.room))
        position = (np.arange(count) + rng.random()) / count
        index: Ints = order[np.searchsorted(self.weight[order].cumsum()[:-1], position)]
        return index


def populations(scenes: ObjectScenes, config: ObjectsConfig) -> Iterator[Population]:
    """Yield the population of each data source, and that of the served mix.

    The served mix has the whole rooms of the served sources (`Source.whole_rooms`): lists of
    photographs and sentences are parts of rooms. Without whole rooms, it has all scenes of the
    served sources. Without a scene of a served source, it has all scenes.
    """
    served = served_weights(scenes, config)
    served = served if served.any() else torch.ones_like(served)
    whole = served * torch.tensor([float(source_of(q).whole_rooms) for q in scenes.sources])
    served = whole if whole.any() else served
    v = scenes.v.double().numpy()
    for profile in (*range(len(scenes.sources)), None):
        if profile is None:
            weight = scenes.weight * (served / scenes.source_sizes)[scenes.source]
            shows = scenes.shows[served > 0].any(0)
        else:
            weight, shows = scenes.weight * (scenes.source == profile), scenes.shows[profile]
        share = weight.double().numpy() / float(weight.double().sum())
        yield Population(profile, share, scenes.room.numpy(), shows.numpy(), share @ v)


class LongChains:
    """Gibbs chains that start at the scenes of a population, and continue from call to call.

    Each chain keeps the room type of its scene.

    Args:
        chains: chains of the machine; see `scene_chains`.
        count: number of chains.
    """

    def __init__(
        self,
        chains: SceneChains,
        scenes: ObjectScenes,
        population: Population,
        count: int,
        seed: int,
    ) -> None:
        index = population.draw(count, np.random.default_rng(seed))
        self.on = scenes.v[index].numpy().astype(np.uint8)
        self._chains, self._profile = chains, population.profile
        self.rooms = population.room[index]
        self._streams = [random_stream(seed, k) for k in range(count)]

    def run(self, sweeps: int, every: int = RECORDED) -> Floats:
        """Run sweeps of each chain, and record the presence of the classes every ``every`` sweeps.

        The number of sweeps is rounded up to a multiple of ``every``.

        Returns:
            The share of the records in which each class is present, (chains, classes).
        """
        count = np.zeros(self.on.shape)  # number of records with each class
        records = range(0, sweeps, every)
        conditioned = {
            room: self._chains.under(conditions_of(None if room < 0 else room, self._profile))
            for room in np.unique(self.rooms).tolist()
        }

        def run_chain(k: int) -> None:
            for _ in records:
                conditioned[int(self.rooms[k])].sweep(self.on[k], every, self._streams[k])
                count[k] += self.on[k]

        in_threads(run_chain, len(count))
        share: Floats = count / len(records)
        return share


def in_threads(run: Callable[[int], T], count: int) -> list[T]:
    """Return the results of `run` for 0 to count - 1. The sweeps of chains use every core."""
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        return list(threads.map(run, range(count)))


def conditions_of(room: int | None, profile: int | None = None) -> Conditions:
    """Return the conditions of chains without listed objects."""
    return Conditions(np.zeros(0, np.int64), None, room, profile)


def scene_chains(weights: Weights) -> SceneChains:
    """Return the chains of a machine without its stored samples."""
    samples = ("fantasies", "fantasy_rooms")
    arrays = {name: array for name, array in weights.arrays.items() if name not in samples}
    return SceneChains(Weights(replace(weights.spec, N=0), arrays))


@dataclass(frozen=True)
class Drift:
    """How far long chains are from the scenes of the served mix of data sources.

    Attributes:
        size, size_error: relative change of the number of classes in a scene, and its standard
            error.
        label: the class among the 50 commonest whose share of the scenes changes most.
        share, share_error: relative change of this share, and its standard error.
    """

    size: float
    size_error: float
    label: str
    share: float
    share_error: float

    def metrics(self) -> list[Metric]:
        """Return the metrics for the model card, with intervals of two standard errors."""
        values = (
            ("change of the number of classes", self.size, self.size_error),
            ("largest change of a class", self.share, self.share_error),
        )
        return [
            Metric(
                task="Long chains", source=_MIX, metric=name, value=round(value, 4),
                low=round(value - 2 * error, 4), high=round(value + 2 * error, 4), n=_CHAINS,
            )
            for name, value, error in values
        ]  # fmt: skip

    def objection(self) -> str | None:
        """Return why samples of the model are unlike the scenes, or None."""
        after = f"after {_SWEEPS} sweeps,"
        if abs(self.size) - _CERTAIN * self.size_error > _SIZE_LIMIT:
            scenes = f"generated scenes have {self.size:+.0%} classes"
            return f"{after} {scenes}; at most {_SIZE_LIMIT:.0%} are allowed"
        if abs(self.share) - _CERTAIN * self.share_error > _SHARE_LIMIT:
            scenes = f"{self.share:+.0%} generated scenes have the class"
            return f"{after} {scenes} {self.label}; at most {_SHARE_LIMIT:.0%} are allowed"
        return None


def measure_drift(artifact: SceneModel, scenes: ObjectScenes, config: ObjectsConfig) -> Drift:
    """Run 3,000 sweeps from training scenes of the served mix, and compare chains and scenes.

    The states of the last 1,000 sweeps count if the filter of `/generate` accepts them
    (`accepted`).
    """
    *_, population = populations(scenes, config)
    long = LongChains(scene_chains(artifact.weights), scenes, population, _CHAINS, seed=1)
    long.run(_SETTLED, every=_SETTLED)
    drawn = accepted(artifact, long, (_SWEEPS - _SETTLED) // STEPS)
    sizes = drawn[:, population.shows].sum(1) / population.p[population.shows].sum()
    top = np.argsort(-np.where(population.shows, population.p, 0))[:_COMMONEST]
    top = top[population.p[top] > 0]
    change = drawn[:, top] / population.p[top] - 1
    share, error = change.mean(0), change.std(0) / np.sqrt(_CHAINS)
    # The class that is most certainly beyond the limit.
    k = int(np.argmax(np.abs(share) - _CERTAIN * error))
    size, size_error = float(sizes.mean() - 1), float(sizes.std() / np.sqrt(_CHAINS))
    label = artifact.vocabulary.labels[top[k]]
    return Drift(size, size_error, label, float(share[k]), float(error[k]))


def accepted(artifact: SceneModel, long: LongChains, states: int) -> Floats:
    """Continue the chains, and return the share of the served scenes with each class.

    A state is recorded every `STEPS` sweeps, the length of a draw of `/generate`. A served scene is
    the first plausible one of `ATTEMPTS` states, or the last of them.

    Args:
        states: number of recorded states of each chain, at least `ATTEMPTS`.

    Returns:
        The share of each class in the served scenes of each chain, (chains, classes).
    """
    evidence = Scene(())
    count, served = np.zeros(long.on.shape), np.zeros(len(long.on))
    refused = np.zeros(len(long.on), np.int64)  # states since the last served scene

    def accepts(k: int) -> bool:
        room = None if long.rooms[k] < 0 else int(long.rooms[k])
        return is_plausible(artifact, evidence, np.flatnonzero(long.on[k]), room)

    for _ in range(states):
        long.run(STEPS, every=STEPS)
        refused += 1
        taken = np.array(in_threads(accepts, len(long.on))) | (refused == ATTEMPTS)
        count[taken] += long.on[taken]
        served[taken] += 1
        refused[taken] = 0
    share: Floats = count / served[:, None]
    return share
