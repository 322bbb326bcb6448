"""The Boltzmann machines: energies, conditionals, expectations, samplers. Tensors only.

Symbols are those of the project's model page: v, r, h1, h2; b, c1, c2, W, J; d, s, o, S, O, R, M,
U.
"""

from __future__ import annotations

from app.boltzmann.gbm import GBM
from app.boltzmann.machine import BoltzmannMachine
from app.boltzmann.product_rbm import ProductRBM
from app.boltzmann.rbm import RBM
from app.boltzmann.spec import MachineSpec
from app.boltzmann.triway import Triway

VARIANTS: dict[str, type[BoltzmannMachine]] = {
    "rbm": RBM,
    "gbm": GBM,
    "triway": Triway,
    "product_rbm": ProductRBM,
}


def build(spec: MachineSpec) -> BoltzmannMachine:
    """A machine of the given shape with all weights zero."""
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
