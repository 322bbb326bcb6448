"""Random draws for rows of scenes, which several processes may share (`machines.distributed`).

A Bernoulli draw uses 8 random bits, and 53 more bits in a tie.

The generation of random numbers limits the speed of a Gibbs sweep. A draw compares the integer part
of p·2^8 with 8 random bits. If the two are equal (1 draw in 256), a second random number of 53 bits
is compared with the fractional part of p·2^8. The result is exact to the precision of p.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from training.machines.distributed import own_rows


def bernoulli(p: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Return binary draws with probabilities p (float32 or float64), in p's dtype and shape."""
    device = p.device
    p = p.detach().cpu().contiguous()
    sample = torch.empty_like(p)
    # numpy converts the type during the multiplication, so temporary arrays use one byte for each
    # draw. numpy also finds the rare ties ten times faster than torch on one core.
    source, target = p.view(-1).numpy(), sample.view(-1).numpy()
    first, rows = own_rows(len(p), generator)
    width = p.shape[1:].numel()
    words = torch.empty((rows * width + 7) // 8, dtype=torch.int64, device="cpu")
    words.random_(-(1 << 63), None, generator=generator)
    bits = words.numpy().view(np.uint8)[first * width :][: p.numel()]
    whole = np.empty(p.numel(), dtype=np.uint8)
    # With a factor slightly below 256, the product for p = 1 fits in a byte. The exact fraction
    # below corrects the small difference.
    np.multiply(source, np.nextafter(source.dtype.type(256), 0), out=whole, casting="unsafe")
    np.less(bits, whole, out=target)
    ties = np.flatnonzero(bits == whole)
    draw = uniform((ties.size,), generator, torch.float64).cpu().numpy()
    target[ties] = draw < source[ties] * 256 - whole[ties]
    return sample.to(device)


def uniform(
    shape: Sequence[int], generator: torch.Generator | None, dtype: torch.dtype | None = None
) -> Tensor:
    """Return uniform draws from [0, 1) for the rows of this process."""
    first, rows = own_rows(shape[0], generator)
    values = torch.rand((rows, *shape[1:]), generator=generator, dtype=dtype, device="cpu")
    return values[first : first + shape[0]].to(torch.get_default_device())


def integers(limit: int, shape: Sequence[int], generator: torch.Generator | None) -> Tensor:
    """Return uniform draws from 0 .. limit - 1 for the rows of this process."""
    first, rows = own_rows(shape[0], generator)
    values = torch.randint(limit, (rows, *shape[1:]), generator=generator, device="cpu")
    return values[first : first + shape[0]].to(torch.get_default_device())


def categorical(weight: Tensor, generator: torch.Generator | None) -> Tensor:
    """Return a column for each row (B,), drawn in proportion to the weights (B, n)."""
    first, rows = own_rows(len(weight), generator)
    # The rows of other processes get any weights: a draw advances the generator alike for all.
    weights = torch.ones(rows, weight.shape[1], dtype=weight.dtype, device="cpu")
    weights[first : first + len(weight)] = weight.cpu()
    columns = torch.multinomial(weights, 1, generator=generator).squeeze(1)
    return columns[first : first + len(weight)].to(weight.device)


def log_odds_of(count: Tensor, total: Tensor) -> Tensor:
    """Return the log-odds of `count` events in `total` trials, with 1/2 added to both counts."""
    return ((count + 0.5) / (total - count + 0.5)).log()
