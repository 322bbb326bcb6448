"""Bernoulli draws that spend 16 random bits each, and 24 more where those do not decide.

Random numbers, not matrix products, bound a Gibbs sweep. A probability p is compared as the 16-bit
integer part of p·2^16 with 16 random bits; in the tie (1 in 65,536) the fractional part decides by a
float draw, so the result is a Bernoulli(p) draw to 40 bits.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_SHIFT = 1 << 15


def bernoulli(p: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Binary draws with probabilities p, in p's dtype and shape."""
    p = p.contiguous()
    count = p.numel()
    words = torch.empty((count + 3) // 4, dtype=torch.int64)
    words.random_(-(1 << 63), None, generator=generator)
    bits = words.view(torch.int16)[:count].view(p.shape)
    whole = p.mul(2 * _SHIFT).sub_(_SHIFT).floor_().clamp_(max=_SHIFT - 1).to(torch.int16)
    drawn = torch.empty_like(p)
    torch.lt(bits, whole, out=drawn)
    # numpy finds the rare ties ten times faster than torch on one core.
    ties = torch.from_numpy(np.flatnonzero(bits.numpy() == whole.numpy()))
    if ties.numel():
        fraction = p.flatten()[ties] * (2 * _SHIFT) - _SHIFT - whole.flatten()[ties].to(p.dtype)
        draw = torch.rand(fraction.shape, generator=generator, dtype=p.dtype)
        drawn.view(-1)[ties] = (draw < fraction).to(p.dtype)
    return drawn
