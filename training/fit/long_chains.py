"""Long Gibbs chains that start at scenes: they fit base rates, give samples, and test the machine.

The loss of the objects fits answers, and samples only in part (`training.fit.objects`). So the
weights u, which only Gibbs chains use, are fitted afterwards. They are the solution of

    p(v_i = 1) in the chains of source q = p(v_i = 1) in the scenes of source q

for each class i, by stochastic approximation with persistent chains from the scenes of the source.
The last row of u belongs to the served mix. A class that a source cannot show has u = 0 there.

The stored samples are states of long chains, where new chains start. A chain from an empty scene
needs thousands of sweeps, because scenes between two room types are improbable.

If chains drift away from the scenes, samples of `/generate` are good only while chains are short.
So a test measures whether served scenes stay like the scenes where the chains started.

Source: Robbins and Monro, "A stochastic approximation method" (1951).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.special import logit

from app.inference.chains import Bits, Conditions, SceneChains, random_stream
from app.inference.weights import Weights, pack_scenes
from app.model import SceneModel
from app.questions.generate import ATTEMPTS, STEPS, is_plausible
from app.registry import Metric
from app.scene import Scene
from training.datasets.array_types import ClassMask
from training.datasets.sources import source_of
from training.fit.configuration import ObjectsConfig
from training.fit.objects import ObjectScenes, served_weights
from training.machines import BoltzmannMachine, weights_of

T = TypeVar("T")

RECORDED: Final = 5  # number of sweeps between two recorded states

_SAMPLE_SWEEPS = 200  # sweeps of a stored sample
_SOURCE_CHAINS = 64  # chains of each data source in the fit of u
_ROUNDS = 50
_ROUND_SWEEPS = 20  # of the chains of a source; those of the served mix: `served_sweeps`
_FIRST_STEP, _LAST_STEP = 0.7, 0.1  # of u, as a share of the difference of log-odds

_CHAINS, _SWEEPS = 256, 3000  # of the test
_SETTLED = 2000  # sweeps before the first recorded state of the test
_COMMONEST = 50
_SIZE_LIMIT, _SHARE_LIMIT = 0.10, 0.20
_MIX: Final = "served mix"
_STANDARD_ERRORS = 3.0  # beyond a limit, for a significant violation


@dataclass(frozen=True, eq=False)
class Population:
    """The N scenes that the chains of one row of u should draw."""

    profile: int | None  # index of the data source, or None for the served mix
    weight: Float[NDArray, "N"]  # of each scene; the sum is 1
    room: Int[NDArray, "N"]  # room type; -1 means unknown
    shows: ClassMask  # classes that the scenes can show
    p: Float[NDArray, "V"]  # share of the scenes with each class

    def draw(self, count: int, rng: np.random.Generator) -> Int[NDArray, "count"]:
        """Return indices drawn by weight, systematically: room types keep their shares."""
        order = np.lexsort((rng.random(len(self.room)), self.room))
        position = (np.arange(count) + rng.random()) / count
        return order[np.searchsorted(self.weight[order].cumsum()[:-1], position)]


def populations(scenes: ObjectScenes, config: ObjectsConfig) -> Iterator[Population]:
    """Yield the population of each data source, and that of the served mix."""
    served = served_weights(scenes, config)
    served = served if served.any() else torch.ones_like(served)
    # Lists of photographs and sentences are parts of rooms: whole rooms come first.
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
    """Gibbs chains that start at scenes of a population, and keep their room types."""

    def __init__(
        self,
        chains: SceneChains,
        scenes: ObjectScenes,
        population: Population,
        count: int,
        seed: int,
    ) -> None:
        """Start `count` chains at scenes drawn from the population."""
        index = population.draw(count, np.random.default_rng(seed))
        self.on = scenes.v[index].numpy().astype(np.uint8)
        self._chains, self._profile = chains, population.profile
        self.rooms = population.room[index]
        self._streams = [random_stream(seed, k) for k in range(count)]

    def run(self, sweeps: int, every: int = RECORDED) -> Float[NDArray, "chains V"]:
        """Run sweeps, and return the share of each class in the states recorded by `every`."""
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
        return count / len(records)


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
    """Relative changes from the scenes of the served mix of data sources to long chains."""

    size: float  # change of the number of classes in a scene
    size_error: float  # standard error
    label: str  # the class among the 50 commonest whose share of the scenes changes most
    share: float  # change of this share
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
        if abs(self.size) - _STANDARD_ERRORS * self.size_error > _SIZE_LIMIT:
            scenes = f"generated scenes have {self.size:+.0%} classes"
            return f"{after} {scenes}; at most {_SIZE_LIMIT:.0%} are allowed"
        if abs(self.share) - _STANDARD_ERRORS * self.share_error > _SHARE_LIMIT:
            scenes = f"{self.share:+.0%} generated scenes have the class"
            return f"{after} {scenes} {self.label}; at most {_SHARE_LIMIT:.0%} are allowed"
        return None


def measure_drift(artifact: SceneModel, scenes: ObjectScenes, config: ObjectsConfig) -> Drift:
    """Run 3,000 sweeps from scenes of the served mix, and compare the last 1,000 with them."""
    *_, population = populations(scenes, config)
    long = LongChains(scene_chains(artifact.weights), scenes, population, _CHAINS, seed=1)
    long.run(_SETTLED, every=_SETTLED)
    drawn = served_frequencies(artifact, long, (_SWEEPS - _SETTLED) // STEPS)
    sizes = drawn[:, population.shows].sum(1) / population.p[population.shows].sum()
    top = np.argsort(-np.where(population.shows, population.p, 0))[:_COMMONEST]
    top = top[population.p[top] > 0]
    change = drawn[:, top] / population.p[top] - 1
    share, error = change.mean(0), change.std(0) / np.sqrt(_CHAINS)
    # The class with the most significant violation of the limit.
    k = int(np.argmax(np.abs(share) - _STANDARD_ERRORS * error))
    size, size_error = float(sizes.mean() - 1), float(sizes.std() / np.sqrt(_CHAINS))
    label = artifact.vocabulary.labels[top[k]]
    return Drift(size, size_error, label, float(share[k]), float(error[k]))


def served_frequencies(
    artifact: SceneModel, long: LongChains, states: int
) -> Float[NDArray, "chains V"]:
    """Continue the chains. Return the share of each class in the served scenes of each chain."""
    evidence = Scene(())
    count, served = np.zeros(long.on.shape), np.zeros(len(long.on))
    refused = np.zeros(len(long.on), np.int64)  # states since the last served scene

    def accepts(k: int) -> bool:
        """Return True if the service would answer with the state of chain k."""
        room = None if long.rooms[k] < 0 else int(long.rooms[k])
        return is_plausible(artifact, evidence, np.flatnonzero(long.on[k]), room)

    for _ in range(states):
        long.run(STEPS, every=STEPS)
        refused += 1
        # The first plausible one of `ATTEMPTS` states is served, or the last of them.
        taken = np.array(in_threads(accepts, len(long.on))) | (refused == ATTEMPTS)
        count[taken] += long.on[taken]
        served[taken] += 1
        refused[taken] = 0
    return count / served[:, None]


def fit_scene_rates(
    machine: BoltzmannMachine, scenes: ObjectScenes, config: ObjectsConfig, seed: int
) -> None:
    """Fit the weights u of the machine, in place."""
    chains = scene_chains(weights_of(machine))
    u = chains.machine["u"]
    for row, population in enumerate(populations(scenes, config)):
        long = LongChains(chains, scenes, population, _SOURCE_CHAINS, seed)
        sweeps = _ROUND_SWEEPS if population.profile is not None else config.served_sweeps
        average = np.zeros(u.shape[1])
        for number in range(_ROUNDS):
            drawn = long.run(sweeps).mean(0)
            # Steps fall geometrically. u is the average over the second half of the rounds.
            step = _FIRST_STEP * (_LAST_STEP / _FIRST_STEP) ** (number / (_ROUNDS - 1))
            change = step * (_log_odds(population.p, sweeps) - _log_odds(drawn, sweeps))
            u[row] += np.where(population.shows, np.clip(change, -1, 1), 0)
            if number >= _ROUNDS / 2:
                average += u[row] / (_ROUNDS - _ROUNDS // 2)
        u[row] = average
    machine.u.copy_(torch.from_numpy(u))


def _log_odds(p: Float[NDArray, "V"], sweeps: int) -> Float[NDArray, "V"]:
    """Return the log-odds of shares of the states in a round, with half a state added."""
    states = _SOURCE_CHAINS * sweeps / RECORDED / 2  # neighbouring states are similar
    return logit((p * states + 0.5) / (states + 1))


def store_samples(machine: BoltzmannMachine, scenes: ObjectScenes, seed: int) -> None:
    """Store N states of chains from training scenes, drawn by weight, in the machine."""
    if not machine.spec.N:
        return
    index = scenes.draw(machine.spec.N, torch.Generator().manual_seed(seed))
    chains = scene_chains(weights_of(machine))
    v, rooms = scenes.v[index].numpy(), scenes.room[index].numpy()

    def sample(k: int) -> Bits:
        room = None if rooms[k] < 0 else int(rooms[k])
        return chains.continued(v[k], room, _SAMPLE_SWEEPS, random_stream(seed, k))

    samples = in_threads(sample, len(v))
    machine.fantasies.copy_(torch.from_numpy(pack_scenes(np.stack(samples))))
    machine.fantasy_rooms.copy_(torch.from_numpy(rooms.astype(np.int32)))
