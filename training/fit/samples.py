"""Fit the base rates of whole scenes, and store samples of a trained machine.

The loss of the objects fits the answers for random parts of scenes. It fits samples only in part
(`training.fit.objects`). So the weights u, which only Gibbs chains use, are fitted afterwards. They
are the solution of

    p(v_i = 1) in the chains of source q = p(v_i = 1) in the scenes of source q

for each class i, by stochastic approximation with persistent chains. The chains start at the scenes
of the source, and keep the room type of their scene, as `/generate` does. The last row of u belongs
to the served mix of sources. A class that a source cannot show has u = 0 there.

The stored samples are the states of long Gibbs chains, where new chains start. A chain that starts
with an empty scene needs thousands of sweeps to visit all room types, because scenes between two
room types are improbable.

Source: Robbins and Monro, "A stochastic approximation method" (1951).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import logit

from app.inference.chains import Bits, Conditions, SceneChains, random_stream
from app.inference.weights import Weights, pack_scenes
from training.datasets.array_types import Flags, Floats, Ints
from training.fit.configuration import ObjectsConfig
from training.fit.objects import ObjectScenes, served_weights
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of

_SWEEPS = 200  # sweeps of a stored sample
_CHAINS = 128  # chains of each data source in the fit of u
_ROUNDS = 60
_ROUND_SWEEPS = 25
_RECORDED = 5  # sweeps between two recorded states
_FIRST_STEP, _LAST_STEP = 0.7, 0.1  # of u, as a share of the difference of log-odds


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
    """Yield the population of each data source, and that of the served mix."""
    served = served_weights(scenes, config)
    by_source = served / scenes.source_sizes
    mixed = scenes.weight * by_source[scenes.source]
    v = scenes.v.double().numpy()
    for profile in (*range(len(scenes.sources)), None):
        weight, shows = mixed, (scenes.shows & (served > 0).unsqueeze(1)).any(0)
        if profile is not None:
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
        self._rooms = population.room[index]
        self._h2: list[Bits | None] = [None] * count
        self._streams = [random_stream(seed, k) for k in range(count)]

    def run(self, sweeps: int) -> Floats:
        """Make sweeps; return the share of the recorded states with each class, (classes,)."""
        none = np.zeros(0, np.int64)
        alone = none, np.zeros(0, np.float32), None, none.reshape(0, 2), none
        total = np.zeros(self.on.shape[1])
        for room in np.unique(self._rooms).tolist():
            conditions = Conditions(*alone, None if room < 0 else room, self._profile)
            conditioned = self._chains.under(conditions)
            for k in np.flatnonzero(self._rooms == room).tolist():
                for _ in range(0, sweeps, _RECORDED):
                    state = self.on[k], _RECORDED, self._streams[k], self._h2[k]
                    _, self._h2[k] = conditioned.sweep(*state)
                    total += self.on[k]
        share: Floats = total / (len(self.on) * -(-sweeps // _RECORDED))
        return share


def scene_chains(weights: Weights) -> SceneChains:
    """Return the chains of a machine without its stored samples."""
    samples = ("fantasies", "fantasy_rooms")
    arrays = {name: array for name, array in weights.arrays.items() if name not in samples}
    return SceneChains(Weights(replace(weights.spec, N=0), arrays))


def fit_scene_rates(
    machine: BoltzmannMachine, scenes: ObjectScenes, config: ObjectsConfig, seed: int
) -> None:
    """Fit the weights u of the machine, in place."""
    chains = scene_chains(weights_of(machine))
    u = chains.machine["u"]
    for row, population in enumerate(populations(scenes, config)):
        long = LongChains(chains, scenes, population, _CHAINS, seed)
        average = np.zeros(u.shape[1])
        for number in range(_ROUNDS):
            drawn = long.run(_ROUND_SWEEPS)
            step = _FIRST_STEP * (_LAST_STEP / _FIRST_STEP) ** (number / (_ROUNDS - 1))
            change = step * (_log_odds(population.p) - _log_odds(drawn))
            u[row] += np.where(population.shows, np.clip(change, -1, 1), 0)
            if number >= _ROUNDS / 2:
                average += u[row] / (_ROUNDS - _ROUNDS // 2)
        u[row] = average
    machine.u.copy_(torch.from_numpy(u))


def _log_odds(p: Floats) -> Floats:
    """Return the log-odds of shares of the states in a round, with half a state added."""
    states = _CHAINS * _ROUND_SWEEPS / _RECORDED / 2  # neighbouring states are similar
    log_odds: Floats = logit((p * states + 0.5) / (states + 1))
    return log_odds


def store_samples(machine: BoltzmannMachine, scenes: ObjectScenes, seed: int) -> None:
    """Store N samples in the machine, in place.

    Each chain starts at a training scene, with the served base rates, and keeps the room type of
    that scene. Scenes are drawn in proportion to their weights.
    """
    if not machine.spec.N:
        return
    generator = torch.Generator().manual_seed(seed)
    index = scenes.draw(machine.spec.N, generator)
    chains = scene_chains(weights_of(machine))
    v, rooms = scenes.v[index].numpy(), scenes.room[index].numpy()
    samples = [
        chains.continued(present, None if room < 0 else int(room), _SWEEPS, random_stream(seed, k))
        for k, (present, room) in enumerate(zip(v, rooms, strict=True))
    ]
    machine.fantasies.copy_(torch.from_numpy(pack_scenes(np.stack(samples))))
    machine.fantasy_rooms.copy_(torch.from_numpy(rooms.astype(np.int32)))
