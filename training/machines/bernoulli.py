"""Sample binary values with probability p. A sample uses 8 random bits, and 53 more in a tie.

The generation of random numbers limits the speed of a Gibbs sweep. A draw compares the integer part
of p·2^8 with 8 random bits. If the two are equal (1 draw in 256), a second random number of 53 bits
is compared with the fractional part of p·2^8. The result is exact to the precision of p.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def bernoulli(p: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Return binary samples with probabilities p. Shape and dtype (float32 or float64) are p's."""
    p = p.detach().contiguous()
    drawn = torch.empty_like(p)
    # numpy converts the type during the multiplication, so temporary arrays use one byte for each
    # draw. numpy also finds the rare ties ten times faster than torch on one core.
    source, target = p.view(-1).numpy(), drawn.view(-1).numpy()
    words = torch.empty((p.numel() + 7) // 8, dtype=torch.int64)
    words.random_(-(1 << 63), None, generator=generator)
    bits = words.numpy().view(np.uint8)[: p.numel()]
    whole = np.empty(p.numel(), dtype=np.uint8)
    # With a factor slightly below 256, the product for p = 1 fits in a byte. The exact fraction
    # below corrects the small difference.
    np.multiply(source, np.nextafter(source.dtype.type(256), 0), out=whole, casting="unsafe")
    np.less(bits, whole, out=target)
    ties = np.flatnonzero(bits == whole)
    draw = torch.rand(ties.size, generator=generator, dtype=torch.float64).numpy()
    target[ties] = draw < source[ties] * 256 - whole[ties]
    return drawn
