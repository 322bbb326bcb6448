"""Convert a torch machine to the numpy arrays of the service, and back."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from app.inference import Weights
from app.inference.weights import layout
from training.machines import BoltzmannMachine, build


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
