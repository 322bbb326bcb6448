"""Fit `Calibration.where` to things that were taken away from homes of the validation part.

    slope      conditional logistic regression of the room on the log-odds of `/missing`
    intercept, here
               logistic regression: is the thing in one of the rooms? One in ten things is not

Source: McFadden, "Conditional logit analysis of qualitative choice behavior" (1974).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from app.model import SceneModel, WhereFit
from app.questions.where import room_log_odds
from training.datasets import EncodedScene
from training.datasets.homes import NOWHERE, home_cases
from training.evaluation.where_task import rooms_of
from training.fit.regression import LEAST_SCENES, RIDGE, logistic

_STEEPEST = 4.0


def fit_where(artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0) -> WhereFit:
    """Return the fit; the default with fewer than 20 homes."""
    cases = home_cases(scenes, artifact.vocabulary.structure, seed)
    if len({case.home for case in cases}) < LEAST_SCENES:
        return WhereFit()
    log_odds = [room_log_odds(artifact, rooms_of(artifact, case), case.thing) for case in cases]
    taken = [
        (logits, case.room)
        for logits, case in zip(log_odds, cases, strict=True)
        if case.room != NOWHERE
    ]

    def loss(slope: float) -> float:
        return -float(np.mean([_log_p(slope * logits)[room] for logits, room in taken]))

    slope = float(minimize_scalar(loss, bounds=(0.0, _STEEPEST), method="bounded").x)
    together = np.array([logsumexp(logits) for logits in log_odds])
    is_here = np.array([case.room != NOWHERE for case in cases])
    if is_here.all():
        return WhereFit(slope=slope)
    here, intercept = logistic(together[:, None], is_here, C=RIDGE)
    return WhereFit(slope=slope, here=max(here, 0.0), intercept=intercept)


def _log_p(logits: Float[NDArray, "rooms"]) -> Float[NDArray, "rooms"]:
    return logits - logsumexp(logits)
