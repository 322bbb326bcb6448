"""Starting states of Gibbs chains: stored samples of the machine's own long chains.

A chain with an empty start needs thousands of sweeps to reach all kinds of rooms, because scenes
between two kinds are improbable. A trained machine therefore stores N chain samples, each with its
room type. The artifact names them `fantasies` and `fantasy_rooms`. A new chain continues from one
of the samples.

With evidence, each chain draws its sample by the weight w:

    log w = sum_{i observed} log p(v_i = 1 | h1) + sum_{k held} log p(h1_k = 1)
            - 6 [drawn under another room type than t],

where h1 is at its mean given the sample. This is sampling importance resampling, followed by
sweeps. If no sample was drawn under t, the last term is h1·Q[t]. The term is needed because a few
sweeps do not lead from one kind of room to another, whatever Q is.

Sources: Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008), for
fantasy particles; Gordon, Salmond and Smith, "Novel approach to nonlinear/non-Gaussian Bayesian
state estimation" (1993), for resampling and moving.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from app.inference import weights
from app.inference.chains import OTHER_ROOM
from training.machines.bernoulli import bernoulli
from training.machines.gibbs import FREE, Clamp, State, bare_state, initial_state
from training.machines.machine import BoltzmannMachine
from training.machines.mean_field import Evidence, mean_field


def words(classes: int) -> int:
    """Return the number of 32-bit words for a scene over `classes` classes."""
    return -(-classes // weights.WORD)


def pack_scenes(v: Tensor) -> Tensor:
    """Return presence (N, V) packed into bits, (N, words) int32."""
    bits = np.zeros((len(v), words(v.shape[1]) * weights.WORD), dtype=np.uint8)
    bits[:, : v.shape[1]] = v.numpy() > 0
    packed = np.packbits(bits, axis=1, bitorder="little").view("<i4").astype(np.int32)
    return torch.from_numpy(packed)


def unpack_scenes(packed: Tensor, classes: int) -> Tensor:
    """Return presence (N, V) as floats from packed bits."""
    return torch.from_numpy(weights.unpack_scenes(packed.numpy(), classes))


class ChainSamples:
    """The stored samples of a machine, with weights given the evidence.

    Args:
        machine: a machine with fixed weights; its weights are read at construction only.
    """

    def __init__(self, machine: BoltzmannMachine) -> None:
        self.machine = machine
        if not machine.spec.N:
            return
        with torch.no_grad():
            self.v = unpack_scenes(machine.fantasies, machine.spec.V).to(machine.b.dtype)
            field = mean_field(machine, Evidence(self.v))
            self.h1, self.h2 = field.y.sigmoid(), field.h2
            # Terms of log w for each given class, room type and held unit; one row for each sample.
            self._present = logsigmoid(machine.object_logits(self.h1))
            self._room = self.h1 @ machine.Q.T
            self._unit = logsigmoid(field.y)

    @torch.no_grad()
    def start(self, given: Tensor, generator: torch.Generator, clamp: Clamp = FREE) -> State:
        """Return a state for each chain: a sample drawn by its weight given the evidence.

        Without stored samples, the chains start at the evidence.

        Args:
            given: (B, V), 1 for classes that must be present.
            clamp: room types and held units, which are also evidence; see `Clamp`.
        """
        machine = self.machine
        if not machine.spec.N:
            return _held(initial_state(machine, given, generator, clamp), clamp)
        weight = self.log_weight(given, clamp)
        chosen = torch.multinomial(weight.softmax(1), 1, generator=generator).squeeze(1)
        h1, h2 = bernoulli(self.h1[chosen], generator), bernoulli(self.h2[chosen], generator)
        return _held(bare_state(machine, self.v[chosen].maximum(given), h1, h2), clamp)

    def log_weight(self, given: Tensor, clamp: Clamp = FREE) -> Tensor:
        """Return log w of every sample, (B, N); see the module."""
        weight = given @ self._present.T
        if clamp.room is not None and self.machine.spec.C:
            known = (clamp.room >= 0).to(given.dtype).unsqueeze(1)
            own = self.machine.fantasy_rooms == clamp.room.unsqueeze(1)
            hint = self._room.T[clamp.room.clamp(min=0)]
            hint = torch.where(own.any(1, keepdim=True), -float(OTHER_ROOM) * ~own, hint)
            weight = weight + known * hint
        if clamp.h1 is not None:
            weight = weight + clamp.h1.to(given.dtype) @ self._unit.T
        return weight


def _held(state: State, clamp: Clamp) -> State:
    """Return the state with the held units on."""
    h1 = state.h1 if clamp.h1 is None else torch.where(clamp.h1, 1.0, state.h1)
    h2 = state.h2 if clamp.h2 is None else torch.where(clamp.h2, 1.0, state.h2)
    return replace(state, h1=h1, h2=h2)
