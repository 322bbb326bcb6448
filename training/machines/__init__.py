"""The Boltzmann machines: energies, conditionals, expectations and samplers, on tensors only.

The page docs/models.md defines the symbols. Units: v objects, r relations, h1 hidden units.
Weights: b, c1 and W of objects and hidden units; d, s, o, S, O, R, M and U of relations.
Sizes: B scenes, V object classes, A relations, E relation units, H1 entries of h1.
"""

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
