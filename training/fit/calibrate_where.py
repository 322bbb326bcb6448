"""Fit `Calibration.where` to things that were taken away from homes of the validation part.

    slope      conditional logistic regression of the room on the log-odds of `/missing`
    intercept, here
               logistic regression: is the thing in one of the rooms? One in ten things is not
    place_intercept, place_slope
               conditional logistic regression of the place in the right room on the log-odds of
               the placements

Source: McFadden, "Conditional logit analysis of qualitative choice behavior" (1974).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import logsumexp

from app.model import SceneModel, WhereFit
from app.questions.doubt import believed
from app.questions.missing import VIEWER
from app.questions.placements import every_placement
from app.questions.where import place_weights, room_log_odds
from training.datasets import EncodedScene
from training.datasets.homes import NOWHERE, HomeCase, home_cases
from training.evaluation.where_task import (
    SUPPORT_NAMES,
    is_supporter,
    rooms_of,
    supporters_of,
)
from training.fit.regression import LEAST_SCENES, RIDGE, logistic

_STEEPEST, _FARTHEST = 4.0, 10.0


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
    fit = WhereFit(slope=slope)
    if not is_here.all():
        here, intercept = logistic(together[:, None], is_here, C=RIDGE)
        fit = WhereFit(slope=slope, here=max(here, 0.0), intercept=intercept)
    return _with_places(fit, artifact, cases)


def _with_places(fit: WhereFit, artifact: SceneModel, cases: Sequence[HomeCase]) -> WhereFit:
    """Fit the weights of the places in the right room of each thing.

    Only rooms with annotated relations count. A thing that is on or in no listed object is under
    one, or in the rest of the room.
    """
    structure = artifact.vocabulary.structure
    places = list[tuple[Float[NDArray, "k"], Bool[NDArray, "k"], float]]()
    for case in cases:
        supporters = supporters_of(case, structure)
        if case.room == NOWHERE or supporters is None:
            continue
        scene = rooms_of(artifact, case)[case.room].scene
        placed = every_placement(artifact, believed(artifact, scene), scene, case.thing, VIEWER)
        right = [is_supporter(case, one[0], supporters, structure) for _, one in placed]
        if rest := not any(right):
            right = [one[0]["relation"] not in SUPPORT_NAMES for _, one in placed]
        p = np.array([p for p, _ in placed])
        places.append((p, np.array(right, np.bool_), float(rest)))

    def changed(values: Sequence[float]) -> WhereFit:
        slope, intercept = values
        return fit.model_copy(update={"place_slope": slope, "place_intercept": intercept})

    def loss(values: Sequence[float]) -> float:
        entries, trial = [], changed(values)
        for p, right, rest in places:
            weights = place_weights(trial, p)
            entries.append(math.log1p(weights.sum()) - math.log(rest + weights[right].sum()))
        return float(np.mean(entries))

    if not places:
        return fit
    bounds = [(0.0, _STEEPEST), (-_FARTHEST, _FARTHEST)]
    return changed(minimize(loss, [1.0, 0.0], bounds=bounds).x.tolist())


def _log_p(logits: Float[NDArray, "rooms"]) -> Float[NDArray, "rooms"]:
    return logits - logsumexp(logits)
