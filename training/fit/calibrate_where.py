"""Fit `Calibration.where` to things that were taken away from homes of the validation part.

    slope      conditional logistic regression of the room on the log-odds of `/missing`
    intercept, here
               logistic regression: is the thing in one of the rooms? One in ten things is not

Source: McFadden, "Conditional logit analysis of qualitative choice behavior" (1974).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from app.model import SceneModel, WhereFit
from app.questions.where import Room, room_log_odds
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask
from training.datasets.cases import scene_of
from training.datasets.homes import NOWHERE, HomeCase, home_cases
from training.fit.regression import LEAST_SCENES, RIDGE, logistic

_STEEPEST = 4.0


def rooms_of(artifact: SceneModel, case: HomeCase) -> list[Room]:
    """Return the rooms of a case without the thing, and with their types."""
    rooms = []
    for number, encoded in enumerate(case.rooms):
        kept = kept_objects(encoded, case.thing, artifact.vocabulary.structure)
        rooms.append(Room(str(number), scene_of(encoded, kept.tolist(), ())))
    return rooms


def kept_objects(
    encoded: EncodedScene, thing: int, structure: ClassMask
) -> Int[NDArray[np.int64], "k"]:
    """Return the indices of the objects of a room without the thing and without structure."""
    classes = encoded.instance_classes
    return np.flatnonzero(~structure[classes] & (classes != thing))


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
