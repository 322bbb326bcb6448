"""Compiled loops that complete a scene by classes which are there unlisted.

Formulas in `completions`.
"""

from __future__ import annotations

import numpy as np

from app.compiling import compiled
from app.inference.elementary import exp, exponent, log, mantissa
from app.inference.object_kernels import context_gain, context_halves

# Factors that are multiplied before the exponent of the product is set aside: none is below
# _LEAST, so the product stays within float32.
_FACTORS = 4
_LEAST = np.float32(1e-7)
_LN2 = np.float32(0.6931471805599453)


@compiled
def unlisted_evidence(sigma, weighed, coverage):
    """sum_i log(1 - c sigma_i) over the weighed classes, (N,).

    Args:
        sigma: (V, N) p(v_i = 1 | h) of each sample.
        weighed: (V,) bool.
        coverage: c.
    """
    size, c, pending = sigma.shape[1], np.float32(coverage), 0
    product, exponents = np.ones(size, np.float32), np.zeros(size, np.int32)
    for i in range(len(sigma)):
        if weighed[i]:
            row = sigma[i]
            for f in range(size):
                product[f] *= max(np.float32(1.0) - c * row[f], _LEAST)
            pending += 1
            if pending == _FACTORS:
                pending = 0
                for f in range(size):
                    exponents[f] += exponent(product[f])
                for f in range(size):
                    product[f] = mantissa(product[f])
    total = np.empty(size, np.float32)
    for f in range(size):
        total[f] = log(product[f]) + _LN2 * np.float32(exponents[f])
    return total


@compiled
def resample(sigma, weighed, base, classes, presence, coverage, count):
    """Systematic resampling of the samples by what they make of a scene, (count,) ascending.

    Args:
        sigma, weighed: see `unlisted_evidence`.
        base: (N,) log weight with no class listed.
        classes, presence: (n,) the listed classes.
    """
    c, weight = np.float32(coverage), base.copy()
    for k in range(len(classes)):
        if weighed[classes[k]]:
            row, g = sigma[classes[k]], presence[k]
            for f in range(len(weight)):
                off = max(np.float32(1.0) - c * row[f], _LEAST)
                weight[f] += g * (log(max(row[f], np.float32(1e-37))) - log(off))
    largest = np.max(weight)
    for f in range(len(weight)):
        weight[f] = exp(weight[f] - largest)
    total = np.float64(0.0)
    for f in range(len(weight)):
        total += weight[f]
    picked, f, below = np.empty(count, np.int64), 0, np.float64(weight[0])
    for k in range(count):
        wanted = (k + 0.5) / count * total
        while below < wanted and f < len(weight) - 1:
            f += 1
            below += weight[f]
        picked[k] = f
    return picked


@compiled
def complete(picked, logits, noise, proposable, log_unlisted, y, W):
    """A completion of the scene by each picked sample.

    Args:
        logits: (N, V) of v given h of each sample.
        noise: (M, V) logits of uniform numbers.
        proposable: (V,) bool, the classes that may be there unlisted.
        log_unlisted: log(1 - c).
        y: (H1,) logits of h1 given what is listed.

    Returns:
        (M, H1) logits of h1 given the completions; the added classes, one completion after the
        other, and (M + 1,) where each begins.
    """
    count, V = noise.shape
    completed = np.empty((count, len(y)), np.float32)
    added, start, size = np.empty(count * V, np.int64), np.zeros(count + 1, np.int64), 0
    over, shift = np.empty(V, np.bool_), np.float32(log_unlisted)
    for m in range(count):
        logit, least = logits[picked[m]], noise[m]
        for i in range(V):
            over[i] = proposable[i] & (logit[i] + shift > least[i])
        row = completed[m]
        row[:] = y
        for i in range(V):
            if over[i]:
                added[size], weight = i, W[i]
                size += 1
                for k in range(len(row)):
                    row[k] += weight[k]
        start[m + 1] = size
    return completed, added[:size], start


@compiled
def mean_log_odds(gains, bias, completed, added, start, fall, group):
    """Log-odds of the mean over completions of each class being there unlisted, (V,).

    Args:
        gains: (M, V) of the completions, changed here.
        bias: (V,) b + log(1 - c).
        completed, added, start: see `complete`.
        fall: (V, whole blocks of lanes) e^-W.
    """
    count, V = gains.shape
    for m in range(count):
        off, on = context_halves(completed[m], fall.shape[1])
        for place in range(start[m], start[m + 1]):
            # softplus(y) - softplus(y - W): the class itself is taken out.
            gains[m, added[place]] = -context_gain(off, on, fall[added[place]], group)
    present, absent = np.zeros(V, np.float32), np.zeros(V, np.float32)
    for m in range(count):
        # One exponential for both, and neither as a difference.
        odds = gains[m]
        for i in range(V):
            odds[i] = exp(-bias[i] - odds[i])
        for i in range(V):
            present[i] += np.float32(1.0) / (np.float32(1.0) + odds[i])
        for i in range(V):
            absent[i] += odds[i] / (np.float32(1.0) + odds[i])
    found = np.empty(V, np.float32)
    for i in range(V):
        found[i] = log(present[i]) - log(absent[i])
    return found
