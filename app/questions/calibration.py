"""Calibration: convert a machine's log-odds into the probabilities of the answers.

Validation scenes determine the coefficients. They are fields of
`app.registry.description.Calibration`. `RelationSlopes` contains the coefficients of relations as
tables with one row for each relation. A row has intercept, slope, log_count, log_classes, and K
bends (at, change).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference.elementary import logistic
from app.registry.description import Calibration, CountSlope, Slope

Floats = NDArray[np.floating[Any]]


@compiled
def bend(entry: Floats, logits: Floats) -> None:
    """Add change·(x - at) to each log-odds x above ``at``, for each bend of a relation, in place.

    Args:
        entry: (4 + 2K,) row of the relation in a table of `RelationSlopes`.
        logits: (n,) log-odds x.
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
    """Return the probability that each relation holds between two objects, (B, A, N).

    The shape is (B candidate classes, A relations, N pairs of classes). B is 1 without candidates.

    Args:
        slopes: (A, 4 + 2K) table of `RelationSlopes`.
        log_odds: (B, A, N) log-odds of the relation between classes.
        log_count: (N,) log of the number of object pairs with these two classes.
        classes: number of distinct classes in the scene.
    """
    p = np.empty_like(log_odds)
    size = np.log(classes)
    for a in range(p.shape[1]):
        slope, weight = slopes[a, 1], slopes[a, 2]
        intercept = np.float32(slopes[a, 0] + slopes[a, 3] * size)
        for b in range(len(p)):
            row, logits = log_odds[b, a], p[b, a]
            for j in range(len(row)):
                logits[j] = intercept + slope * row[j] + weight * log_count[j]
            bend(slopes[a], logits)
    # One loop over all rows is faster than one loop per row, because a row may be short.
    flat = p.reshape(-1)
    for e in range(len(flat)):
        flat[e] = logistic(np.float32(flat[e]))
    return p


@inlined
def exclusive(forward: Floats, backward: Floats) -> tuple[Floats, Floats]:
    """Scale p(a(x,y)) and p(a(y,x)) so that their sum is at most 1.

    The reason is that a relation a cannot hold in both directions between the same two objects.
    """
    total = np.maximum(forward + backward, np.float32(1.0))
    return forward / total, backward / total


def calibrated(entry: CountSlope, z: Floats, n: int | NDArray[np.integer[Any]]) -> Floats:
    """Return the calibrated log-odds of N logits, (N,); see `CountSlope` for the formula.

    Args:
        entry: calibration of a question.
        z: (N,) logits.
        n: number n of the formula, or an array (N,) with a number for each logit.
    """
    log_odds: Floats = entry.intercept + entry.log_count * np.log(n) + entry.slope * z
    return log_odds


def placement_log_p(entry: Floats, log_p: Floats, log_count: float, classes: int) -> Floats:
    """Calibrate log p(relation to the anchor | candidate is present) of N candidate classes, (N,).

    Args:
        entry: (4 + 2K,) row of the relation in a table of `RelationSlopes`.
        log_p: (N,) log probability of the relation between the classes, not yet calibrated.
        log_count: log of the number of instances of the anchor's class.
        classes: number of distinct classes in the scene, the candidate included.
    """
    intercept, gain, weight, size = entry[:4]
    odds = log_p - np.log(-np.expm1(np.minimum(log_p, -1e-7)))
    logits = intercept + gain * odds + weight * log_count + size * math.log(classes)
    bend(entry, logits)
    log_probability: Floats = -np.logaddexp(0.0, -logits)
    return log_probability


def placed_logits(calibration: Calibration, log_odds: Floats, log_p: Floats, listed: int) -> Floats:
    """Return the logits of p(present but unlisted) · p(relation holds | present), (N,).

    Args:
        calibration: calibration of the model.
        log_odds: (N,) log-odds that each candidate class is present, not yet calibrated.
        log_p: (N,) calibrated log p(relation holds | present) of each candidate class.
        listed: number of classes that the scene lists.
    """
    both = log_p - np.logaddexp(0.0, -calibrated(calibration.missing, log_odds, listed))
    logits: Floats = both - np.log(-np.expm1(np.minimum(both, -1e-7)))
    return logits


def false_log_odds(entry: Slope, log_odds: Floats) -> Floats:
    """Convert the log-odds that stated relations hold to the log-odds that they are false.

    `entry` is `Calibration.misplaced`.
    """
    return entry.intercept + entry.slope * log_odds
