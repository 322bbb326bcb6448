"""Bernoulli draws that spend 8 random bits each, and 53 more where those do not decide.

Random numbers, not matrix products, bound a Gibbs sweep. A probability p is compared as the integer
part of p·2^8 with 8 random bits; in the tie (1 in 256) the fractional part decides by a float64
draw, so the result is a Bernoulli(p) draw to the precision of p.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def bernoulli(p: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Binary draws with probabilities p (float32 or float64), in p's dtype and shape."""
    p = p.detach().contiguous()
    drawn = torch.empty_like(p)
    # numpy casts within a pass, so no temporary is wider than a byte a draw, and it finds the rare
    # ties ten times faster than torch on one core.
    source, target = p.view(-1).numpy(), drawn.view(-1).numpy()
    words = torch.empty((p.numel() + 7) // 8, dtype=torch.int64)
    words.random_(-(1 << 63), None, generator=generator)
    bits = words.numpy().view(np.uint8)[: p.numel()]
    whole = np.empty(p.numel(), dtype=np.uint8)
    # A hair below 256 keeps p = 1 within a byte; the exact fraction below makes good for it.
    np.multiply(source, np.nextafter(source.dtype.type(256), 0), out=whole, casting="unsafe")
    np.less(bits, whole, out=target)
    ties = np.flatnonzero(bits == whole)
    draw = torch.rand(ties.size, generator=generator, dtype=torch.float64).numpy()
    target[ties] = draw < source[ties] * 256 - whole[ties]
    return drawn
