"""Log-odds of classes that are there although a scene does not list them."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.reasoning.present import Present
from app.registry.artifact import Artifact

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.int64]

FULL: Final = 0.999
"""Coverage from which on every class that is there counts as listed."""


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

    (1 - λ) (closed + log(1 - c)) + λ partial, with λ the calibration's `coverage_weight`. The
    closed form counts all other unlisted classes as absent and has no sampling error. It stands
    alone for machines without stored samples, and from a coverage of `FULL` on, which counts as
    `FULL`: at 1 no class could be there unlisted.

    Args:
        log_odds: (N,) of the absent classes, unlisted ones absent.
        y: (H1,) logits of h1 in the closed form.
        coverage: probability that a class which is present is listed.
        closed: (N,) the closed form at y, where `log_odds` are a better estimate: what the
            partial posterior changes is added to these.
    """
    completions, weight = artifact.completions, artifact.calibration.coverage_weight
    unlisted = math.log1p(-min(coverage, FULL))
    found: Floats = log_odds + unlisted
    if completions is None or coverage >= FULL or weight == 0:
        return found
    partial = completions.log_odds(y, present.classes, present.presence, coverage, room)[absent]
    base = (log_odds if closed is None else closed) + unlisted
    found += np.float32(weight) * (partial - base)
    return found
