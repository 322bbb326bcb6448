"""Fit the distribution of offsets (position differences) between related objects.

Each canonical relation and axis have a separate model. The offset from an object of class j to an
object of class i is normal, with a mean m and a variance s for each pair of classes:

    s ~ inverse-gamma(alpha, beta)    m given s ~ normal(mu + u_i + v_j, s / kappa)
    u_i and v_j given s ~ normal(0, s / (kappa lambda))

All pairs share mu, kappa, alpha and beta. Training alternates between these, by maximum likelihood,
and the class effects u and v. Given all these values, the offset of a pair has a closed form: data
decide for frequent pairs, and the classes and the relation for rare pairs.
`docs/decisions/relations.md` describes the alternatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln

from app.model import Offsets
from app.scene import CANONICAL
from training.datasets import EncodedScene
from training.datasets.cases import ObservedOffsets, observed_offsets

# Shrinkage of the class effects u and v. It acts like `LAMBDA` additional pairs with effect 0.
LAMBDA: Final = 4.0
# Minimum of alpha. With alpha <= 1, the variance of an unseen pair of classes is not finite.
_LEAST_ALPHA: Final = 1.5
# Minimum number of scenes for which a data source can lower the weights of larger sources.
_FEW: Final = 100
_ROUNDS, _SWEEPS = 4, 10
# Resolution of box centres in metres. It keeps the variance of equal heights above 0.
_RESOLUTION: Final = 0.005


def fit_offsets(scenes: Sequence[EncodedScene], V: int) -> Offsets | None:
    """Fit the distribution of offsets, with equal weights of sources; None without poses."""
    observed = observed_offsets(scenes)
    if not len(observed):
        return None
    A = len(CANONICAL)
    # Six columns: the means of x, y and z, and then their variances.
    relation, scenes_of = np.zeros((A, 6)), np.zeros(A, dtype=np.int32)
    effects = np.zeros((2, A, V, 6))
    pair, moments, counts = [], [], []
    for a in range(A):
        offsets = observed.rows(observed.relation == a)
        if not len(offsets):
            continue
        pairs = _pool_pairs(offsets)
        fit = _fit(pairs, V)
        relation[a], effects[:, a] = fit.tables()
        mean, variance = fit.predict(pairs)
        scenes_of[a] = len(np.unique(offsets.scene))
        pair.append((a * V + pairs.subject) * V + pairs.object)
        moments.append(np.concatenate([mean, np.sqrt(variance)], axis=1))
        counts.append(pairs.scenes.astype(np.int32))
    subject, object_ = half_precision(effects)
    return Offsets(
        relation=half_precision(relation),
        relation_scenes=scenes_of,
        subject=subject,
        object=object_,
        pair=np.concatenate(pair),
        pair_offset=half_precision(np.concatenate(moments)),
        pair_scenes=np.concatenate(counts),
    )


class _Pairs(NamedTuple):
    """P pairs of classes in one relation, with the moments of their offsets."""

    subject: Int[NDArray, "P"]  # sorted by subject, then by object
    object: Int[NDArray, "P"]
    scenes: Int[NDArray, "P"]  # number of scenes with the pair
    n: Float[NDArray, "P 1"]  # total weight of the offsets of the pair
    mean: Float[NDArray, "P 3"]  # weighted mean of the offsets
    scatter: Float[NDArray, "P 3"]  # weighted sum of squared deviations from the mean


def _pool_pairs(observed: ObservedOffsets) -> _Pairs:
    """Compute the moments of each pair of classes. Its offsets in a scene share the weight 1."""
    # `pair` is the number of the pair of classes of each offset.
    classes = np.stack([observed.subject, observed.other])
    (subject, object_), pair = np.unique(classes, axis=1, return_inverse=True)
    # Group the offsets by scene and pair of classes.
    _, first, group, size = np.unique(
        np.stack([pair, observed.scene]),
        axis=1, return_index=True, return_inverse=True, return_counts=True,
    )  # fmt: skip
    P, weight = len(subject), source_weights(observed.source, observed.scene) / size[group]
    weight = weight[:, None]
    n = _sums(pair, weight, P)
    mean = _sums(pair, weight * observed.offset, P) / n
    squares = np.square(observed.offset - mean[pair]) + _RESOLUTION**2
    scenes = np.bincount(pair[first], minlength=P)
    return _Pairs(subject, object_, scenes, n, mean, _sums(pair, weight * squares, P))


def _sums(
    group: Int[NDArray, "N"], values: Float[NDArray, "N k"], groups: int
) -> Float[NDArray, "groups k"]:
    """Return the sum of the values over each group of rows."""
    sums = np.zeros((groups, values.shape[1]))
    np.add.at(sums, group, values)
    return sums


def source_weights(source: Int[NDArray, "N"], scene: Int[NDArray, "N"]) -> Float[NDArray, "N"]:
    """Return weights that balance large and small data sources, given those of each item."""
    count = np.array([len(np.unique(scene[source == s])) for s in range(source.max() + 1)])
    least = count[count >= _FEW].min(initial=count.max())
    return np.minimum(1.0, least / np.maximum(count, 1))[source]


@dataclass(eq=False)
class _Fit:
    """Fitted parameters of one relation; the module describes them. Columns are x, y and z."""

    kappa: Float[NDArray, "3"]
    alpha: Float[NDArray, "3"]
    beta: Float[NDArray, "3"]
    mu: Float[NDArray, "3"]
    effects: Float[NDArray, "2 V 3"]  # u and v of the classes
    effect_variances: Float[NDArray, "2 V 3"]  # in units of s / kappa

    def expected(self, pairs: _Pairs) -> Float[NDArray, "P 3"]:
        """Return the prior mean of the offset of each pair."""
        u, v = self.effects
        return self.mu + u[pairs.subject] + v[pairs.object]

    def predict(self, pairs: _Pairs) -> tuple[Float[NDArray, "P 3"], Float[NDArray, "P 3"]]:
        """Return mean and variance of a new offset of each pair."""
        var_u, var_v = self.effect_variances
        # Uncertain class effects make the prior mean uncertain, which lowers its precision.
        kappa = self.kappa / (1 + var_u[pairs.subject] + var_v[pairs.object])
        prior = self.expected(pairs), kappa, self.alpha, self.beta
        return posterior(prior, pairs.n, pairs.mean, pairs.scatter)

    def tables(self) -> tuple[Float[NDArray, "6"], Float[NDArray, "2 V 6"]]:
        """Return tables whose sum gives mean and variance of a pair without data, as `predict`."""
        # The mean variance s, and the variance of the effect of a class without data. The entry of
        # the relation contains that of two such classes, and a class adds its difference.
        spread, unknown = self.beta / (self.alpha - 1), 1 / LAMBDA
        relation = np.concatenate([self.mu, spread * (1 + (1 + 2 * unknown) / self.kappa)])
        variances = spread * (self.effect_variances - unknown) / self.kappa
        return relation, np.concatenate([self.effects, variances], axis=2)


Prior = tuple[Any, Any, Any, Any]
"""Mean expected, kappa, alpha and beta of a normal–inverse-gamma prior."""


def posterior(prior: Prior, n: Any, mean: Any, scatter: Any) -> tuple[Any, Any]:
    """Return mean and variance of a new value given n values; alpha + n / 2 is above 1."""
    expected, kappa, _, _ = prior
    new_kappa, alpha, beta = _updated(prior, n, mean, scatter)
    return (kappa * expected + n * mean) / new_kappa, beta / (alpha - 1) * (1 + 1 / new_kappa)


def log_likelihood(prior: Prior, n: Any, mean: Any, scatter: Any) -> Any:
    """Return the log-likelihood of n values, with their mean and variance integrated out."""
    _, kappa, alpha, beta = prior
    new_kappa, new_alpha, new_beta = _updated(prior, n, mean, scatter)
    return (
        gammaln(new_alpha) - gammaln(alpha) + alpha * np.log(beta) - new_alpha * np.log(new_beta)
        + (np.log(kappa) - np.log(new_kappa) - n * np.log(2 * np.pi)) / 2
    )  # fmt: skip


def _updated(prior: Prior, n: Any, mean: Any, scatter: Any) -> tuple[Any, Any, Any]:
    """Return kappa, alpha and beta of the posterior."""
    expected, kappa, alpha, beta = prior
    new_kappa = kappa + n
    new_beta = beta + scatter / 2 + kappa * n * np.square(mean - expected) / (2 * new_kappa)
    return new_kappa, alpha + n / 2, new_beta


def _fit(pairs: _Pairs, V: int) -> _Fit:
    """Fit the parameters of one relation, by alternation between the prior and class effects."""
    start = (pairs.n * pairs.mean).sum(axis=0) / pairs.n.sum()
    prior = np.ones(3), np.full(3, 2.0), np.full(3, 0.1)
    fit = _Fit(*prior, start, *np.zeros((2, 2, V, 3)))
    for _ in range(_ROUNDS):
        expected = fit.expected(pairs)
        priors = [_fit_prior(pairs, axis, expected[:, axis]) for axis in range(3)]
        fit.kappa, fit.alpha, fit.beta = np.array(priors).T
        _fit_effects(fit, pairs, V)
    return fit


def _fit_prior(pairs: _Pairs, axis: int, expected: Float[NDArray, "P"]) -> Float[NDArray, "3"]:
    """Return kappa, alpha and beta of an axis by maximum likelihood, given the expected means."""

    # The logarithms of the parameters are optimised, so these stay positive.
    def loss(logs: NDArray[np.float64]) -> float:
        n, mean, scatter = pairs.n[:, 0], pairs.mean[:, axis], pairs.scatter[:, axis]
        return -float(log_likelihood((expected, *np.exp(logs)), n, mean, scatter).sum())

    bounds = [(-7.0, 7.0), (np.log(_LEAST_ALPHA), 7.0), (-12.0, 7.0)]
    return np.exp(minimize(loss, np.log([1.0, 2.0, 0.1]), bounds=bounds).x)


def _fit_effects(fit: _Fit, pairs: _Pairs, V: int) -> None:
    """Fit mu, u and v in turn by weighted least squares, with the ridge penalty `LAMBDA`."""
    subject, object_ = pairs.subject, pairs.object
    # Precision of the mean offset of each pair as a measurement of u and v, in units of kappa / s.
    weight = pairs.n / (pairs.n + fit.kappa)
    precision_u = _sums(subject, weight, V) + LAMBDA
    precision_v = _sums(object_, weight, V) + LAMBDA
    u, v = fit.effects
    for _ in range(_SWEEPS):
        residual = pairs.mean - u[subject] - v[object_]
        fit.mu = (weight * residual).sum(axis=0) / weight.sum(axis=0)
        u = _sums(subject, weight * (pairs.mean - fit.mu - v[object_]), V) / precision_u
        v = _sums(object_, weight * (pairs.mean - fit.mu - u[subject]), V) / precision_v
    fit.effects = np.stack([u, v])
    fit.effect_variances = 1 / np.stack([precision_u, precision_v])


def half_precision(table: Float[NDArray, "..."]) -> NDArray[np.float32]:
    """Round a table to half precision, the precision of the model file."""
    return table.astype(np.float16).astype(np.float32)
