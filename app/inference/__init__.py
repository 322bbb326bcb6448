"""Inference with a trained machine: arrays in, arrays out.

docs/models.md defines the symbols: v, r, h1, h2; b, c1, c2, W, J, Q; d, s, o, S, O, R, M, P, U.
"""

from __future__ import annotations

from app.inference.variants import MachineSpec
from app.inference.weights import Weights

__all__ = ["MachineSpec", "Weights"]
