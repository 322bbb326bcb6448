"""Co-occurrence: Bernoulli naive Bayes over the other classes that are present.

    log-odds of i = logit p(i) + t · sum_{j present} log p(j | i) / p(j | not i)

Classes that are absent are not counted as evidence: most of them were merely not mentioned.
Evidence from classes that go together is counted many times over, which the exponent t < 1 tempers.
"""

from __future__ import annotations

from torch import Tensor

from training.baselines.fitting import Proposals
from training.baselines.linear import LinearScore
from training.baselines.popularity import frequency
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore

_SMOOTHING = (10.0, 100.0, 300.0)
_EXPONENTS = (0.2, 0.3, 0.5, 1.0)


def evidence(v: Tensor, smoothing: float) -> Tensor:
    """log p(j | i) / p(j | not i) as (V, V) [j, i], zero on the diagonal.

    Args:
        smoothing: scenes of average content that are added to those with i and to those without.
    """
    both, count, scenes = v.T @ v, v.sum(0), len(v)
    average = frequency(v).unsqueeze(1) * smoothing
    given = (both + average) / (count + smoothing)
    otherwise = (count.unsqueeze(1) - both + average) / (scenes - count + smoothing)
    return (given / otherwise).log().fill_diagonal_(0.0)


def propose(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Smoothing × exponent."""
    bias = frequency(train.v).logit()
    for smoothing in _SMOOTHING:
        weights = evidence(train.v, smoothing)
        for exponent in _EXPONENTS:
            parameters = {"smoothing": smoothing, "exponent": exponent}
            yield parameters, LinearScore(bias, exponent * weights)
