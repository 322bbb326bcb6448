"""Compiled loops of the object part: what a class gains from the context.

Formulas in `objects`. A group of factors is multiplied before one log is taken.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled
from app.inference.elementary import exponent, log, mantissa

LANES = 32
_LN2 = np.float32(0.6931471805599453)


@compiled
def gains(off, on, exp_w, group, out):
    """Of contexts (M, H1) and all classes (tiles, H1, classes of a tile), into out (M, V).

    Of a group's product only the exponent is set aside, and one log is taken in the end.
    """
    (tiles, units, width), V = exp_w.shape, out.shape[1]
    product, exponents = np.empty(width, np.float32), np.empty(width, np.int32)
    for t in range(tiles):
        tile = exp_w[t]
        for m in range(len(off)):
            offs, ons, into = off[m], on[m], out[m, t * width :]
            product[:], exponents[:] = np.float32(1.0), np.int32(0)
            for start in range(0, units, group):
                end = min(start + group, units)
                # Two factors at a time halve the reads and writes of the product.
                for k in range(start, end - 1, 2):
                    a1, b1, row1 = offs[k], ons[k], tile[k]
                    a2, b2, row2 = offs[k + 1], ons[k + 1], tile[k + 1]
                    for i in range(width):
                        product[i] *= (a1 + b1 * row1[i]) * (a2 + b2 * row2[i])
                if (end - start) % 2:
                    a1, b1, row1 = offs[end - 1], ons[end - 1], tile[end - 1]
                    for i in range(width):
                        product[i] *= a1 + b1 * row1[i]
                for i in range(width):
                    exponents[i] += exponent(product[i])
                    product[i] = mantissa(product[i])
            for i in range(min(width, V - t * width)):
                into[i] = log(product[i]) + _LN2 * np.float32(exponents[i])


@compiled
def _gain(off, on, growth, group, product, total):
    """sum_k log of (off + on e^W) / (off + on)."""
    total[:] = np.float32(0.0)
    for first in range(0, len(off), group * LANES):
        product[:] = np.float32(1.0)
        for start in range(first, min(first + group * LANES, len(off)), LANES):
            end = min(start + LANES, len(off))
            a, b, c = off[start:end], on[start:end], growth[start:end]
            for lane in range(len(a)):
                product[lane] *= (a[lane] + b[lane] * c[lane]) / (a[lane] + b[lane])
        for lane in range(LANES):
            total[lane] += log(product[lane])
    gain = np.float32(0.0)
    for lane in range(LANES):
        gain += total[lane]
    return gain


@compiled
def paired_gains(off, on, growth, context, which, group):
    """Of class which[n] of growth (N, H1) in context[n] of off and on (M, H1), (P,)."""
    product, total = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    found = np.empty(len(context), np.float32)
    for n in range(len(context)):
        m = context[n]
        found[n] = _gain(off[m], on[m], growth[which[n]], group, product, total)
    return found


@compiled
def gains_without_others(rows, off, on, growth, fall, common, index, group):
    """The gain of the classes in rows (N,), each other class of the scene taken out, (N, n).

    Args:
        off: (H1,) sigmoid(-y).
        on: (n, H1) sigmoid(y) e^-share of each class.
        growth: (n, H1) e^W.  fall: (n, H1) e^-share.
        common: (P, H1) e^ what the relations between two classes add to y.
        index: (n, n) the row of `common`; -1 for none.
    """
    n, size = fall.shape
    both, found = np.zeros(size, np.float32), np.zeros((len(rows), n), np.float32)
    product, total = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for c in range(len(rows)):
        i = rows[c]
        left = on[i]
        for j in range(n):
            down = fall[j]
            for k in range(size):
                both[k] = left[k] * down[k]
            if index[i, j] >= 0:
                # Relations between the two go out with either, so they must not go out twice.
                twice = common[index[i, j]]
                for k in range(size):
                    both[k] *= twice[k]
            found[c, j] = _gain(off, both, growth[i], group, product, total)
    return found
