"""Store samples of a trained machine: the states of long Gibbs chains, where new chains start.

A chain that starts with an empty scene needs thousands of sweeps to visit all room types, because
scenes between two room types are improbable.
"""

from __future__ import annotations

import numpy as np
import torch

from app.inference.chains import SceneChains, random_stream
from app.inference.weights import pack_scenes
from training.fit.objects import ObjectScenes
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of

_SWEEPS = 200


def store_samples(machine: BoltzmannMachine, scenes: ObjectScenes, seed: int) -> None:
    """Store N samples in the machine, in place.

    Each chain starts at a training scene, with the served base rates, and keeps the room type of
    that scene. Scenes are drawn in proportion to their weights.
    """
    if not machine.spec.N:
        return
    generator = torch.Generator().manual_seed(seed)
    index = scenes.draw(machine.spec.N, generator)
    chains = SceneChains(weights_of(machine))
    v, rooms = scenes.v[index].numpy(), scenes.room[index].numpy()
    samples = [
        chains.continued(present, None if room < 0 else int(room), _SWEEPS, random_stream(seed, k))
        for k, (present, room) in enumerate(zip(v, rooms, strict=True))
    ]
    machine.fantasies.copy_(torch.from_numpy(pack_scenes(np.stack(samples))))
    machine.fantasy_rooms.copy_(torch.from_numpy(rooms.astype(np.int32)))
