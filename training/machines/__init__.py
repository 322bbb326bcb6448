"""The Boltzmann machines: energies, conditionals, expectations and samplers, on tensors only.

The symbols are those of the project's model page: v, r, h1, h2; b, c1, c2, W, J; d, s, o, S, O, R,
M, U.
"""

from __future__ import annotations

from app.inference.variants import MachineSpec
from training.machines.gbm import GBM
from training.machines.machine import BoltzmannMachine
from training.machines.product_rbm import ProductRBM
from training.machines.rbm import RBM
from training.machines.triway import Triway

VARIANTS: dict[str, type[BoltzmannMachine]] = {
    "rbm": RBM,
    "gbm": GBM,
    "triway": Triway,
    "product_rbm": ProductRBM,
}


def build(spec: MachineSpec) -> BoltzmannMachine:
    """Return a machine of the given shape with all weights zero."""
    return VARIANTS[spec.variant](spec)


__all__ = [
    "GBM",
    "RBM",
    "VARIANTS",
    "BoltzmannMachine",
    "MachineSpec",
    "ProductRBM",
    "Triway",
    "build",
]
