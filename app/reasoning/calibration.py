"""From a machine's log-odds to the probabilities that the answers promise."""

from __future__ import annotations

import torch
from torch import Tensor

from app.registry.description import Calibration


def relation_probability(calibration: Calibration, log_odds: Tensor, log_count: Tensor) -> Tensor:
    """Probability that a relation is listed for one pair of instances.

    Args:
        log_odds: (..., A, n, m) of the class-level units.
        log_count: (n, m), log of the instance pairs of both classes.
    """
    entries = calibration.relation
    table = [(entry.intercept, entry.slope, entry.log_count) for entry in entries]
    intercept, slope, weight = log_odds.new_tensor(table).T[..., None, None].unbind(0)
    return torch.sigmoid(intercept + slope * log_odds + weight * log_count)


def exclusive(forward: Tensor, backward: Tensor) -> tuple[Tensor, Tensor]:
    """Scale p(a(x,y)) and p(a(y,x)), which exclude each other, down to a sum of at most 1."""
    total = (forward + backward).clamp(min=1.0)
    return forward / total, backward / total


def missing_scores(calibration: Calibration, log_odds: Tensor) -> Tensor:
    """Logits of "this class was taken away"."""
    return log_odds / calibration.missing_temperature


def placed_scores(calibration: Calibration, log_odds: Tensor, log_p: Tensor) -> Tensor:
    """Logits of "this class was taken away from there", log_p of the relation that says where."""
    placed = log_odds / calibration.placed_temperature
    return placed + calibration.placed_relation_weight * log_p


def intruder_log_odds(calibration: Calibration, log_odds: Tensor, classes: int) -> Tensor:
    """Log-odds of being an intruder in a scene of so many distinct classes."""
    entry = calibration.outlier
    size = torch.tensor(float(classes), dtype=log_odds.dtype).log()
    return entry.intercept + entry.slope * log_odds + entry.log_count * size


def false_log_odds(calibration: Calibration, log_odds: Tensor) -> Tensor:
    """Log-odds of a stated relation being false."""
    entry = calibration.misplaced
    return entry.intercept + entry.slope * log_odds
