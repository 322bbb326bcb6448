"""Chains of a relation."""

from __future__ import annotations

import torch
from torch import Tensor


def transitive_closure(given: Tensor) -> Tensor:
    """All pairs joined by a chain of given ones, (..., n, n) bool, by repeated squaring."""
    reach = given.float()
    while True:
        further = ((reach + reach @ reach) > 0).float()
        if torch.equal(further, reach):
            return reach > 0
        reach = further
