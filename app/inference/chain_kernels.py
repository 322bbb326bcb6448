"""Compiled kernel of one Gibbs chain over hidden units and objects.

The module `chains` has the formulas. The function works on one chain. It receives random numbers
for this chain, uniform on [0, 1). So a chain is independent of other chains.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled
from app.inference.elementary import exp, logistic


@compiled
def _add_rows(rows, on, total):
    """Add each row with on[row] = 1 to total. on has the shape (n,)."""
    for i in range(len(on)):
        if on[i]:
            row = rows[i]
            for k in range(len(total)):
                total[k] += row[k]


@compiled
def _draw_state(logits, beta, uniform):
    """Draw the state of a hidden unit: 0 for the first state, whose logit is 0."""
    top = np.float32(0.0)
    for z in range(len(logits)):
        top = max(top, beta * logits[z])
    total = exp(-top)
    for z in range(len(logits)):
        total += exp(beta * logits[z] - top)
    threshold = uniform * total
    cumulative = exp(-top)
    if threshold < cumulative:
        return 0
    for z in range(len(logits)):
        cumulative += exp(beta * logits[z] - top)
        if threshold < cumulative:
            return z + 1
    return len(logits)  # rounding


@compiled
def sweeps(w, bias, always, held, held2, beta, uniform, on, h1, h2):
    """Run Gibbs sweeps that change the arrays on, h1 and h2 in place.

    A sweep draws h1 given the rest, then h2 given h1, and then the classes. Coupled classes are
    drawn one after another, each given all others.

    Args:
        w: `chains.Arrays`.
        bias: (H1,) bias of h1.
        always: (V,) uint8, 1 for classes that stay present.
        held: (units,) state that a unit of h1 keeps, or -1 for a free unit.
        held2: (H2,) uint8, 1 for units of h2 that stay on.
        beta: 1 / temperature.
        uniform: (sweeps, units + H2 + V) random numbers.
        on: (V,) uint8, presence of the classes.
        h1: (units,) state of each unit of h1.
        h2: (H2,) uint8, states of the units of h2.
    """
    V, H1 = w.W.shape
    units, H2 = len(h1), len(h2)
    states = H1 // units
    x, coupled = np.empty(H1, np.float32), len(w.L) > 0
    field, logits2 = np.empty(V, np.float32), np.empty(H2, np.float32)
    from_classes = np.zeros(V, np.float32)
    if coupled:
        _add_rows(w.L, on, from_classes)
    for t in range(len(uniform)):
        row = uniform[t]
        x[:] = bias
        _add_rows(w.W, on, x)
        _add_rows(w.JT, h2, x)
        for m in range(units):
            h1[m] = held[m]
            if held[m] < 0:
                h1[m] = _draw_state(x[m * states : (m + 1) * states], beta, row[m])
        field[:] = w.b
        logits2[:] = w.c2
        for m in range(units):
            if h1[m]:
                entry = m * states + h1[m] - 1
                from_h1, from_h1_to_h2 = w.WT[entry], w.J[entry]
                for i in range(V):
                    field[i] += from_h1[i]
                for k in range(H2):
                    logits2[k] += from_h1_to_h2[k]
        for k in range(H2):
            h2[k] = max(held2[k], np.uint8(row[units + k] < logistic(beta * logits2[k])))
        for i in range(V):
            logit = beta * (field[i] + from_classes[i])
            drawn = max(always[i], np.uint8(row[units + H2 + i] < logistic(logit)))
            if coupled and drawn != on[i]:
                sign, changed = np.float32(1.0 if drawn else -1.0), w.L[i]
                for j in range(V):
                    from_classes[j] += sign * changed[j]
            on[i] = drawn
