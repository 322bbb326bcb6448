"""Compiled loops of the object part: hidden logits, and what a class gains from the rest.

Formulas in `closed_form`.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled
from app.inference.elementary import exp, log, logistic

_LANES = 32


@compiled
def hidden_logits(bias, W, classes, confidence):
    """bias + v'W for the presence of some classes, (H1,)."""
    x = bias.copy()
    for i in range(len(classes)):
        row, presence = W[classes[i]], confidence[i]
        for k in range(len(x)):
            x[k] += presence * row[k]
    return x


@compiled
def _gain(off, on, growth, group, product, total):
    """sum_k log of (off + on e^W) / (off + on), as in `scoring`, over whole blocks of lanes."""
    for lane in range(_LANES):
        total[lane] = np.float32(0.0)
    for first in range(0, len(off), group * _LANES):
        for lane in range(_LANES):
            product[lane] = np.float32(1.0)
        for start in range(first, min(first + group * _LANES, len(off)), _LANES):
            end = start + _LANES
            a, b, c = off[start:end], on[start:end], growth[start:end]
            for lane in range(_LANES):
                product[lane] *= (a[lane] + b[lane] * c[lane]) / (a[lane] + b[lane])
        for lane in range(_LANES):
            total[lane] += log(product[lane])
    gain = np.float32(0.0)
    for lane in range(_LANES):
        gain += total[lane]
    return gain


@compiled
def context_halves(y, size):
    """sigmoid(-y) and sigmoid(y), filled up to `size` by units that gain nothing."""
    off, on = np.ones(size, np.float32), np.zeros(size, np.float32)
    for k in range(len(y)):
        off[k] = logistic(-y[k])
    for k in range(len(y)):
        on[k] = logistic(y[k])
    return off, on


@compiled
def context_gain(off, on, growth, group):
    """sum_k log(off + on growth), from `context_halves`."""
    product, total = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    return _gain(off, on, growth, group, product, total)


@compiled
def without_each(y, W, classes, share, group):
    """The gain of each class, its share (n, H1) of y taken out.

    Returns:
        (n,) the gains, and what `reasons` needs, in whole blocks of lanes: sigmoid(-y); of
        each class, sigmoid(y) e^-share, e^-share and e^W.
    """
    n, H1 = share.shape
    size = -(-H1 // _LANES) * _LANES
    # What fills up a block is off for certain, and gains nothing.
    off, rest = np.ones(size, np.float32), np.zeros((n, size), np.float32)
    fall, growth = np.ones((n, size), np.float32), np.ones((n, size), np.float32)
    on = np.empty(H1, np.float32)
    for k in range(H1):
        on[k] = logistic(y[k])
    for k in range(H1):
        off[k] = logistic(-y[k])
    product, total = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    gains = np.empty(n, np.float32)
    for i in range(n):
        weight, added, up, down, left = W[classes[i]], share[i], growth[i], fall[i], rest[i]
        # One array a loop: with more, the compiler gives up proving them apart.
        for k in range(H1):
            up[k] = exp(weight[k])
        for k in range(H1):
            down[k] = exp(-added[k])
        for k in range(H1):
            left[k] = on[k] * down[k]
        gains[i] = _gain(off, left, up, group, product, total)
    return gains, off, rest, fall, growth


@compiled
def reasons_for_absent(y, W, candidates, share, group):
    """How the gain of absent classes (N,) changes by each class that is there, (N, n).

    Args:
        share: (n, H1) what each adds to y.
    """
    (n, H1), N = share.shape, len(candidates)
    blocks = -(-H1 // _LANES)
    size = blocks * _LANES
    off, on = np.ones(size, np.float32), np.zeros(size, np.float32)
    growth, rest = np.ones((N, size), np.float32), np.empty(H1, np.float32)
    for c in range(N):
        weight, up = W[candidates[c]], growth[c]
        for k in range(H1):
            up[k] = exp(weight[k])
    # Blocks by number: some thousand slices would take as long as what is computed.
    off_of, on_of = off.reshape(blocks, _LANES), on.reshape(blocks, _LANES)
    growth_of = growth.reshape(N, blocks, _LANES)
    product, total = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    with_all, change = np.empty(N, np.float32), np.empty((N, n), np.float32)
    for j in range(-1, n):
        rest[:] = y
        if j >= 0:
            added = share[j]
            for k in range(H1):
                rest[k] -= added[k]
        # sigmoid(-rest) and sigmoid(rest) from one exponential, and neither as a difference.
        for k in range(H1):
            rest[k] = exp(-rest[k])
        for k in range(H1):
            on[k] = np.float32(1.0) / (np.float32(1.0) + rest[k])
        for k in range(H1):
            off[k] = rest[k] * on[k]
        for c in range(N):
            up_of, left = growth_of[c], group
            for lane in range(_LANES):
                product[lane], total[lane] = np.float32(1.0), np.float32(0.0)
            for block in range(blocks):
                for lane in range(_LANES):
                    product[lane] *= off_of[block, lane] + on_of[block, lane] * up_of[block, lane]
                left -= 1
                if left == 0 or block == blocks - 1:
                    left = group
                    for lane in range(_LANES):
                        total[lane] += log(product[lane])
                    for lane in range(_LANES):
                        product[lane] = np.float32(1.0)
            gain = np.float32(0.0)
            for lane in range(_LANES):
                gain += total[lane]
            if j < 0:
                with_all[c] = gain
            else:
                change[c, j] = with_all[c] - gain
    return change


@compiled
def reasons(gain, off, rest, fall, growth, rows, common, filled, group):
    """How the gain of the classes in rows (N,) changes by each other class, (N, n); 0 by itself.

    Args:
        gain, off, rest, fall, growth: see `without_each`.
        common, filled: see `given_kernels.common_growth`; empty where nothing is given.
    """
    n, size = fall.shape
    both, change = np.zeros(size, np.float32), np.zeros((len(rows), n), np.float32)
    product, total = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    for c in range(len(rows)):
        i = rows[c]
        left = rest[i]
        for j in range(n):
            if j != i:
                down = fall[j]
                for k in range(size):
                    both[k] = left[k] * down[k]
                if len(filled) and filled[c, j]:
                    # Relations between the two go out with either, so they must not go out twice.
                    twice = common[c, j]
                    for k in range(len(twice)):
                        both[k] *= twice[k]
                change[c, j] = gain[i] - _gain(off, both, growth[i], group, product, total)
    return change
