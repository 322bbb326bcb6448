"""Logistic regressions and quantiles, the common parts of all calibrations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from typing import Any, Final, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from app.model import CountSlope, SceneModel

T = TypeVar("T")

RIDGE: Final = 1.0
"""`C` of `logistic` for a few unweighted examples, such as those of 20 validation scenes."""

LEAST_SCENES: Final = 20
"""Minimum number of validation scenes of a fit. With fewer scenes, the default stays."""


def structure_of(artifact: SceneModel) -> Bool[Tensor, "V"]:
    """Return True for the structural classes of a model."""
    return torch.from_numpy(artifact.vocabulary.structure.copy())


def recalibrated(artifact: SceneModel, **entries: Any) -> SceneModel:
    """Return a copy of the model in which some entries of the calibration are replaced."""
    return replace(artifact, calibration=artifact.calibration.model_copy(update=entries))


def logistic(
    features: Float[NDArray, "N k"],
    truth: Bool[NDArray, "N"],
    weight: Float[NDArray, "N"] | None = None,
    C: float = 1e6,
) -> list[float]:
    """Return coefficients and then the intercept; C is the inverse of the ridge penalty."""
    from sklearn.linear_model import LogisticRegression  # slow to import

    fit = LogisticRegression(C=C, max_iter=1000).fit(features, truth, weight)
    return [float(x) for x in (*fit.coef_[0], fit.intercept_[0])]


def fit_count_slope(
    log_odds: Float[NDArray, "N"],
    log_count: Float[NDArray, "N"],
    truth: Bool[NDArray, "N"],
    weight: Float[NDArray, "N"] | None = None,
    C: float = RIDGE,
) -> CountSlope | None:
    """Regress the truth on log-odds and the log of an object count; None for a constant truth."""
    if len(np.unique(truth)) < 2:
        return None
    slope, count, intercept = logistic(np.stack([log_odds, log_count], 1), truth, weight, C)
    return CountSlope(intercept=intercept, slope=slope, log_count=count)


def quantile_of(values: Float[NDArray, "N"], weights: Float[NDArray, "N"], share: float) -> float:
    """Return the smallest value below or at which the given share of the weights lies."""
    return float(np.quantile(values, share, weights=weights, method="inverted_cdf"))


def at_most(items: Iterable[T], key: Callable[[T], Hashable], most: int) -> list[T]:
    """Return the items without those that follow `most` items of the same key."""
    counts, kept = Counter[Hashable](), []
    for item in items:
        counts[key(item)] += 1
        if counts[key(item)] <= most:
            kept.append(item)
    return kept
