"""What does not belong here, or stands in the wrong place?

An outlier names companions: absent classes that it is usually found with. The presence of class j
raises the log-odds of class i, in a scene without others, by

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

from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.questions.calibration import false_log_odds, intruder_line
from app.questions.posterior import Posterior, posterior
from app.questions.ranking import EXPLAINED, Because, best, entries, strongest_reasons
from app.registry.artifact import Artifact
from app.registry.description import Calibration, Thresholds
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

Sensitivity = Literal["low", "medium", "high"]

# Reasons for one object cost n rows. Where a scene shows very many relations, they are given for
# fewer objects, so that their rows hold about so many relation units in all.
_REASON_UNITS: Final = 1 << 22

COMPANIONS: Final = 3
"""How many classes an answer names."""

_LEAST_SHARE: Final = 0.5  # of the largest increase


class OutlierAnswer(NamedTuple):
    """How badly an object fits.

    Attributes:
        object, label: which one; the label is canonical.
        probability: that it is an intruder, where half of the scenes are clean.
        log_odds: of its class being present given the rest of the scene.
        is_outlier: the probability reaches the threshold.
        because: the objects that make it unlikely, strongest first; of one that fits, those that
            make it likely.
        usually_with: absent classes that would make it likely, at most three; of outliers only.
    """

    object: int
    label: str
    probability: float
    log_odds: float
    is_outlier: bool
    because: tuple[Because, ...]
    usually_with: tuple[str, ...] = ()


class MisplacedAnswer(NamedTuple):
    """A relation of the scene and the probability that it is false.

    Attributes:
        is_misplaced: the probability reaches the threshold.
    """

    subject: int
    relation: str
    object: int
    probability: float
    is_misplaced: bool = False


class OutliersFound(NamedTuple):
    """What does not belong, and what stands in the wrong place.

    Attributes:
        threshold: probability from which an object is an outlier.
        outliers: every object, least fitting first.
        misplaced: every stated relation, least likely first.
    """

    threshold: float
    outliers: tuple[OutlierAnswer, ...]
    misplaced: tuple[MisplacedAnswer, ...]


def outliers(
    artifact: Artifact,
    scene: Scene,
    *,
    sensitivity: Sensitivity = "medium",
    threshold: float | None = None,
    details: bool = True,
) -> OutliersFound:
    """Every object, least fitting first, and every stated relation, least likely first.

    An object is judged by the log-odds of its class given the rest of the scene: all instances of
    the class, and all relations that touch it, are taken out first. So instances of one class
    score alike. Intruders are often common things in the wrong room: their prior is proportional
    to popularity^alpha, so alpha times the log-odds of the class in a training scene is subtracted
    from its log-odds here. Structure, such as a wall, is never an intruder: its probability is 0.
    Ties go by position. A list of few classes says little of the scene, so its threshold is higher.

    Args:
        sensitivity: which of the model's thresholds decide.
        threshold: probability from which an object is an outlier; replaces that of `sensitivity`.
        details: also name the objects that support each verdict, and what goes with an outlier.

    Raises:
        ValueError: a threshold outside [0, 1].
    """
    calibration = artifact.calibration
    if threshold is not None and not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be in [0, 1], not {threshold}")
    if not scene.objects:
        limit = _threshold(calibration.outlier_thresholds, sensitivity)
        return OutliersFound(limit if threshold is None else threshold, (), ())
    given = posterior(artifact, scene)
    classes = given.present.classes
    if threshold is None:
        listed = int((~artifact.vocabulary.structure[classes]).sum())
        threshold = _threshold(_presets(calibration, listed), sensitivity)
    log_odds = given.log_odds_given_rest()
    logits = _intruder_logits(artifact, classes, log_odds)
    # By logit: probabilities near 0 or 1 may all round to one number.
    order = np.argsort(-logits[given.present.row], kind="stable")
    p = _probability(logits)
    row = given.present.row[order]
    rows, labels, is_outlier = row.tolist(), artifact.vocabulary.labels, p >= threshold
    explained = list(dict.fromkeys(rows[: _affordable(given)])) if details else []
    reasons = _reasons(given, explained, is_outlier) if explained else {}
    flagged = [one for one in explained if is_outlier[one]]
    usual = _companions(artifact, classes, classes[flagged]) if flagged else []
    company = dict(zip(flagged, usual, strict=True))
    found = entries(
        OutlierAnswer,
        order.tolist(),
        [labels[index] for index in classes[row].tolist()],
        p[row].tolist(),
        log_odds[row].tolist(),
        is_outlier[row].tolist(),
        [reasons.get(one, ()) for one in rows],
        [company.get(one, ()) for one in rows],
    )
    return OutliersFound(threshold, tuple(found), _misplaced(artifact, given, scene, sensitivity))


def misplaced(
    artifact: Artifact, scene: Scene, *, sensitivity: Sensitivity = "medium"
) -> tuple[MisplacedAnswer, ...]:
    """Every stated relation, least likely first: the second list of `outliers` alone."""
    if not scene.objects:
        return ()
    return _misplaced(artifact, posterior(artifact, scene), scene, sensitivity)


def intruder_probability(artifact: Artifact, given: Posterior) -> NDArray[np.float64]:
    """The probability that a class of the scene is an intruder, (n,); see `outliers`."""
    log_odds = given.log_odds_given_rest()
    return _probability(_intruder_logits(artifact, given.present.classes, log_odds))


def _intruder_logits(
    artifact: Artifact, classes: NDArray[np.int64], log_odds: NDArray[np.floating[Any]]
) -> NDArray[np.float64]:
    """Logits of the probability that each class is an intruder, (n,); -inf for structure."""
    intercept, slope = intruder_line(artifact.calibration, len(log_odds))
    logits = intercept + slope * _adjusted(artifact, classes, log_odds).astype(np.float64)
    logits[artifact.vocabulary.structure[classes]] = -np.inf
    return logits


def _probability(logits: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isinf(logits), 0.0, sigmoid(logits))


def _presets(calibration: Calibration, listed: int) -> Thresholds:
    """The thresholds where so many classes are listed, structure aside."""
    if 0 < listed <= len(calibration.short_list_thresholds):
        return calibration.short_list_thresholds[listed - 1]
    return calibration.outlier_thresholds


def _threshold(presets: Thresholds, sensitivity: Sensitivity) -> float:
    return {"low": presets.low, "medium": presets.medium, "high": presets.high}[sensitivity]


def _adjusted(
    artifact: Artifact, classes: NDArray[np.int64], log_odds: NDArray[np.floating[Any]]
) -> NDArray[np.floating[Any]]:
    """Log-odds of presence, less alpha times those of the class in a training scene, (n,)."""
    popularity = artifact.popularity
    if popularity is None:
        return log_odds
    return log_odds - artifact.calibration.popularity_weight * popularity[classes]


def _affordable(given: Posterior) -> int:
    """For how many objects to give reasons."""
    per_object = len(given.present.classes) * max(1, given.unit_count)
    return min(EXPLAINED, max(1, _REASON_UNITS // per_object))


def _reasons(
    given: Posterior, explained: list[int], is_outlier: NDArray[np.bool_]
) -> dict[int, tuple[Because, ...]]:
    """For each explained class, the other classes that support its verdict most.

    Of an outlier those that lower its log-odds, of any other those that raise it.
    """
    if len(given.present.classes) < 2:
        return dict.fromkeys(explained, ())
    rows = np.array(explained, dtype=np.int64)
    change = given.reasons(rows)
    change = np.where(is_outlier[rows, None] == (change < 0), change, 0)
    found = strongest_reasons(given.present.first, change, rows)
    return {
        one: tuple([reason for reason in reasons if reason.log_odds_change])
        for one, reasons in zip(explained, found, strict=True)
    }


def _misplaced(
    artifact: Artifact, given: Posterior, scene: Scene, sensitivity: Sensitivity
) -> tuple[MisplacedAnswer, ...]:
    """The scene's relations that the machine knows, least likely first, ties by their order."""
    stated = [triple for triple in scene.relations or () if triple[0] < artifact.spec.A]
    if not stated:
        return ()
    calibration, row = artifact.calibration, given.present.row
    relation, subject, object_ = np.array(stated).T.copy()
    log_odds = given.unit_log_odds(relation, row[subject], row[object_])
    order = np.argsort(log_odds, kind="stable")
    p = sigmoid(false_log_odds(calibration, log_odds[order]))
    return tuple(
        entries(
            MisplacedAnswer,
            subject[order].tolist(),
            [CANONICAL[number] for number in relation[order].tolist()],
            object_[order].tolist(),
            p.tolist(),
            (p >= _threshold(calibration.misplaced_thresholds, sensitivity)).tolist(),
        )
    )


def _companions(
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
    weights, labels = artifact.weights, artifact.vocabulary.labels
    beside = artifact.scorer.gain(weights["c1"] + weights["W"][flagged])
    increase = np.where(usable, beside - artifact.empty_gain, 0)
    least = np.maximum(_LEAST_SHARE * increase.max(1, keepdims=True), 1e-6)
    score = np.where(increase < least, 0, increase * sigmoid(weights["b"] + beside))
    return [
        tuple([labels[place] for place in best(row, row > 0, COMPANIONS).tolist()]) for row in score
    ]
