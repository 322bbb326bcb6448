"""What an object is usually found with: absent classes that would make it likely.

The presence of class j raises the log-odds of class i, in a scene without others, by

    increase_ij = gain_j(c1 + W_i) - gain_j(c1)
    gain_j(x)   = sum_k softplus(x_k + W_jk) - softplus(x_k)

It is symmetric in i and j, so one row of gains for i holds its increase by every class. The formula
is exact for one hidden layer in the local form; a second layer, relations and the room type are
left out.

The largest increases belong to rare companions (a toilet's: the toilet paper holder), the likeliest
companions to common things (chairs are everywhere). So classes are ranked by the product of
increase and probability beside i, and an increase below half of the largest one does not count.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.reasoning.calibration import sigmoid
from app.reasoning.ranking import best
from app.registry.artifact import Artifact

COMPANIONS: Final = 3
"""How many classes an answer names."""

_LEAST_SHARE: Final = 0.5  # of the largest increase


def companions(
    artifact: Artifact, present: NDArray[np.int64], flagged: NDArray[np.int64]
) -> list[tuple[str, ...]]:
    """Labels of absent classes that would make each flagged class likely, best first.

    Args:
        present: the classes of the scene, which are never named; structure is not either.
        flagged: class indices.
    """
    usable = ~artifact.vocabulary.structure
    usable[present] = False
    if not usable.any():
        return [()] * len(flagged)
    return [_companions(artifact, usable, index) for index in flagged.tolist()]


def _companions(artifact: Artifact, usable: NDArray[np.bool_], index: int) -> tuple[str, ...]:
    weights = artifact.weights
    beside = artifact.scorer.gain(weights["c1"] + weights["W"][index])
    increase = np.where(usable, beside - artifact.empty_gain, 0)
    score = increase * sigmoid(weights["b"] + beside)
    score[increase < max(_LEAST_SHARE * float(increase.max()), 1e-6)] = 0
    labels = artifact.vocabulary.labels
    return tuple([labels[place] for place in best(score, score > 0, COMPANIONS).tolist()])
