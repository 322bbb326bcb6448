"""Compiled loops of the object part: hidden logits, and what a class gains from the rest.

Formulas in `closed_form`.
"""

from __future__ import annotations

import numpy as np

from app.boltzmann.elementary import exp, log, logistic
from app.compiling import compiled


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
def _gain(off, rest, growth, product):
    """sum_k log of (off + rest e^W) / (off + rest), as in `scoring`."""
    lanes = len(product)
    for lane in range(lanes):
        product[lane] = np.float32(1.0)
    for start in range(0, len(off), lanes):
        end = min(start + lanes, len(off))
        a, b, c = off[start:end], rest[start:end], growth[start:end]
        for lane in range(len(a)):
            product[lane] *= (a[lane] + b[lane] * c[lane]) / (a[lane] + b[lane])
    for lane in range(lanes):
        product[lane] = log(product[lane])
    total = np.float32(0.0)
    for lane in range(lanes):
        total += product[lane]
    return total


@compiled
def leave_one_out(x, W, share, rows, common, group):
    """See `ClosedForm.leave_one_out`; W (n, H1) are the rows of the classes."""
    n, H1 = W.shape
    on, off = np.empty(H1, np.float32), np.empty(H1, np.float32)
    for k in range(H1):
        on[k], off[k] = logistic(x[k]), logistic(-x[k])
    # e^W of what is judged, e^-share of what is left out.
    growth, fall = np.empty((n, H1), np.float32), np.empty((n, H1), np.float32)
    for i in range(n):
        weight, added, up, down = W[i], share[i], growth[i], fall[i]
        for k in range(H1):
            up[k] = exp(weight[k])
            down[k] = exp(-added[k])
    # Each lane takes a product of at most `group` factors.
    product = np.empty(max(-(-H1 // group), min(64, H1)), np.float32)
    alone, pairs = np.empty(n, np.float32), np.zeros((len(rows), n), np.float32)
    rest, both = np.empty(H1, np.float32), np.empty(H1, np.float32)
    for i in range(n):
        down = fall[i]
        for k in range(H1):
            rest[k] = on[k] * down[k]
        alone[i] = _gain(off, rest, growth[i], product)
    for c in range(len(rows)):
        i = rows[c]
        down = fall[i]
        for k in range(H1):
            rest[k] = on[k] * down[k]
        for j in range(n):
            if j != i:
                down = fall[j]
                for k in range(H1):
                    both[k] = rest[k] * down[k]
                if len(common):
                    twice = common[c, j]
                    for k in range(H1):
                        both[k] *= exp(twice[k])
                pairs[c, j] = _gain(off, both, growth[i], product)
    return alone, pairs
