"""From a machine's log-odds to the probabilities that the answers promise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.registry.description import Calibration, PairSlope

Floats = NDArray[np.floating[Any]]


def sigmoid(x: Floats) -> Floats:
    """1 / (1 + e^-x); beyond ±80 as there."""
    p: Floats = 1.0 / (1.0 + np.exp(-np.clip(x, -80.0, 80.0)))
    return p


def softmax(scores: Floats) -> Floats:
    """e^s over its sum, for scores (N,)."""
    weight = np.exp(scores - scores.max())
    found: Floats = weight / weight.sum()
    return found


def relation_slopes(calibration: Calibration, *, given: bool) -> tuple[PairSlope, ...]:
    """The entries for scenes of which some relations are given, or none."""
    return (given and calibration.relation_given) or calibration.relation


def relation_probability(
    entries: tuple[PairSlope, ...], log_odds: Floats, log_count: Floats, classes: int
) -> Floats:
    """Probability that a relation is listed for one pair of instances.

    Args:
        entries: one a relation; see `relation_slopes`.
        log_odds: (..., A, n, m) of the class-level units.
        log_count: (n, m), log of the instance pairs of both classes.
        classes: how many distinct ones the scene has.
    """
    size = float(np.log(classes))
    table = np.array(
        [(e.intercept + e.log_classes * size, e.slope, e.log_count) for e in entries],
        dtype=log_odds.dtype,
    )
    intercept, slope, weight = table.T[:, :, None, None]
    return sigmoid(intercept + slope * log_odds + weight * log_count)


def exclusive(forward: Floats, backward: Floats) -> tuple[Floats, Floats]:
    """Scale p(a(x,y)) and p(a(y,x)), which exclude each other, down to a sum of at most 1."""
    total = np.maximum(forward + backward, 1.0)
    return forward / total, backward / total


def missing_scores(calibration: Calibration, log_odds: Floats) -> Floats:
    """Logits of "this class was taken away"."""
    return log_odds / calibration.missing_temperature


def placed_scores(calibration: Calibration, log_odds: Floats, log_p: Floats) -> Floats:
    """Logits of "this class was taken away from there", log_p of the relation that says where."""
    placed = log_odds / calibration.placed_temperature
    return placed + calibration.placed_relation_weight * log_p


def intruder_log_odds(calibration: Calibration, log_odds: Floats, classes: int) -> Floats:
    """Log-odds of being an intruder in a scene of so many distinct classes."""
    entry = calibration.outlier
    return entry.intercept + entry.slope * log_odds + entry.log_count * float(np.log(classes))


def false_log_odds(calibration: Calibration, log_odds: Floats) -> Floats:
    """Log-odds of a stated relation being false."""
    entry = calibration.misplaced
    return entry.intercept + entry.slope * log_odds
