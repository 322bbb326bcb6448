"""Bernoulli draws from 8 random bits each; a tie uses 53 more bits.

Random numbers, rather than matrix products, limit the speed of a Gibbs sweep. A draw compares the
integer part of p·2^8 with 8 random bits. In a tie (1 in 256) a float64 draw decides by the
fractional part. The result is a Bernoulli(p) draw to the precision of p.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def bernoulli(p: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Return binary draws with probabilities p (float32 or float64), in p's dtype and shape."""
    p = p.detach().contiguous()
    drawn = torch.empty_like(p)
    # numpy converts the values within a pass, so temporaries have one byte for each draw. It also
    # finds the rare ties ten times faster than torch on one core.
    source, target = p.view(-1).numpy(), drawn.view(-1).numpy()
    words = torch.empty((p.numel() + 7) // 8, dtype=torch.int64)
    words.random_(-(1 << 63), None, generator=generator)
    bits = words.numpy().view(np.uint8)[: p.numel()]
    whole = np.empty(p.numel(), dtype=np.uint8)
    # A factor slightly below 256 keeps p = 1 within a byte; the exact fraction below corrects this.
    np.multiply(source, np.nextafter(source.dtype.type(256), 0), out=whole, casting="unsafe")
    np.less(bits, whole, out=target)
    ties = np.flatnonzero(bits == whole)
    draw = torch.rand(ties.size, generator=generator, dtype=torch.float64).numpy()
    target[ties] = draw < source[ties] * 256 - whole[ties]
    return drawn
