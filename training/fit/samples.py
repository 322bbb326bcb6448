"""Fit the base rates of whole scenes, and store samples of a trained machine.

The loss of the objects fits answers, and samples only in part (`training.fit.objects`). So the
weights u, which only Gibbs chains use, are fitted afterwards. They are the solution of

    p(v_i = 1) in the chains of source q = p(v_i = 1) in the scenes of source q

for each class i, by stochastic approximation with persistent chains from the scenes of the source.
The last row of u belongs to the served mix. A class that a source cannot show has u = 0 there.

The stored samples are states of long chains, where new chains start. A chain from an empty scene
needs thousands of sweeps, because scenes between two room types are improbable.

Source: Robbins and Monro, "A stochastic approximation method" (1951).
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.special import logit

from app.inference.chains import Bits, random_stream
from app.inference.weights import pack_scenes
from training.fit.configuration import ObjectsConfig
from training.fit.long_chains import RECORDED, LongChains, in_threads, populations, scene_chains
from training.fit.objects import ObjectScenes
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of

_SWEEPS = 200  # sweeps of a stored sample
_CHAINS = 64  # chains of each data source in the fit of u
_ROUNDS = 50
_ROUND_SWEEPS = 20  # of the chains of a source; those of the served mix: `served_sweeps`
_FIRST_STEP, _LAST_STEP = 0.7, 0.1  # of u, as a share of the difference of log-odds


def fit_scene_rates(
    machine: BoltzmannMachine, scenes: ObjectScenes, config: ObjectsConfig, seed: int
) -> None:
    """Fit the weights u of the machine, in place."""
    chains = scene_chains(weights_of(machine))
    u = chains.machine["u"]
    for row, population in enumerate(populations(scenes, config)):
        long = LongChains(chains, scenes, population, _CHAINS, seed)
        sweeps = _ROUND_SWEEPS if population.profile is not None else config.served_sweeps
        average = np.zeros(u.shape[1])
        for number in range(_ROUNDS):
            drawn = long.run(sweeps).mean(0)
            step = _FIRST_STEP * (_LAST_STEP / _FIRST_STEP) ** (number / (_ROUNDS - 1))
            change = step * (_log_odds(population.p, sweeps) - _log_odds(drawn, sweeps))
            u[row] += np.where(population.shows, np.clip(change, -1, 1), 0)
            if number >= _ROUNDS / 2:
                average += u[row] / (_ROUNDS - _ROUNDS // 2)
        u[row] = average
    machine.u.copy_(torch.from_numpy(u))


def _log_odds(p: Float[NDArray, "V"], sweeps: int) -> Float[NDArray, "V"]:
    """Return the log-odds of shares of the states in a round, with half a state added."""
    states = _CHAINS * sweeps / RECORDED / 2  # neighbouring states are similar
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
        return chains.continued(v[k], room, _SWEEPS, random_stream(seed, k))

    samples = in_threads(sample, len(v))
    machine.fantasies.copy_(torch.from_numpy(pack_scenes(np.stack(samples))))
    machine.fantasy_rooms.copy_(torch.from_numpy(rooms.astype(np.int32)))
