"""Calibration: convert a machine's log-odds into the probabilities of the answers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference.elementary import logistic
from app.registry.description import Calibration

Floats = NDArray[np.floating[Any]]


@compiled
def bend(entry: Floats, logits: Floats) -> None:
    """Apply the bends of a calibration to log-odds (n,) in place, see `PairSlope`.

    Args:
        entry: (4 + 2K,), one row of a table in `RelationSlopes`.
    """
    for j in range(len(logits) if len(entry) > 4 else 0):
        x = y = logits[j]
        for k in range(4, len(entry), 2):
            y += entry[k + 1] * max(x - entry[k], np.float32(0.0))
        logits[j] = y


@compiled
def relation_probability(
    slopes: Floats, log_odds: Floats, log_count: Floats, classes: int
) -> Floats:
    """Probability that a relation holds between one pair of instances, (B, A, N).

    Args:
        slopes: (A, 4 + 2K), one table of `RelationSlopes`.
        log_odds: (B, A, N), log-odds of the class-level units.
        log_count: (N,), log of the number of instance pairs of both classes.
        classes: number of distinct classes in the scene.
    """
    p = np.empty_like(log_odds)
    size = np.log(classes)
    for a in range(p.shape[1]):
        slope, weight = slopes[a, 1], slopes[a, 2]
        intercept = np.float32(slopes[a, 0] + slopes[a, 3] * size)
        for b in range(len(p)):
            row, found = log_odds[b, a], p[b, a]
            for j in range(len(row)):
                found[j] = intercept + slope * row[j] + weight * log_count[j]
            bend(slopes[a], found)
    # One loop over all rows, since a single row may be short.
    logits = p.reshape(-1)
    for e in range(len(logits)):
        logits[e] = logistic(np.float32(logits[e]))
    return p


@inlined
def exclusive(forward: Floats, backward: Floats) -> tuple[Floats, Floats]:
    """Scale p(a(x,y)) and p(a(y,x)) so that their sum is at most 1: both cannot hold at once."""
    total = np.maximum(forward + backward, np.float32(1.0))
    return forward / total, backward / total


def placement_log_p(entry: Floats, log_p: Floats, log_count: float, classes: int) -> Floats:
    """Calibrate the machine's log p(relation | candidate and anchor are present).

    Args:
        entry: (4 + 2K,), the relation's row of a table in `RelationSlopes`.
        log_p: log probability of the class-level unit.
        log_count: log of the number of instances of the anchor's class.
        classes: number of distinct classes in the scene, the candidate included.
    """
    intercept, gain, weight, size = entry[:4]
    odds = log_p - np.log(-np.expm1(np.minimum(log_p, -1e-7)))
    logits = intercept + gain * odds + weight * log_count + size * math.log(classes)
    bend(entry, logits)
    found: Floats = -np.logaddexp(0.0, -logits)
    return found


def placed_logits(calibration: Calibration, log_odds: Floats, log_p: Floats, listed: int) -> Floats:
    """Logits of p(present but unlisted) · p(relation holds | present), one per candidate.

    Args:
        log_odds: log-odds of presence, not yet calibrated.
        log_p: log of the second factor, calibrated.
        listed: number of listed classes.
    """
    both = log_p - np.logaddexp(0.0, -calibration.missing.log_odds(log_odds, listed))
    found: Floats = both - np.log(-np.expm1(np.minimum(both, -1e-7)))
    return found


def intruder_line(calibration: Calibration, classes: int) -> tuple[float, float]:
    """Intercept and slope of an intruder's log-odds in a scene of `classes` distinct classes."""
    entry = calibration.outlier
    return entry.intercept + entry.log_count * math.log(classes), entry.slope


def false_log_odds(calibration: Calibration, log_odds: Floats) -> Floats:
    """Convert the log-odds of stated relations to the log-odds that each is false."""
    entry = calibration.misplaced
    return entry.intercept + entry.slope * log_odds
