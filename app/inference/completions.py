"""Which classes are there although a scene does not list them.

A class that is present is listed with probability c, the coverage. So for the listed classes L

    p(v, h | L) ∝ p(v, h) (1 - c)^{|v \\ L|}   for v ⊇ L

which is the machine itself with the biases of unlisted classes lowered by log(1 - c). Its
posterior is estimated from the chain samples v_f that a machine keeps (`fantasies`):

 1. Each has a context h_f ~ p(h1 | v_f), drawn once, and logits l = b + W h_f. For a scene it gets
    the importance weight, σ the logistic function,

        log w_f = sum_{i in L} log σ(l_i) + sum_{i not in L} log(1 - c σ(l_i)) + room

    Structure (walls …) is left out of both sums. `room` is 0 without a room type.
 2. Systematic resampling with offsets (m + 1/2) / M picks M samples.
 3. Each becomes a completion: an unlisted class j that is no structure is added if
    l_j + log(1 - c) > logit u_mj, with fixed numbers u: M strata of [0, 1) for each class.
 4. Given a completion the context is summed out in closed form, the class itself taken out of y:

        log-odds_mi = b_i + log(1 - c) + sum_k [softplus(y_k + W_ik) - softplus(y_k)]

    The answer is the log-odds of the mean of σ(log-odds_mi) over the completions.

The random numbers are the same for every request, so the same scene has the same answer.

Samples may have been drawn under room types, so they follow a mixture over these. Without a room
type they stand for all rooms as training had them. With room type t, room = Q[t]·h_f minus the log
of the mixture, sum_s n_s exp(Q[s]·h_f) / Z_s, with Z_s as in the multistate Bennett acceptance
ratio.

Sources: self-normalised importance sampling with resampling and one Rao–Blackwellised Gibbs step;
Shirts and Chodera, "Statistically optimal analysis of samples from multiple equilibrium states"
(2008).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from app.inference import completion_kernels
from app.inference.mean_field import sigmoid, with_second_layer
from app.inference.scoring import ContextScorer, group_size
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

COMPLETIONS = 16
SEED = 20180521
"""Of the contexts h_f and the numbers u."""

# Values of the coverage whose weights of an empty scene are kept, 4 N bytes each.
_KEPT = 32
_LANES = 32
_ROOM_SWEEPS = 100
_SETTLED = 1e-7


class Completions:
    """Posterior of unlisted classes, for a machine whose weights do not change.

    Args:
        structure: (V,) classes that are never added, and tell nothing where they are unlisted.
        scorer: of the same machine.
        count: M, completions of a scene.

    Raises:
        ValueError: a machine without stored samples; see `fits`.
    """

    def __init__(
        self,
        weights: Weights,
        structure: Mask,
        scorer: ContextScorer,
        count: int = COMPLETIONS,
    ) -> None:
        if not self.fits(weights):
            raise ValueError("completions need stored samples and moderate weights in float32")
        self._scorer, self._count = scorer, count
        self._group = group_size(weights["W"])
        self._things = ~structure
        self._W, self._b = weights["W"], weights["b"]
        generator = np.random.Generator(np.random.Philox(SEED))
        contexts = _contexts(weights, generator)
        self._logits = np.ascontiguousarray(self._b + contexts @ self._W.T)
        self._sigma = np.ascontiguousarray(sigmoid(self._logits).T)
        self._noise = _stratified_logits(count, len(self._b), generator)
        self._rooms = _room_weights(weights, contexts)
        self._fall = np.ones((len(self._b), -(-self._W.shape[1] // _LANES) * _LANES), np.float32)
        self._fall[:, : self._W.shape[1]] = np.exp(-self._W)
        # Of the instance: a cache of the method would keep every instance alive.
        self._empty = lru_cache(maxsize=_KEPT)(self._unlisted_evidence)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine keeps samples, and products of its factors are safe."""
        return weights.spec.N > 0 and group_size(weights["W"]) > 0

    def log_odds(
        self,
        y: Floats,
        classes: Places,
        presence: Floats,
        coverage: float,
        room: int | None = None,
    ) -> Floats:
        """Log-odds of every class being there unlisted, (V,); of listed ones, without meaning.

        Args:
            y: (H1,) logits of h1 given all that is known, unlisted classes absent.
            classes, presence: (n,) the listed classes.
            coverage: c, below 1.
            room: index of the room type; None where it is not known.
        """
        base = self._empty(coverage)
        if room is not None and len(self._rooms):
            base = base + self._rooms[room]
        picked = completion_kernels.resample(
            self._sigma, self._things, base, classes, presence, coverage, self._count
        )
        proposable, log_unlisted = self._things.copy(), math.log1p(-coverage)
        proposable[classes] = False
        completed, added, start = completion_kernels.complete(
            picked, self._logits, self._noise, proposable, log_unlisted, y, self._W
        )
        found: Floats = completion_kernels.mean_log_odds(
            *(self._scorer.rows_gain(completed), self._b + np.float32(log_unlisted)),
            *(completed, added, start, self._fall, self._group),
        )
        return found

    def _unlisted_evidence(self, coverage: float) -> Floats:
        found: Floats = completion_kernels.unlisted_evidence(self._sigma, self._things, coverage)
        return found


def _contexts(weights: Weights, generator: np.random.Generator) -> Floats:
    """h_f ~ p(h1 | v_f), (N, H1); with a second layer, h2 at its mean field."""
    base = weights["c1"] + weights.scenes @ weights["W"]
    if weights.spec.C:
        rooms = weights["fantasy_rooms"]
        base += np.where((rooms >= 0)[:, None], weights["Q"][rooms.clip(min=0)], 0)
    y, _ = with_second_layer(weights, base)
    on: Floats = (generator.random(y.shape) < sigmoid(y)).astype(np.float32)
    return on


def _stratified_logits(count: int, classes: int, generator: np.random.Generator) -> Floats:
    """Logits of uniform numbers (M, V): each class has one number in each of M equal strata."""
    strata = generator.random((count, classes)).argsort(0)
    uniform = (strata + generator.random((count, classes))) / count
    uniform = uniform.clip(1e-12, 1 - 1e-12)
    return (np.log(uniform) - np.log1p(-uniform)).astype(np.float32)


def _room_weights(weights: Weights, contexts: Floats) -> Floats:
    """What a room type adds to log w of each sample, (C, N)."""
    spec = weights.spec
    if not spec.C:
        return np.zeros((0, 0), dtype=np.float32)
    pull = contexts.astype(np.float64) @ weights["Q"].T.astype(np.float64)
    # The last state is "no room type".
    pull = np.concatenate([pull, np.zeros((len(pull), 1))], 1)
    rooms = weights["fantasy_rooms"]
    drawn, sizes = np.unique(np.where(rooms < 0, spec.C, rooms), return_counts=True)
    under, log_z = pull[:, drawn], np.zeros(len(drawn))
    mixture = np.zeros(len(pull))
    for _ in range(_ROOM_SWEEPS):
        mixture = _log_sum_exp(under - log_z + np.log(sizes), axis=1)
        before, log_z = log_z, _log_sum_exp(under - mixture[:, None], axis=0)
        log_z -= log_z[0]
        if np.abs(log_z - before).max() < _SETTLED:
            break
    return np.ascontiguousarray((pull[:, : spec.C] - mixture[:, None]).T.astype(np.float32))


def _log_sum_exp(terms: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """As `np.logaddexp.reduce`, in a tenth of its time."""
    top = terms.max(axis)
    found: NDArray[np.float64] = top + np.log(np.exp(terms - np.expand_dims(top, axis)).sum(axis))
    return found
