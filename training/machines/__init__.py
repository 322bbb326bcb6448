"""The Boltzmann machines on tensors: energies, conditionals, samplers (symbols: docs/models.md)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from app.inference.variants import MachineSpec
from app.inference.weights import Weights, layout
from training.machines.machine import BoltzmannMachine
from training.machines.rbm import GBM, RBM
from training.machines.triway import Triway

VARIANTS: dict[str, type[BoltzmannMachine]] = {"rbm": RBM, "gbm": GBM, "triway": Triway}

__all__ = [
    "GBM",
    "RBM",
    "VARIANTS",
    "BoltzmannMachine",
    "MachineSpec",
    "Triway",
    "build",
    "machine_of",
    "weights_of",
]


def build(spec: MachineSpec) -> BoltzmannMachine:
    """Return a machine with the sizes in `spec`. All its weights are zero."""
    return VARIANTS[spec.variant](spec)


def weights_of(machine: BoltzmannMachine) -> Weights:
    """Return copies of the machine's tensors, with shared weights summed."""
    arrays = {
        name: np.array(getattr(machine, name).detach().numpy(), order="C")
        for name in layout(machine.spec)
    }
    return Weights(machine.spec, arrays)


@lru_cache(maxsize=16)
def machine_of(weights: Weights) -> BoltzmannMachine:
    """Return the machine with these weights. Both share memory, so do not change the machine."""
    with torch.device("meta"):
        machine = build(weights.spec)
    state = {name: torch.from_numpy(array) for name, array in weights.arrays.items()}
    machine.load_state_dict(state, assign=True)
    return machine.eval().requires_grad_(False)
