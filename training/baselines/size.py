"""How many numbers a baseline has learnt, where that says something."""

from __future__ import annotations

from training.baselines.linear import LinearScore
from training.baselines.masked_sets import NetworkScore
from training.evaluation.missing import MachineScore


def parameter_count(score: object) -> int | None:
    """Trained weights of a score, those of a linear one that are not zero.

    None for tables of counts and stored scenes, most of whose entries are back-off.
    """
    if isinstance(score, LinearScore):
        return len(score.bias) + int(score.weights.count_nonzero())
    if isinstance(score, NetworkScore):
        return sum(parameter.numel() for parameter in score.network.parameters())
    if isinstance(score, MachineScore):
        return score.machine.parameter_count
    return None
