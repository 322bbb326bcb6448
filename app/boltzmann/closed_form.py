"""Log-odds of a scene's objects and relations in closed form, compiled.

For a Triway machine of one layer in the local form, where no relation is given. There p(h1 | v) is
factorial, with means m = sigmoid(x), x = c1 + Q[t] + v'W. So

    object     log-odds_i = b_i + sum_k [softplus(x_k + W_ik) - softplus(x_k)]          exact
    relation   p(r_e = 1 | v) = E[sigmoid(ℓ_e(h1))],  ℓ_e(h1) = ℓ_e(m) + sum_k U_ek (h1_k - m_k)

The logit is a sum of many small independent terms, taken as normal with variance

    σ_e² = sum_k U_ek² m_k (1 - m_k) = y_e' C_a y_e,   C_a = F_a diag(m (1 - m)) F_a'

and the mean of its sigmoid by quadrature: three nodes of Gauss–Hermite where σ is small. U_e lies in the span of P[a] and the
rows of M[a]; y_e are its coordinates in the directions F_a that hold all but a thousandth of its
variance on scenes of the machine's own. Errors are measured in docs/decisions/estimators.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.boltzmann.elementary import exp, log, logistic
from app.boltzmann.fantasies import unpack_scenes
from app.boltzmann.machine import BoltzmannMachine
from app.boltzmann.scoring import group_size
from app.boltzmann.triway import Triway

Floats = NDArray[np.float32]
Classes = NDArray[np.int64]

LEAST_UNITS = 64
"""Fewer hidden units make no normal logit."""

# Of the variance of the logits, how much the directions F_a leave out.
_LEFT_OUT = 1e-3
_NO_UNIT = np.float32(-30.0)
_ROOT_3 = np.float32(3.0**0.5)
# Where three nodes are enough, as √3 σ.
_NARROW = np.float32(0.75 * 3.0**0.5)


class Weights(NamedTuple):
    """Weights of the relation part, as the compiled loops take them.

    Attributes:
        S, O: (V, K).  R: (A, K).  M: (A, K, H1).  P: (A, H1).  d: (A,).  s, o: (A, V).  n: (A, 2).
        start: (A·V + 1,) where the residuals of each (a, i) begin in
        column, residual: (T,) their j and w'.
        F: (A, r, H1) directions of U.
        Y0: (A, r), and Y: (A, r, K): the coordinates y = Y0 + Y (S_i * O_j) in them.
    """

    S: Floats
    O: Floats  # noqa: E741
    R: Floats
    M: Floats
    P: Floats
    d: Floats
    s: Floats
    o: Floats
    n: Floats
    start: Classes
    column: Classes
    residual: Floats
    F: Floats
    Y0: Floats
    Y: Floats


class ClosedForm:
    """What a machine of that kind says of scenes without given relations.

    The same scene gives the same bits, whatever is asked before, after or beside it.

    Args:
        machine: its weights are copied; later changes to them are not seen.

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, machine: BoltzmannMachine) -> None:
        if not isinstance(machine, Triway) or not self.fits(machine):
            raise ValueError("a closed form needs a local Triway of one wide layer in float32")
        self._group = group_size(machine.W)
        names = ("W", "b", "c1", "Q")
        self.W, self.b, self.c1, self.Q = (_array(getattr(machine, name)).copy() for name in names)
        self.weights = _weights(machine)

    @staticmethod
    def fits(machine: BoltzmannMachine) -> bool:
        """Whether the machine is one of those that this module is for."""
        spec = machine.spec
        return (
            isinstance(machine, Triway)
            and spec.form == "local"
            and spec.H2 == 0
            and spec.H1 >= LEAST_UNITS
            and str(machine.W.dtype) == "torch.float32"
            and group_size(machine.W) > 0
        )

    def hidden_logits(self, classes: Classes, confidence: Floats, room: int | None) -> Floats:
        """x, (H1,), of a scene.

        Args:
            classes: (n,) distinct.
            confidence: (n,) presence of each.
            room: index of the room type; None where it is not known.
        """
        bias = self.c1 if room is None or not len(self.Q) else self.c1 + self.Q[room]
        return _hidden_logits(bias, self.W, classes, confidence)

    def relation_log_odds(self, x: Floats, classes: Classes, log_counts: Floats) -> Floats:
        """Log-odds of all relations between the classes of a scene, (A, n, n)."""
        return _relation_log_odds(x, self.weights, classes, log_counts)

    def placement_log_odds(
        self, x: Floats, candidates: Classes, anchors: Classes, log_counts: Floats
    ) -> tuple[Floats, Floats]:
        """The same of each absent candidate, were it there: to the anchors and from them.

        Args:
            candidates: (N,) absent classes.
            anchors: (m,) present classes.
            log_counts: (m,) log of the instances of each anchor.

        Returns:
            (N, A, m) of relations from the candidate to an anchor, and of those back.
        """
        return _placement_log_odds(x, self.W, self.weights, candidates, anchors, log_counts)

    def placed_log_odds(
        self,
        x: Floats,
        candidates: Classes,
        relation: int,
        anchor: int,
        log_count: float,
        outgoing: bool,
    ) -> Floats:
        """One relation of many absent candidates, were they there, to one class, (N,).

        Args:
            outgoing: from the candidate to the anchor; otherwise back.
        """
        one = np.zeros(1, dtype=np.float32)
        count = np.array([log_count], dtype=np.float32)
        where = np.array([anchor], dtype=np.int64)
        arguments = (x, self.W, self.weights, candidates, where, relation, one, count, outgoing)
        return _placed_log_odds(*arguments)

    def leave_one_out(
        self,
        x: Floats,
        classes: Classes,
        share: Floats,
        rows: Classes,
        common: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """What the rest of a scene does for the log-odds of each of its classes.

        Args:
            share: (n, H1) what each class adds to x.
            rows: (N,) places in ``classes``.
            common: (N, n, H1) what two classes add only together; nothing by default.

        Returns:
            (n,) the gain of each class given all others; (N, n) the gain of the classes in ``rows``
            where one further class is left out. Its diagonal means nothing.
        """
        if common is None:
            common = np.zeros((0, 0, 0), dtype=np.float32)
        return _leave_one_out(x, self.W[classes], share, rows, common, self._group)


def _array(tensor: Any) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().numpy())


def _weights(machine: Triway) -> Weights:
    A, V = machine.spec.A, machine.spec.V
    names = ("S", "O", "R", "M", "P", "d", "s", "o", "n")
    F, Y = _directions(machine)
    keys = machine.triple_keys.numpy()
    return Weights(
        *(_array(getattr(machine, name)) for name in names),
        start=np.searchsorted(keys, np.arange(A * V + 1) * V),
        column=keys % V,
        residual=_array(machine.residual),
        F=F,
        Y0=np.ascontiguousarray(Y[:, :, 0]),
        Y=np.ascontiguousarray(Y[:, :, 1:]),
    )


def _directions(machine: Triway) -> tuple[Floats, Floats]:
    """F (A, r, H1), and Y (A, r, 1 + K) with y = Y (1, S_i * O_j).

    Directions of largest variance of U_e h1, over pairs of classes as often as the machine's
    fantasies have them, and with h1 as it is in these.
    """
    spec = machine.spec
    S, O = (_array(weights).astype(np.float64) for weights in (machine.S, machine.O))  # noqa: E741
    rows = np.concatenate([_array(machine.P)[:, None], _array(machine.M)], 1).astype(np.float64)
    share, spread = np.ones(spec.V), np.full(spec.H1, 0.25)
    if spec.N:
        scenes = unpack_scenes(machine.fantasies, spec.V)
        share = scenes.mean(0).double().numpy()
        mean = (machine.c1 + scenes @ machine.W).sigmoid().double().numpy()
        spread = (mean * (1 - mean)).mean(0)
    share = share / share.sum()
    ones = np.ones((spec.V, 1))
    left, right = (np.concatenate([ones, factors], 1) for factors in (S, O))
    # E[z z'] of z = (1, S_i * O_j) for independent i and j, and its root.
    moment = (left.T @ (share[:, None] * left)) * (right.T @ (share[:, None] * right))
    scale = np.trace(moment) / len(moment)
    root = np.linalg.cholesky(moment + 1e-9 * scale * np.eye(len(moment)))
    covariance = root.T @ ((rows * spread) @ rows.transpose(0, 2, 1)) @ root
    values, vectors = np.linalg.eigh(covariance)
    left_out = np.cumsum(values.clip(min=0), axis=1) / values.clip(min=1e-30).sum(1, keepdims=True)
    kept = max(1, int((left_out > _LEFT_OUT).sum(1).max()))
    vectors = vectors[:, :, -kept:]
    Y = np.linalg.solve(root.T, vectors).transpose(0, 2, 1)
    F = vectors.transpose(0, 2, 1) @ root.T @ rows
    return F.astype(np.float32), Y.astype(np.float32)


# Sums may be taken in any order, so that the compiler can take eight terms at a time. It chooses one
# order, once. exp and log must stay out of such functions: their cancellations are meant.
ANY_ORDER = {"reassoc", "contract"}


@njit(inline="always")
def _dot(a, b):
    total = np.float32(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def _hidden_logits(bias, W, classes, confidence):
    x = bias.copy()
    for i in range(len(classes)):
        row, presence = W[classes[i]], confidence[i]
        for k in range(len(x)):
            x[k] += presence * row[k]
    return x


@njit(nogil=True, cache=True, error_model="numpy", fastmath=ANY_ORDER)
def _moments(mean, w, first, last):
    """What all units of relations first to last - 1 share: R + M m, d + P·m, and C."""
    A, K, H1 = w.M.shape
    r = w.F.shape[1]
    shared, bias = np.empty((A, K), np.float32), np.empty(A, np.float32)
    C, spread = np.empty((A, r, r), np.float32), np.empty(H1, np.float32)
    for a in range(first, last):
        M_a, F_a = w.M[a], w.F[a]
        for k in range(K):
            shared[a, k] = w.R[a, k] + _dot(M_a[k], mean)
        bias[a] = w.d[a] + _dot(w.P[a], mean)
        for p in range(r):
            row = F_a[p]
            for h in range(H1):
                spread[h] = row[h] * (mean[h] * (np.float32(1.0) - mean[h]))
            for q in range(p + 1):
                C[a, p, q] = _dot(spread, F_a[q])
    return shared, bias, C


@njit(inline="always", error_model="numpy")
def residual_of(w, a, i, j):
    """w' of (a, i, j), 0 where there is none."""
    row = a * len(w.S) + i
    low, high = w.start[row], w.start[row + 1]
    while low < high:
        middle = (low + high) // 2
        if w.column[middle] < j:
            low = middle + 1
        else:
            high = middle
    if low < w.start[row + 1] and w.column[low] == j:
        return w.residual[low]
    return np.float32(0.0)


@njit(inline="always", error_model="numpy")
def _log_odds(mean, spread):
    """log-odds of E[sigmoid(ℓ)] for a normal ℓ, by three nodes: 0 and ±√3 σ with weights 4 : 1 : 1.

    Off by .0003 at most in p where √3 σ < `_NARROW`.
    """
    on = np.float32(4.0) * logistic(mean) + logistic(mean + spread) + logistic(mean - spread)
    off = np.float32(4.0) * logistic(-mean) + logistic(-mean - spread) + logistic(spread - mean)
    return log(on) - log(off)


@njit(nogil=True, cache=True, error_model="numpy")
def _log_odds_of_wide(mean, spread):
    """The same by the trapezoidal rule, for any σ up to 10 and more."""
    on, off = np.float32(0.0), np.float32(0.0)
    for node in range(-20, 21):
        t = np.float32(0.25) * np.float32(node)
        weight = exp(np.float32(-0.5) * t * t)
        logit = mean + t * spread / _ROOT_3
        on += weight * logistic(logit)
        off += weight * logistic(-logit)
    return log(on) - log(off)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=ANY_ORDER)
def _normal(moments, w, first, subjects, log_subjects, objects, log_objects, mean, spread):
    """Mean and √3 σ of the logits of all units from subjects to objects, (relations, n, m)."""
    shared, bias, C = moments
    K, r = shared.shape[1], C.shape[1]
    z, y = np.empty(K, np.float32), np.empty(r, np.float32)
    # Rows by name: an index that may be negative keeps the compiler from taking eight at a time.
    for a in range(first, first + len(mean)):
        shared_a, C_a, Y_a, Y0_a = shared[a], C[a], w.Y[a], w.Y0[a]
        for i in range(len(subjects)):
            subject = subjects[i]
            S_i = w.S[subject]
            base = bias[a] + w.s[a, subject] + w.n[a, 0] * log_subjects[i]
            for j in range(len(objects)):
                other = objects[j]
                total = base + w.o[a, other] + w.n[a, 1] * log_objects[j]
                total += residual_of(w, a, subject, other)
                dot = np.float32(0.0)
                O_j = w.O[other]
                for k in range(K):
                    z[k] = S_i[k] * O_j[k]
                for k in range(K):
                    dot += z[k] * shared_a[k]
                mean[a - first, i, j] = total + dot
                variance = np.float32(0.0)
                for p in range(r):
                    dot, row = Y0_a[p], Y_a[p]
                    for k in range(K):
                        dot += z[k] * row[k]
                    y[p] = dot
                    cross = np.float32(0.0)
                    for q in range(p):
                        cross += C_a[p, q] * y[q]
                    variance += dot * (np.float32(2.0) * cross + C_a[p, p] * dot)
                spread[a - first, i, j] = np.sqrt(np.float32(3.0) * max(variance, np.float32(0.0)))


@njit(nogil=True, cache=True, error_model="numpy")
def _fill(moments, w, first, subjects, log_subjects, objects, log_objects, out):
    """Log-odds of all units from subjects to objects into out (relations, n, m)."""
    spread = np.empty(out.shape, np.float32)
    _normal(moments, w, first, subjects, log_subjects, objects, log_objects, out, spread)
    means, spreads = out.reshape(-1), spread.reshape(-1)
    # All of them without a branch, many at a time; then the few wide ones again.
    narrow = np.empty(len(means), np.float32)
    for e in range(len(means)):
        narrow[e] = _log_odds(means[e], spreads[e])
    for e in range(len(means)):
        if spreads[e] >= _NARROW:
            narrow[e] = _log_odds_of_wide(means[e], spreads[e])
    for e in range(len(means)):
        means[e] = max(narrow[e], _NO_UNIT)


@njit(inline="always", error_model="numpy")
def _means(x):
    mean = np.empty(len(x), np.float32)
    for k in range(len(x)):
        mean[k] = logistic(x[k])
    return mean


@njit(nogil=True, cache=True, error_model="numpy")
def _relation_log_odds(x, w, classes, log_counts):
    n = len(classes)
    out = np.empty((len(w.d), n, n), np.float32)
    moments = _moments(_means(x), w, 0, len(w.d))
    _fill(moments, w, 0, classes, log_counts, classes, log_counts, out)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _placement_log_odds(x, W, w, candidates, anchors, log_counts):
    A, m = len(w.d), len(anchors)
    forward = np.empty((len(candidates), A, 1, m), np.float32)
    backward = np.empty((len(candidates), A, m, 1), np.float32)
    one = np.zeros(1, np.float32)
    for c in range(len(candidates)):
        # p(h1 | v and the candidate): as factorial as without it.
        moments = _moments(_means(x + W[candidates[c]]), w, 0, A)
        candidate = candidates[c : c + 1]
        _fill(moments, w, 0, candidate, one, anchors, log_counts, forward[c])
        _fill(moments, w, 0, anchors, log_counts, candidate, one, backward[c])
    return forward[:, :, 0], backward[:, :, :, 0]


@njit(nogil=True, cache=True, error_model="numpy")
def _placed_log_odds(x, W, w, candidates, anchor, relation, one, log_count, outgoing):
    out, unit = np.empty(len(candidates), np.float32), np.empty((1, 1, 1), np.float32)
    for c in range(len(candidates)):
        moments = _moments(_means(x + W[candidates[c]]), w, relation, relation + 1)
        candidate = candidates[c : c + 1]
        if outgoing:
            _fill(moments, w, relation, candidate, one, anchor, log_count, unit)
        else:
            _fill(moments, w, relation, anchor, log_count, candidate, one, unit)
        out[c] = unit[0, 0, 0]
    return out


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
def _leave_one_out(x, W, share, rows, common, group):
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
