"""Log-odds of classes that are there although a scene does not list them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.reasoning.present import Present
from app.registry.artifact import Artifact

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.int64]


def with_unlisted(
    artifact: Artifact,
    log_odds: Floats,
    absent: Places,
    y: NDArray[np.float32],
    present: Present,
    room: int | None,
    coverage: float,
    closed: Floats | None = None,
) -> Floats:
    """Mix the log-odds of absent classes with those of the partial posterior, (N,).

    (1 - λ) closed + λ partial, with λ the calibration's `coverage_weight`. The closed form counts
    unlisted classes as absent and has no sampling error. It is the answer at coverage 1, and for
    machines without stored samples.

    Args:
        log_odds: (N,) of the absent classes, unlisted ones absent.
        y: (H1,) logits of h1 in the closed form.
        coverage: probability that a class which is present is listed.
        closed: (N,) the closed form at y, where `log_odds` are a better estimate: what the
            partial posterior changes is added to these.
    """
    completions, weight = artifact.completions, artifact.calibration.coverage_weight
    if completions is None or coverage >= 1 or weight == 0:
        return log_odds
    partial = completions.log_odds(y, present.classes, present.presence, coverage, room)[absent]
    base = log_odds if closed is None else closed
    found: Floats = log_odds + np.float32(weight) * (partial - base)
    return found
