"""Inference with a trained machine. Functions take arrays and return arrays.

docs/models.md defines the units (v, r, h1, h2) and the parameters (b, c1, c2, W, J, Q, d, s, o, S,
O, R, M, P, U) of a machine.
"""

from __future__ import annotations

from app.inference.variants import MachineSpec
from app.inference.weights import Weights

__all__ = ["MachineSpec", "Weights"]
