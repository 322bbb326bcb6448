"""Completions of a scene: the probability of classes that are present but unlisted.

A completion is the scene with some unlisted classes added. The machine must have locally normalised
relations (local form) and stored samples of its Gibbs chains. `posterior` defines v, h1, y and b.
The coverage c is the probability that a request lists a present class. The listed classes are L:

    p(v, h | L) ∝ p(v, h) (1 - c)^{|v \\ L|}   for v ⊇ L

The same distribution results from adding log(1 - c) to the biases of unlisted classes. The module
estimates its posterior from the stored chain samples v_f (`fantasies`). σ is the logistic function.

 1. Each sample v_f has hidden units h_f ~ p(h1 | v_f), drawn once, and logits l = b + W h_f. The
    importance weight of the sample for a scene is

        log w_f = sum_{i in L} log σ(l_i) + sum_{i not in L} log(1 - c σ(l_i)) + room

    Both sums exclude structure (walls …). `room` is 0 for a scene without a room type.
 2. Systematic resampling by these weights selects M samples, at the quantiles (m + 1/2) / M.
 3. Each selected sample m yields one completion of the scene. The completion adds each unlisted
    class j with l_j + log(1 - c) > logit u_mj, except structure. The numbers u are fixed. For each
    class, each of M equal strata of [0, 1) contains one number.
 4. For each completion m, the hidden units are summed out in closed form. y are the logits of h1
    given the completion without class i:

        log-odds_mi = b_i + log(1 - c) + sum_k [softplus(y_k + W_ik) - softplus(y_k)]

    The answer for class i is the log-odds of the mean of σ(log-odds_mi) over the completions.

All requests use the same random numbers, so the same scene always gets the same answer.

The chain samples may have different room types. Then they follow a mixture over these types, in
which n_s samples have type s. For a scene of room type t, the term of log w_f is

    room = Q[t]·h_f - log sum_s n_s exp(Q[s]·h_f) / Z_s

The multistate Bennett acceptance ratio gives the normalising constants Z_s. A scene without a room
type uses the mixture itself.

Sources: self-normalised importance sampling with resampling and one Rao–Blackwellised Gibbs step;
Shirts and Chodera, "Statistically optimal analysis of samples from multiple equilibrium states"
(2008).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from app.inference import objects
from app.inference.elementary import sigmoid
from app.inference.objects import ContextScorer, group_size
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

COMPLETIONS = 16
SEED = 20180521
"""Seed of the random hidden units h_f and of the random numbers u; see the module."""

# Lower limit of logits l, because e^-l of a smaller l would overflow float32.
_LEAST_LOGIT = np.float32(-80.0)
# Number of coverage values with a cached sum of `_unlisted_evidence`. Each sum takes 4 N bytes.
_KEPT = 32
# A product of _FACTORS factors, each at least _LEAST, stays within the range of float32.
_FACTORS, _LEAST = 4, np.float32(1e-7)
_ROOM_SWEEPS = 100
_SETTLED = 1e-7
# Lower limit of Q[s]·h_f for a sample f, relative to the room type s with the largest value. With
# this limit, a product of two exponentials of such values stays within float64.
_LEAST_PULL = -300.0


class Completions:
    """Posterior of unlisted classes, for a machine with fixed weights.

    Args:
        weights: weights and stored samples of the machine.
        structure: (V,) bool, True for structural classes such as walls. Completions ignore these
            classes.
        scorer: scorer of the same machine.
        count: number M of completions of a scene.

    Raises:
        ValueError: the machine has no stored samples, or its weights are too large for float32.
    """

    def __init__(
        self, weights: Weights, structure: Mask, scorer: ContextScorer, count: int = COMPLETIONS
    ) -> None:
        if not self.supports(weights):
            raise ValueError(
                "completions require a machine with stored samples and float32 weights W between "
                "-64 and 64"
            )
        self._scorer, self._structure = scorer, structure
        self._W, self._b = weights["W"], weights["b"]
        generator = np.random.Generator(np.random.Philox(SEED))
        contexts = _draw_hidden_units(weights, generator)
        logits = self._b + contexts @ self._W.T
        # Shapes (V, N) for samples and (V, M) for completions: each class is contiguous in memory.
        self._odds_against = np.exp(-np.maximum(logits, _LEAST_LOGIT)).T.copy()
        # e^-logit(u): a completion adds class j if the odds against j are below (1 - c) times this.
        self._noise = np.exp(-_stratified_logits(count, len(self._b), generator)).T.copy()
        self._rooms = _room_weights(weights, contexts)
        # Each instance has its own cache: a cache of the method would keep every instance alive.
        self._cached_evidence = lru_cache(maxsize=_KEPT)(self._unlisted_evidence)

    @staticmethod
    def supports(weights: Weights) -> bool:
        """Return whether the machine stores samples and its W is float32 between -64 and 64."""
        return weights.spec.N > 0 and group_size(weights["W"]) > 0

    def log_odds(
        self,
        y: Floats,
        classes: Indices,
        presence: Floats,
        coverage: float,
        room: int | None = None,
    ) -> Floats:
        """Return the log-odds that each class is present but unlisted, (V,).

        The result also has entries for listed classes, but these entries have no meaning.

        Args:
            y: (H1,) logits of h1 given the evidence, with unlisted classes absent.
            classes: (n,) indices of the listed classes.
            presence: (n,) probability that each listed class is present.
            coverage: probability c that a present class is listed. It must be below 1.
            room: index of the room type, or None if the room type is unknown.
        """
        log_weights = self._cached_evidence(coverage)
        if room is not None and len(self._rooms):
            log_weights = log_weights + self._rooms[room]
        informative = ~self._structure[classes]
        listed, p_listed = classes[informative], presence[informative]
        closed, count = np.float32(1 - coverage), self._noise.shape[1]
        samples = objects.resampled(
            log_weights, self._odds_against, listed, p_listed, closed, count
        )
        usable = ~self._structure
        usable[classes] = False
        log_closed = np.float32(math.log1p(-coverage))
        limits, bias = np.exp(log_closed) * self._noise, self._b + log_closed
        exp_w, group = self._scorer.exp_w, self._scorer.group
        log_odds: Floats = objects.completed_log_odds(
            y, samples, self._odds_against, limits, usable, bias, self._W, exp_w, group
        )
        return log_odds

    def _unlisted_evidence(self, coverage: float) -> Floats:
        """Return sum_i log(1 - c σ(l_i)) for each sample, (N,). The sum excludes structure."""
        p_present = 1 / (1 + self._odds_against[~self._structure])
        evidence = np.zeros(p_present.shape[1], np.float32)
        for start in range(0, len(p_present), _FACTORS):
            factors = 1 - np.float32(coverage) * p_present[start : start + _FACTORS]
            evidence += np.log(np.maximum(factors, _LEAST).prod(0))
        return evidence


def _draw_hidden_units(weights: Weights, generator: np.random.Generator) -> Floats:
    """Draw hidden units h_f ~ p(h1 | v_f) for each of the N stored samples, (N, H1).

    If the machine has a second layer, its units are fixed at their means by a mean-field iteration.
    """
    base = weights["c1"] + weights.scenes @ weights["W"]
    if weights.spec.C:
        rooms = weights["fantasy_rooms"]
        base += np.where((rooms >= 0)[:, None], weights["Q"][rooms.clip(min=0)], 0)
    y, _ = weights.with_second_layer(base)
    on: Floats = (generator.random(y.shape) < sigmoid(y)).astype(np.float32)
    return on


def _stratified_logits(count: int, classes: int, generator: np.random.Generator) -> Floats:
    """Return logits of random numbers in (0, 1), (M completions, V classes).

    For each class, each of M equal parts of (0, 1) contains one of the M numbers.
    """
    strata = generator.random((count, classes)).argsort(0)  # a random order for each class
    uniform = (strata + generator.random((count, classes))) / count
    uniform = uniform.clip(1e-12, 1 - 1e-12)
    return (np.log(uniform) - np.log1p(-uniform)).astype(np.float32)


def _room_weights(weights: Weights, contexts: Floats) -> Floats:
    """Return the term `room` of log w_f for each room type and each stored sample, (C, N).

    The iteration computes the log Z_s of the module, relative to the first type in the samples.
    """
    spec = weights.spec
    if not spec.C:
        return np.zeros((0, 0), dtype=np.float32)
    room_logits = contexts.astype(np.float64) @ weights["Q"].T.astype(np.float64)
    # The last column stands for "no room type".
    room_logits = np.concatenate([room_logits, np.zeros((len(room_logits), 1))], 1)
    rooms = weights["fantasy_rooms"]
    present, sizes = np.unique(np.where(rooms < 0, spec.C, rooms), return_counts=True)
    # share[f, s] is exp(Q[s]·h_f), divided by the largest entry of the row. With this array, both
    # sums of the iteration are matrix products. The lower limit keeps the sums above 0.
    largest = room_logits[:, present].max(1)
    share = np.exp(np.maximum(room_logits[:, present] - largest[:, None], _LEAST_PULL))
    log_z = np.zeros(len(present))
    mixture = np.ones(len(room_logits))
    for _ in range(_ROOM_SWEEPS):
        mixture = share @ (sizes * np.exp(-log_z))
        previous, log_z = log_z, np.log((1 / mixture) @ share)
        log_z -= log_z[0]
        if np.abs(log_z - previous).max() < _SETTLED:
            break
    log_mixture = largest + np.log(mixture)
    terms = room_logits[:, : spec.C] - log_mixture[:, None]
    return np.ascontiguousarray(terms.T.astype(np.float32))
