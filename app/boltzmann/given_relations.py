"""Weighted draws of the context given relations, compiled: `draws` for one scene and one machine.

For a Triway machine of one layer in the local form. Given relations enter p(h1 | v, r) by

    log p(h1 | v, r) = h1·x + sum_{e given} g_e [r_e ℓ_e(h1) - softplus(ℓ_e(h1))] + const,

g_e the presence of both ends. So M fixed draws from the mean-field fixed point carry weights, as in
`draws`; one set of them answers every question about the scene. Logits go through the factors,

    ℓ_e(h1) = base_e + P[a]·h1 + Z_e·(R[a] + M[a] h1),   Z_e = S_i * O_j,

base_e what does not depend on h1. Units are laid out as (A, E) for E pairs (i, j).
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from app.boltzmann.closed_form import ANY_ORDER, ClosedForm, Floats, residual_of
from app.boltzmann.draws import fixed_uniforms
from app.boltzmann.elementary import exp, log, logistic
from app.boltzmann.mean_field import SWEEPS

Places = NDArray[np.int64]

DRAWS = 64
"""A power of two keeps the Sobol sequence balanced."""

_DAMPING = np.float32(0.8)
_NO_UNIT = np.float32(-30.0)


class Pairs:
    """Ordered pairs of classes, and what their units are made of.

    Attributes:
        Z: (E, K).
        base: (A, E).
    """

    def __init__(
        self,
        closed: ClosedForm,
        subjects: Places,
        objects: Places,
        log_subjects: Floats,
        log_objects: Floats,
    ) -> None:
        w = closed.weights
        self.Z = w.S[subjects] * w.O[objects]
        self.base = _base(w, subjects, objects, log_subjects, log_objects)


class GivenDraws:
    """Draws of h1 given a scene and some of its relations.

    Args:
        closed: the machine.
        x: (H1,) logits of h1 from the objects alone.
        pairs: E pairs of classes among which relations are given.
        r: (A, E) 1 where a relation is given as holding.
        gate: (A, E) presence of both ends where it is given, on or off, else 0.

    Attributes:
        y: (H1,) logits of the proposal.
        slopes: (A, E) what each given relation adds to y is its slope times U_e.
        h: (M, H1) draws.
        terms: (M, A, E) log p(r_e | v, h1) of each given relation, else 0.
        log_weight: (M,) not normalised.
    """

    def __init__(
        self, closed: ClosedForm, x: Floats, pairs: Pairs, r: Floats, gate: Floats
    ) -> None:
        self.closed, self.x = closed, x
        w = closed.weights
        self.y, self.slopes = _fixed_point(x, pairs.Z, pairs.base, w.R, w.M, w.P, r, gate)
        self.h = _draw(self.y, _uniforms(len(x)))
        # (M, A, K) and (M, A): what the units of all pairs share.
        A, K, H1 = w.M.shape
        self._shared = _product(self.h, w.M.reshape(A * K, H1)).reshape(-1, A, K) + w.R
        self._bias = _product(self.h, w.P)
        self.terms = self.logits(pairs)
        _to_terms(self.terms, r, gate)
        self.log_weight = self.h @ (x - self.y) + self.terms.sum((1, 2), dtype=np.float32)

    def logits(self, pairs: Pairs) -> Floats:
        """ℓ_e of every draw, (M, A, E)."""
        draws, A, K = self._shared.shape
        product = _product(self._shared.reshape(draws * A, K), pairs.Z)
        logits = product.reshape(draws, A, -1)
        logits += pairs.base
        logits += self._bias[:, :, None]
        return logits

    def pulls(self, pairs: Pairs, share: Floats) -> Floats:
        """What given relations add to y, (N, H1), for shares (N, A, E) of their slopes."""
        w = self.closed.weights
        weight = share * self.slopes
        A, K, H1 = w.M.shape
        factors = _product(weight.reshape(-1, weight.shape[-1]), pairs.Z.T.copy())
        through = _product(factors.reshape(-1, A * K), w.M.reshape(A * K, H1).T.copy())
        return through + weight.sum(-1) @ w.P


def weights(log_weight: Floats) -> Floats:
    """Normalised over the first axis."""
    weight = np.exp(log_weight - log_weight.max(0))
    found: Floats = weight / weight.sum(0)
    return found


def log_odds(
    logits: Floats, weight: Floats, shift: Floats, terms: Floats, gate: Floats
) -> Floats:
    """log-odds of E[sigmoid(ℓ_e + shift_e)], each given unit taken out of the weights, (A, E).

    Args:
        logits, terms: (M, A, E).
        weight: (M,).
        shift, gate: (A, E).
    """
    return _mean_log_odds(logits, weight, shift, terms, gate)


def candidate_log_odds(logits: Floats, weight: Floats) -> Floats:
    """log-odds of E[sigmoid(ℓ)] for logits (M, A, N, m) and weights (M, N), (A, N, m)."""
    return _candidate_log_odds(logits, weight)


def _product(a: Floats, b: Floats) -> Floats:
    """a b', by torch: its threads are limited, and one shape always takes one way."""
    found: Floats = (torch.from_numpy(a) @ torch.from_numpy(b).T).numpy()
    return found


def _uniforms(units: int) -> Floats:
    if units not in _UNIFORMS:
        _UNIFORMS[units] = fixed_uniforms(DRAWS, units).numpy().astype(np.float32)
    return _UNIFORMS[units]


_UNIFORMS: dict[int, Floats] = {}


@njit(nogil=True, cache=True, error_model="numpy")
def _base(w, subjects, objects, log_subjects, log_objects):
    A, E = len(w.d), len(subjects)
    base = np.empty((A, E), np.float32)
    for a in range(A):
        for e in range(E):
            i, j = subjects[e], objects[e]
            ends = w.s[a, i] + w.n[a, 0] * log_subjects[e] + w.o[a, j] + w.n[a, 1] * log_objects[e]
            base[a, e] = w.d[a] + ends + residual_of(w, a, i, j)
    return base


@njit(nogil=True, cache=True, error_model="numpy", fastmath=ANY_ORDER)
def _mean_logits(mean, Z, base, R, M, P, out):
    """ℓ_e at the mean of h1."""
    A, K, H1 = M.shape
    shared = np.empty(K, np.float32)
    for a in range(A):
        M_a, P_a, R_a, base_a, out_a = M[a], P[a], R[a], base[a], out[a]
        bias = np.float32(0.0)
        for h in range(H1):
            bias += P_a[h] * mean[h]
        for k in range(K):
            row, total = M_a[k], R_a[k]
            for h in range(H1):
                total += row[h] * mean[h]
            shared[k] = total
        for e in range(len(Z)):
            z, total = Z[e], base_a[e] + bias
            for k in range(K):
                total += z[k] * shared[k]
            out_a[e] = total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=ANY_ORDER)
def _pull(slopes, Z, M, P, out):
    """sum_e slope_e U_e."""
    A, K, H1 = M.shape
    factors = np.empty(K, np.float32)
    for h in range(H1):
        out[h] = np.float32(0.0)
    for a in range(A):
        count = np.float32(0.0)
        for k in range(K):
            factors[k] = np.float32(0.0)
        for e in range(len(Z)):
            slope, z = slopes[a, e], Z[e]
            if slope != 0.0:
                count += slope
                for k in range(K):
                    factors[k] += slope * z[k]
        M_a, P_a = M[a], P[a]
        for h in range(H1):
            out[h] += count * P_a[h]
        for k in range(K):
            row, factor = M_a[k], factors[k]
            for h in range(H1):
                out[h] += factor * row[h]


@njit(nogil=True, cache=True, error_model="numpy")
def _fixed_point(x, Z, base, R, M, P, r, gate):
    """The mean field of `mean_field`: logits of h1, and the slopes that it ended with."""
    A, E = base.shape
    H1 = len(x)
    y, mean, pull = x.copy(), np.empty(H1, np.float32), np.zeros(H1, np.float32)
    logits, slopes = np.empty((A, E), np.float32), np.zeros((A, E), np.float32)
    for sweep in range(SWEEPS):
        for h in range(H1):
            mean[h] = logistic(y[h])
        _mean_logits(mean, Z, base, R, M, P, logits)
        kept = _DAMPING if sweep else np.float32(0.0)
        for a in range(A):
            for e in range(E):
                slope = gate[a, e] * (r[a, e] - logistic(logits[a, e]))
                slopes[a, e] = kept * slopes[a, e] + (np.float32(1.0) - kept) * slope
        _pull(slopes, Z, M, P, pull)
        for h in range(H1):
            y[h] = x[h] + pull[h]
    return y, slopes


@njit(nogil=True, cache=True, error_model="numpy")
def _draw(y, uniforms):
    draws, H1 = uniforms.shape
    p, h = np.empty(H1, np.float32), np.empty((draws, H1), np.float32)
    for k in range(H1):
        p[k] = logistic(y[k])
    for m in range(draws):
        u, row = uniforms[m], h[m]
        for k in range(H1):
            row[k] = np.float32(1.0) if u[k] < p[k] else np.float32(0.0)
    return h


@njit(nogil=True, cache=True, error_model="numpy")
def _to_terms(logits, r, gate):
    """g [r ℓ - softplus(ℓ)] in place of ℓ."""
    r_, gate_ = r.reshape(-1), gate.reshape(-1)
    for m in range(len(logits)):
        row = logits[m].reshape(-1)
        for e in range(len(row)):
            value = row[e]
            softplus = max(value, np.float32(0.0)) + log(np.float32(1.0) + exp(-abs(value)))
            row[e] = gate_[e] * (r_[e] * value - softplus)


@njit(inline="always", error_model="numpy")
def _odds(on, off):
    return max(log(max(on, np.float32(1e-37))) - log(max(off, np.float32(1e-37))), _NO_UNIT)


@njit(nogil=True, cache=True, error_model="numpy")
def _mean_log_odds(logits, weight, shift, terms, gate):
    draws, A, E = logits.shape
    size = A * E
    on, off = np.zeros(size, np.float32), np.zeros(size, np.float32)
    shift_, gate_ = shift.reshape(-1), gate.reshape(-1)
    for m in range(draws):
        row, w = logits[m].reshape(-1), weight[m]
        for e in range(size):
            value = row[e] + shift_[e]
            t = exp(-value)
            s = w / (np.float32(1.0) + t)
            on[e] += s
            off[e] += t * s
    for e in range(size):
        if gate_[e] > 0:
            up, down = np.float32(0.0), np.float32(0.0)
            for m in range(draws):
                rest = weight[m] * exp(-terms[m].reshape(-1)[e])
                value = logits[m].reshape(-1)[e] + shift_[e]
                up += rest * logistic(value)
                down += rest * logistic(-value)
            on[e], off[e] = up, down
    found = np.empty(size, np.float32)
    for e in range(size):
        found[e] = _odds(on[e], off[e])
    return found.reshape(A, E)


@njit(nogil=True, cache=True, error_model="numpy")
def _candidate_log_odds(logits, weight):
    draws, A, N, m_ = logits.shape
    on, off = np.zeros((A, N, m_), np.float32), np.zeros((A, N, m_), np.float32)
    for m in range(draws):
        for a in range(A):
            for i in range(N):
                w = weight[m, i]
                row, up, down = logits[m, a, i], on[a, i], off[a, i]
                for j in range(m_):
                    t = exp(-row[j])
                    s = w / (np.float32(1.0) + t)
                    up[j] += s
                    down[j] += t * s
    for a in range(A):
        for i in range(N):
            up, down = on[a, i], off[a, i]
            for j in range(m_):
                up[j] = _odds(up[j], down[j])
    return on
