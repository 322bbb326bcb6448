"""Doubt about the objects of a scene: intruders and wrong detections.

An intruder is a real object that does not belong to the scene. The log-odds of an intruder of class
i in a list of n classes are

    l_i = intercept + slope·s_i + log_count·log n,   s_i = z_i - alpha·popularity_i

z_i are the log-odds of the class given the rest of the scene (`Posterior.given_rest`). The prior of
an intruder, alpha·popularity, is `SceneModel.intruder_prior`.

A detection is real if object and label are right. Its log-odds (`RealFit`) rise with its confidence
and with s_i. A detection of confidence 1 is real.

A probable intruder and a probably wrong detection say little about the scene. So other answers
weight the presence of an object of class i by real · (1 - sigmoid(l_i)) (`believed`). The room type
has a mixture over the hypotheses that nothing, or one class k, is an intruder (`room_odds`):

    p(t) = (p(t | v) + sum_k w_k p(t | v without k)) / (1 + sum_k w_k),   w_k = exp(l_k) (e n / N)²

The sum is over the `HYPOTHESES` classes with the largest l_k. n is at most N = `LONG_LIST`. A short
list rarely has an intruder, and says too little without one of its classes.

The doubt about classes that are not judged, and about a single class, is that of the detector
alone: s_i counts as 0.

Source of contextual re-scoring: Hoiem, Efros and Hebert, "Putting objects in perspective" (2008).
"""

import math
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import sigmoid
from app.model.calibration import RealFit
from app.model.scene_model import SceneModel
from app.questions.posterior import Posterior, log_odds_of
from app.scene.scene import Scene, pool_classes

HYPOTHESES: Final = 4
LONG_LIST: Final = 12  # classes; of the prior exponents 0, 1, 2 and 3, 2 gives the best room types
_LARGEST: Final = 50.0  # log weight of a hypothesis
_SMALLEST: Final = 1e-300  # probability of a room type
_LEAST_WEIGHT: Final = 1e-3  # of all hypotheses together
LEAST_REAL: Final = 0.5
"""Least probability of a right detection at which an object may raise an alarm."""

Floats = NDArray[np.floating[Any]]


class Doubt(NamedTuple):
    """The doubt about the n classes and the N objects of a scene."""

    logits: Float[Floats, "n"]  # of an intruder; -inf if the class is not judged
    p: Float[Floats, "n"]  # probability of an intruder; 0 if the class is not judged
    real: Float[Floats, "N"]  # probability that each object is a right detection
    exists: Float[Floats, "n"]  # presence of each class, weighted by `real`
    presence: Float[Floats, "n"]  # presence of each class, weighted by all doubt
    is_unsure: bool  # whether a `real` is below 1


def doubt(model: SceneModel, posterior: Posterior, log_odds: Float[Floats, "n"]) -> Doubt:
    """Return the doubt about a scene, from the log-odds of each class given the rest."""
    present, entry, n = posterior.present, model.calibration.outlier, posterior.listed
    line = (0.0, 0.0, 0.0) if entry is None else (entry.intercept, entry.slope, entry.log_count)
    score, logits, p, presence = _intruders(
        log_odds,
        present.classes,
        present.presence,
        model.intruder_prior,
        model.vocabulary.judged,
        line,
        n,
        entry is not None,
    )
    real: Float[Floats, "N"] = present.confidence
    exists: Float[Floats, "n"] = present.presence
    if (is_unsure := bool(real.min() < 1.0)) and model.calibration.real is not None:
        real = _real(model.calibration.real, real, score[present.row], n)
        exists = pool_classes(present.classes[present.row], real)[4].astype(np.float32)
        presence *= exists / present.presence
    return Doubt(logits, p, real, exists, presence, is_unsure)


@compiled
def _intruders(
    log_odds: Float[NDArray, " n"],
    classes: Int[NDArray, " n"],
    presence: Float[NDArray, " n"],
    prior: Float[NDArray, " V"],
    judged: Bool[NDArray, " V"],
    line: tuple[float, float, float],  # intercept, slope and log_count of the log-odds
    listed: int,
    has_line: bool,  # whether the model judges objects
) -> tuple[
    Float[NDArray, " n"], Float[NDArray, " n"], Float[NDArray, " n"], Float[NDArray, " n"]
]:  # fmt: skip
    """Return score, log-odds and probability of an intruder, and weighted presence of n classes."""
    n, (intercept, slope, log_count) = len(classes), line
    score, logits, p = np.zeros(n), np.full(n, -np.inf), np.zeros(n)
    weighted = presence.copy()
    intercept += log_count * math.log(max(listed, 1))
    for i in range(n):
        if not judged[classes[i]]:
            continue
        value = log_odds[i] - prior[classes[i]]
        if listed > 1:
            score[i] = value
        if has_line:
            logits[i] = intercept + slope * value
            p[i] = 1.0 / (1.0 + math.exp(-max(logits[i], -80.0)))
            if listed > 1:
                weighted[i] *= np.float32(1.0 - p[i])
    return score, logits, p, weighted


def _real(
    fit: RealFit, confidence: Float[Floats, "N"], score: Float[Floats, "N"], n: int
) -> Float[Floats, "N"]:
    """Return the probability that each object is a right detection; n classes are listed."""
    unsure = confidence < 1.0
    c, real = confidence[unsure], confidence.copy()
    logits = fit.intercept + fit.confidence * np.log(c / (1.0 - c)) + fit.context * score[unsure]
    real[unsure] = sigmoid(logits + fit.log_count * math.log(max(1, n)))
    return real


def believed(model: SceneModel, scene: Scene) -> Posterior:
    """Return the posterior given a scene, with the presence of each class weighted by doubt.

    Raises:
        ValueError: the machine does not know the class of an object, the room type or the profile.
    """
    posterior = Posterior(model, scene)
    if not scene.objects:
        return posterior
    about = doubt(model, posterior, posterior.given_rest()[0])
    posterior.weight(about.presence)
    return posterior


class RoomOdds(NamedTuple):
    """The probabilities of the C room types of a scene with n classes."""

    posterior: Posterior  # without the room type of the scene; only `real` weights it
    log_p: Float[NDArray[np.float64], "C"]  # of each room type, with the mixture over intruders
    # Log-odds of each room type minus its log-odds without each class, without the mixture; None:
    # not wanted.
    change: Float[NDArray[np.float64], "C n"] | None


def room_odds(model: SceneModel, scene: Scene, *, explained: bool = False) -> RoomOdds:
    """Return the probabilities of room types; `explained` asks for the changes by each class."""
    posterior = Posterior(model, replace(scene, room_type=None))
    if not scene.objects:
        nothing = np.zeros((model.spec.C, 0)) if explained else None
        return RoomOdds(posterior, posterior.room_log_p()[0], nothing)
    about = doubt(model, posterior, posterior.given_rest()[0])
    posterior.weight(about.exists)
    chosen = np.argsort(-about.logits, kind="stable")[:HYPOTHESES]
    prior = 2.0 + 2.0 * math.log(min(max(posterior.listed, 1), LONG_LIST) / LONG_LIST)
    weights = np.exp(np.minimum(about.logits[chosen] + prior, _LARGEST))
    total = float(weights.sum())
    has_mixture = posterior.listed > 1 and total >= _LEAST_WEIGHT
    if not has_mixture:
        chosen = chosen[:0]
    table = posterior.room_log_p(np.arange(len(about.logits)) if explained else chosen)
    log_p, without, change = table[0], table[1:], None
    if explained:
        change = (log_odds_of(log_p) - log_odds_of(without)).T
        without = without[chosen]
    if has_mixture:
        mixture = np.exp(log_p) + weights @ np.exp(without)
        log_p = np.log(np.maximum(mixture / (1.0 + total), _SMALLEST))
    return RoomOdds(posterior, log_p, change)
