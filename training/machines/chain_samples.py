"""Starting states of Gibbs chains: stored samples of the machine's own long chains.

A Gibbs chain that starts with an empty scene needs thousands of sweeps to visit all room types,
because scenes between two room types are improbable. A trained machine therefore stores N samples
of its chains, each with a room type. The model file stores the samples as `fantasies` and their
room types as `fantasy_rooms`. A new chain starts at one of these samples.

A start sample is drawn with probability proportional to its weight w given the evidence:

    log w = sum_{i observed} log p(v_i = 1 | h1) + sum_{k clamped} log p(h1_k = 1)
            - 6 [the room type of the sample differs from the requested room type t].

Here h1 is the mean of the hidden units given the sample. The method is sampling importance
resampling, followed by Gibbs sweeps. If no sample has room type t, the last term is h1·Q[t]. Q
contains the bias of the hidden units for each room type. The last term is needed because a few
sweeps rarely change the room type of a scene.

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
from training.machines.gibbs import FREE, Clamp, bare_state, initial_state
from training.machines.machine import BoltzmannMachine, State
from training.machines.mean_field import Evidence, mean_field


def words(classes: int) -> int:
    """Return the number of 32-bit words that store one bit for each of `classes` classes."""
    return -(-classes // weights.WORD)


def pack_scenes(v: Tensor) -> Tensor:
    """Pack the presence of objects, (scenes, classes), into bits, (scenes, words) int32."""
    bits = np.zeros((len(v), words(v.shape[1]) * weights.WORD), dtype=np.uint8)
    bits[:, : v.shape[1]] = v.numpy() > 0
    packed = np.packbits(bits, axis=1, bitorder="little").view("<i4").astype(np.int32)
    return torch.from_numpy(packed)


def unpack_scenes(packed: Tensor, classes: int) -> Tensor:
    """Unpack bits to the presence of objects, (scenes, classes) floats."""
    return torch.from_numpy(weights.unpack_scenes(packed.numpy(), classes))


class ChainSamples:
    """The stored samples of a machine, from which new Gibbs chains start.

    Args:
        machine: trained machine. Later changes of its weights have no effect on this object.
    """

    def __init__(self, machine: BoltzmannMachine) -> None:
        self.machine = machine
        if not machine.spec.N:
            return
        with torch.no_grad():
            self.v = unpack_scenes(machine.fantasies, machine.spec.V).to(machine.b.dtype)
            field = mean_field(machine, Evidence(self.v))
            self.h1, self.h2 = field.y.sigmoid(), field.h2
            # The terms of log w: for observed classes, room types and clamped hidden units. Each
            # array has one row for each stored sample.
            self._present = logsigmoid(machine.object_logits(self.h1))
            self._room = self.h1 @ machine.Q.T
            self._unit = logsigmoid(field.y)

    @torch.no_grad()
    def start(self, observed: Tensor, generator: torch.Generator, clamp: Clamp = FREE) -> State:
        """Return the start state of each chain: a stored sample, drawn by its weight.

        If the machine stores no samples, each chain starts at the observed objects.

        Args:
            observed: observed objects, (chains, classes). 1 means that the class must be present.
            clamp: room types and clamped hidden units. They also enter the weights.
        """
        machine = self.machine
        if not machine.spec.N:
            return _apply_clamp(initial_state(machine, observed, generator, clamp), clamp)
        weight = self.log_weight(observed, clamp)
        index = torch.multinomial(weight.softmax(1), 1, generator=generator).squeeze(1)
        h1, h2 = bernoulli(self.h1[index], generator), bernoulli(self.h2[index], generator)
        return _apply_clamp(bare_state(machine, self.v[index].maximum(observed), h1, h2), clamp)

    def log_weight(self, observed: Tensor, clamp: Clamp = FREE) -> Tensor:
        """Return the log weight log w of each stored sample for each chain, (chains, samples)."""
        weight = observed @ self._present.T
        if clamp.room is not None and self.machine.spec.C:
            has_room = (clamp.room >= 0).to(observed.dtype).unsqueeze(1)
            in_room = self.machine.fantasy_rooms == clamp.room.unsqueeze(1)
            hint = self._room.T[clamp.room.clamp(min=0)]
            hint = torch.where(in_room.any(1, keepdim=True), -float(OTHER_ROOM) * ~in_room, hint)
            weight = weight + has_room * hint
        if clamp.h1 is not None:
            weight = weight + clamp.h1.to(observed.dtype) @ self._unit.T
        return weight


def _apply_clamp(state: State, clamp: Clamp) -> State:
    """Return the state with the clamped hidden units set to 1."""
    h1 = state.h1 if clamp.h1 is None else torch.where(clamp.h1, 1.0, state.h1)
    h2 = state.h2 if clamp.h2 is None else torch.where(clamp.h2, 1.0, state.h2)
    return replace(state, h1=h1, h2=h2)
