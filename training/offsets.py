"""Offsets of placements, learnt from scenes with poses.

Of a canonical relation, and on each axis alone, the offset of a thing of class i from one of class
j is normal, with a mean m and a variance s of the pair's own:

    s ~ inverse-gamma(alpha, beta)    m given s ~ normal(mu + u_i + v_j, s / kappa)
    u_i and v_j given s ~ normal(0, s / (kappa lambda))

mu, kappa, alpha and beta belong to the relation and the axis. They maximise the likelihood of all
pairs in turn with the effects u and v of the classes, which their pairs tell together. Given all
that, a pair's offset is known in closed form: much seen, it rests on the pair; little or never
seen, on its classes and its relation. `docs/decisions/offsets.md` holds what else was tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln

from app.registry import Offsets
from app.scene import CANONICAL
from training.datasets import EncodedScene

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Shrinks the effect of a class: as if so many more of its pairs had shown none.
LAMBDA: Final = 4.0
# Below 1 a pair of which nothing is known has no variance to speak of.
_LEAST_ALPHA: Final = 1.5
# A source of fewer scenes is too small for the others to be weighed down to it.
_FEW: Final = 100
_ROUNDS, _SWEEPS = 4, 10
# Of a box's centre as annotated, in metres; without it equal heights would have no variance.
_RESOLUTION: Final = 0.005


@dataclass(frozen=True, eq=False)
class Seen:
    """N offsets between things that stand in a relation.

    Attributes:
        offset: (N, 3) metres from the relation's object to its subject, in viewer axes.
        relation, subject, other: (N,) canonical relation, and the two classes.
        scene: (N,) position of the scene; source: (N,) number of its source.
    """

    offset: Floats
    relation: Ints
    subject: Ints
    other: Ints
    scene: Ints
    source: Ints

    def some(self, some: NDArray[np.bool_]) -> Seen:
        """A part of them, (N,) bool."""
        return Seen(*(getattr(self, name)[some] for name in self.__dataclass_fields__))


def seen_offsets(scenes: Sequence[EncodedScene]) -> Seen:
    """The offsets between all things of scenes with poses that stand in a relation."""
    sources = sorted({scene.source for scene in scenes})
    offsets, rows = [np.zeros((0, 3))], [np.zeros((0, 5), dtype=np.int64)]
    for place, scene in enumerate(scenes):
        if scene.instance_positions is None:
            continue
        relation, i, j = np.nonzero(scene.instance_holds)
        offset = scene.instance_positions[i] - scene.instance_positions[j]
        known = np.isfinite(offset).all(axis=1)
        classes = scene.instance_classes
        where = np.full(len(i), place), np.full(len(i), sources.index(scene.source))
        offsets.append(offset[known])
        rows.append(np.stack([relation, classes[i], classes[j], *where], axis=1)[known])
    return Seen(np.concatenate(offsets), *np.concatenate(rows).T)


def fit_offsets(scenes: Sequence[EncodedScene], V: int) -> Offsets | None:
    """What scenes teach of V classes; None where none of them has poses.

    The things of a scene are no independent witnesses: those of one pair weigh one together. And
    every source weighs as much as the others, since boxes of one world are alike beyond chance.
    """
    seen = seen_offsets(scenes)
    if not len(seen.offset):
        return None
    A = len(CANONICAL)
    relation, scenes_of = np.zeros((A, 6)), np.zeros(A, dtype=np.int32)
    subject, other = np.zeros((A, V, 6)), np.zeros((A, V, 6))
    pair = [np.zeros(0, dtype=np.int64)]
    known, counts = [np.zeros((0, 6))], [np.zeros(0, dtype=np.int32)]
    for a in range(A):
        some = seen.some(seen.relation == a)
        if not len(some.offset):
            continue
        pairs = _pairs(some)
        fit = _fit(pairs, V)
        relation[a], subject[a], other[a] = fit.tables()
        mean, variance = fit.predict(pairs)
        scenes_of[a] = len(np.unique(some.scene))
        pair.append((a * V + pairs.subject) * V + pairs.other)
        known.append(np.concatenate([mean, np.sqrt(variance)], axis=1))
        counts.append(pairs.scenes.astype(np.int32))
    return Offsets(
        *(_stored(relation), scenes_of, _stored(subject), _stored(other)),
        *(np.concatenate(pair), _stored(np.concatenate(known)), np.concatenate(counts)),
    )


class Pairs(NamedTuple):
    """P pairs of classes in one relation, each by the moments of its offsets.

    Attributes:
        subject, other: (P,) classes, ascending by subject, then by object.
        scenes: (P,) how many scenes showed it.
        n: (P, 1) what these weigh.
        mean: (P, 3) of the offsets; scatter: (P, 3) weighted sum of squares around it.
    """

    subject: Ints
    other: Ints
    scenes: Ints
    n: Floats
    mean: Floats
    scatter: Floats


def _pairs(seen: Seen) -> Pairs:
    classes = np.stack([seen.subject, seen.other], axis=1)
    found, pair = np.unique(classes, axis=0, return_inverse=True)
    pair = pair.reshape(-1)
    # Things of one pair in one scene.
    _, first, group, size = np.unique(
        np.stack([pair, seen.scene]),
        axis=1,
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    weight = _balance(seen) / size[group.reshape(-1)]
    P, weights = len(found), weight[:, None]
    n = _sums(pair, weights, P)
    mean = _sums(pair, weights * seen.offset, P) / n
    squares = np.square(seen.offset - mean[pair]) + _RESOLUTION**2
    subject, other = found.T
    scenes = np.bincount(pair[first], minlength=P)
    return Pairs(subject, other, scenes, n, mean, _sums(pair, weights * squares, P))


def _sums(group: Ints, values: Floats, groups: int) -> Floats:
    """(G, k) sums of values (N, k) over each group."""
    found = np.zeros((groups, values.shape[1]))
    np.add.at(found, group, values)
    return found


def _balance(seen: Seen) -> Floats:
    """(N,) the weight of each one's source: that of its scenes if the sources had equally many."""
    count = np.array(
        [len(np.unique(seen.scene[seen.source == s])) for s in range(seen.source.max() + 1)]
    )
    least = count[count >= _FEW].min(initial=count.max())
    weight: Floats = np.minimum(1.0, least / np.maximum(count, 1))[seen.source]
    return weight


@dataclass(eq=False)
class _Fit:
    """What is known of one relation; all of the last axis are x, y and z.

    Attributes:
        kappa, alpha, beta, mu: (3,); u, v: (V, 3).
        doubt_u, doubt_v: (V, 3) variances of u and v, as parts of s / kappa.
    """

    kappa: Floats
    alpha: Floats
    beta: Floats
    mu: Floats
    u: Floats
    v: Floats
    doubt_u: Floats
    doubt_v: Floats

    def expected(self, pairs: Pairs) -> Floats:
        """(P, 3) where the offset of a pair is expected before it was seen."""
        return self.mu + self.u[pairs.subject] + self.v[pairs.other]

    def predict(self, pairs: Pairs) -> tuple[Floats, Floats]:
        """Mean and variance, (P, 3), of the next offset of each pair."""
        kappa = self.kappa / (1 + self.doubt_u[pairs.subject] + self.doubt_v[pairs.other])
        return posterior(
            *(self.expected(pairs), kappa, self.alpha, self.beta),
            *(pairs.n, pairs.mean, pairs.scatter),
        )

    def tables(self) -> tuple[Floats, Floats, Floats]:
        """Mean and variance of pairs never seen: (6,) of unknown classes, (V, 6) what each adds.

        The same as `predict` of nothing, which is a sum over the two classes.
        """
        spread = self.beta / (self.alpha - 1)
        unknown = 1 / LAMBDA
        relation = np.concatenate([self.mu, spread * (1 + (1 + 2 * unknown) / self.kappa)])
        subject, other = (
            np.concatenate([effect, spread * (doubt - unknown) / self.kappa], axis=1)
            for effect, doubt in ((self.u, self.doubt_u), (self.v, self.doubt_v))
        )
        return relation, subject, other


def posterior(
    expected: Floats,
    kappa: Floats,
    alpha: Floats,
    beta: Floats,
    n: Floats,
    mean: Floats,
    scatter: Floats,
) -> tuple[Floats, Floats]:
    """Mean and variance of the next draw after n, under the normal–inverse-gamma prior.

    Args:
        expected, kappa, alpha, beta: of the prior; alpha + n / 2 must be above 1.
        n, mean, scatter: how many were drawn, their mean, and their squares around it.
    """
    after = kappa + n
    rate = beta + scatter / 2 + kappa * n * np.square(mean - expected) / (2 * after)
    variance = rate / (alpha + n / 2 - 1) * (1 + 1 / after)
    return (kappa * expected + n * mean) / after, variance


def log_likelihood(
    expected: Floats,
    kappa: float,
    alpha: float,
    beta: float,
    n: Floats,
    mean: Floats,
    scatter: Floats,
) -> Floats:
    """Of the draws, mean and variance integrated out; see `posterior`."""
    after, shape = kappa + n, alpha + n / 2
    rate = beta + scatter / 2 + kappa * n * np.square(mean - expected) / (2 * after)
    found: Floats = (
        gammaln(shape) - gammaln(alpha) + alpha * np.log(beta) - shape * np.log(rate)
        + (np.log(kappa) - np.log(after) - n * np.log(2 * np.pi)) / 2
    )  # fmt: skip
    return found


def _fit(pairs: Pairs, V: int) -> _Fit:
    """Hyperparameters and effects of one relation, in turn."""
    nothing = np.zeros((V, 3))
    start = (pairs.n * pairs.mean).sum(axis=0) / pairs.n.sum()
    fit = _Fit(
        np.ones(3), np.full(3, 2.0), np.full(3, 0.1), start, nothing, nothing, nothing, nothing
    )
    for _ in range(_ROUNDS):
        expected = fit.expected(pairs)
        found = [_hyperparameters(pairs, axis, expected[:, axis]) for axis in range(3)]
        fit.kappa, fit.alpha, fit.beta = np.array(found).T
        _effects(fit, pairs, V)
    return fit


def _hyperparameters(pairs: Pairs, axis: int, expected: Floats) -> Floats:
    """kappa, alpha and beta of one axis."""

    def loss(logs: Floats) -> float:
        kappa, alpha, beta = np.exp(logs)
        n, mean, scatter = pairs.n[:, 0], pairs.mean[:, axis], pairs.scatter[:, axis]
        return -float(log_likelihood(expected, kappa, alpha, beta, n, mean, scatter).sum())

    bounds = [(-7.0, 7.0), (np.log(_LEAST_ALPHA), 7.0), (-12.0, 7.0)]
    found: Floats = np.exp(minimize(loss, np.log([1.0, 2.0, 0.1]), bounds=bounds).x)
    return found


def _effects(fit: _Fit, pairs: Pairs, V: int) -> None:
    """mu, u and v given the rest: each in turn the mean of what the others leave, shrunk."""
    # What a pair's own mean tells of the effects, next to s / kappa.
    weight = pairs.n / (pairs.n + fit.kappa)

    below_u = _sums(pairs.subject, weight, V) + LAMBDA
    below_v = _sums(pairs.other, weight, V) + LAMBDA
    for _ in range(_SWEEPS):
        rest = pairs.mean - fit.u[pairs.subject] - fit.v[pairs.other]
        fit.mu = (weight * rest).sum(axis=0) / weight.sum(axis=0)
        rest = pairs.mean - fit.mu
        fit.u = _sums(pairs.subject, weight * (rest - fit.v[pairs.other]), V) / below_u
        fit.v = _sums(pairs.other, weight * (rest - fit.u[pairs.subject]), V) / below_v
    fit.doubt_u, fit.doubt_v = 1 / below_u, 1 / below_v


def _stored(table: Floats) -> NDArray[np.float32]:
    """In half precision, as artifacts keep it."""
    return table.astype(np.float16).astype(np.float32)
