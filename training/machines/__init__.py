"""The Boltzmann machines on tensors: energies, conditionals, samplers (symbols: docs/models.md)."""

from __future__ import annotations

from app.inference.variants import MachineSpec
from training.machines.machine import BoltzmannMachine
from training.machines.rbm import GBM, RBM
from training.machines.triway import Triway

VARIANTS: dict[str, type[BoltzmannMachine]] = {"rbm": RBM, "gbm": GBM, "triway": Triway}


def build(spec: MachineSpec) -> BoltzmannMachine:
    """Return a machine with the sizes in `spec`. All its weights are zero."""
    return VARIANTS[spec.variant](spec)


__all__ = ["GBM", "RBM", "VARIANTS", "BoltzmannMachine", "MachineSpec", "Triway", "build"]
