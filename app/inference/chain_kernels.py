"""Compiled kernels of one Gibbs chain over hidden units and objects.

The module `chains` has the formulas. Each function works on one chain. It receives random numbers
for this chain, uniform on [0, 1). So a chain is independent of other chains. `beta` is
1 / temperature.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled, compiled_in_any_order, inlined
from app.inference.elementary import exp, log, logistic

PROPOSALS = 8
"""Number of blocks of h1 in a Metropolis–Hastings update.

With observed relations, a sweep proposes new values for one block of h1 after the other.
"""


@inlined
def _softplus(x):
    return max(x, np.float32(0.0)) + log(np.float32(1.0) + exp(-abs(x)))


@compiled
def _bernoulli(logits, beta, uniform, on):
    """Set each on[i] to 1 with probability sigmoid(beta logits[i]), else to 0."""
    for i in range(len(logits)):
        on[i] = uniform[i] < logistic(beta * logits[i])


@compiled
def _add_rows(rows, on, total):
    """Add each row with on[row] = 1 to total, four rows at a time. on has the shape (n,)."""
    active, count = np.empty(len(on), np.int64), 0
    for i in range(len(on)):
        active[count] = i  # the next index overwrites the index of a row that is off
        count += on[i]
    whole = count - count % 4
    for k in range(0, whole, 4):
        a, b, c, d = rows[active[k]], rows[active[k + 1]], rows[active[k + 2]], rows[active[k + 3]]
        for i in range(len(total)):
            total[i] += (a[i] + b[i]) + (c[i] + d[i])
    for k in range(whole, count):
        row = rows[active[k]]
        for i in range(len(total)):
            total[i] += row[i]


@compiled
def sweeps(w, bias, always, held, held2, observed, beta, uniform, on, h1, h2):
    """Run Gibbs sweeps that change the arrays h1, h2 and on in place.

    Args:
        w: `chains.Arrays`.
        bias: (H1,) bias of h1.
        always: (V,) uint8, 1 for classes that stay present.
        held, held2: (H1,) and (H2,) uint8, 1 for hidden units that stay on.
        observed: observed relations, `chains.Observed`.
        beta: 1 / temperature.
        uniform: (sweeps, V + 2 H1 + H2 + PROPOSALS) random numbers.
        on: (V,) uint8, presence of the classes.
        h1, h2: (H1,) and (H2,) uint8, states of the hidden units.
    """
    V, H1 = w.W.shape
    H2 = len(h2)
    logits, logits2 = np.empty(V, np.float32), np.empty(H2, np.float32)
    x = np.empty(H1, np.float32)
    for t in range(len(uniform)):
        row = uniform[t]
        x[:] = bias
        _add_rows(w.W, on, x)
        _add_rows(w.JT, h2, x)
        if len(observed.r):
            _propose(w, x, held, observed, beta, h1, row[V + H1 + H2 :], row[:H1])
        else:
            _bernoulli(x, beta, row[:H1], h1)
            h1 |= held
        if H2:
            logits2[:] = w.c2
            _add_rows(w.J, h1, logits2)
            _bernoulli(logits2, beta, row[H1 : H1 + H2], h2)
            h2 |= held2
        logits[:] = w.b
        _add_rows(w.WT, h1, logits)
        _bernoulli(logits, beta, row[H1 + H2 : H1 + H2 + V], on)
        on |= always


@compiled
def _propose(w, x, held, observed, beta, h1, blocks, uniform):
    """Update h1 given objects and observed relations, by Metropolis–Hastings.

    A proposal comes from the conditional of h1 without relations, which has the logits x. Each
    changed unit belongs to a random block. The function accepts or rejects one block after the
    other. ``blocks`` (H1 + PROPOSALS,) has random numbers for the blocks of the units and for the
    acceptances, and ``uniform`` (H1,) for the proposed states.
    """
    H1 = len(x)
    proposal, block = np.empty(H1, np.uint8), np.empty(H1, np.int64)
    _bernoulli(x, beta, uniform, proposal)
    proposal |= held
    for k in range(H1):
        block[k] = np.int64(blocks[k] * PROPOSALS) if proposal[k] != h1[k] else -1  # unchanged
    factors = np.zeros(w.directions.shape[1], np.float32)
    _add_rows(w.directions, h1, factors)
    terms = np.empty(len(observed.r), np.float32)
    weight = _observed_weight(factors, observed, beta, terms)
    proposed_factors = np.empty_like(factors)
    for number in range(PROPOSALS):
        proposed_factors[:] = factors
        size = 0
        for k in range(H1):
            if block[k] == number:
                row, sign = w.directions[k], np.float32(1.0 if proposal[k] else -1.0)
                size += 1
                for i in range(len(row)):
                    proposed_factors[i] += sign * row[i]
        if size:
            proposed = _observed_weight(proposed_factors, observed, beta, terms)
            if np.log(max(np.float64(blocks[H1 + number]), 1e-9)) < proposed - weight:
                weight = proposed
                factors[:] = proposed_factors
                for k in range(H1):
                    if block[k] == number:
                        h1[k] = proposal[k]


@compiled
def _observed_weight(factors, observed, beta, terms):
    """Return log p(r | v, h1) of the observed relations. ``terms`` (E,) is a buffer."""
    _observed_logits(factors.reshape(-1, observed.z.shape[1]), observed, terms)
    for e in range(len(terms)):
        logit = beta * terms[e]
        terms[e] = observed.r[e] * logit - _softplus(logit)
    total = np.float64(0.0)
    for e in range(len(terms)):
        total += terms[e]
    return total


@compiled_in_any_order
def _observed_logits(factors, observed, out):
    """Write the logit base_e + z_e·(contribution of h1 to the factors of relation a_e) to out."""
    for e in range(len(out)):
        z, h1_factors, logit = observed.z[e], factors[observed.a[e]], observed.base[e]
        for k in range(len(z)):
            logit += z[k] * h1_factors[k]
        out[e] = logit
