"""Inference with a trained machine. Functions take arrays and return arrays.

A machine is a Boltzmann machine over the objects and relations of a scene. docs/models.md defines
its units (v, r, h1) and its parameters (b, c1, W, Q, d, s, o, S, O, R, M, P, U).
"""

from app.inference.variants import MachineSpec
from app.inference.weights import Weights

__all__ = ["MachineSpec", "Weights"]
