"""The question `outliers`: which objects do not belong, and which stated relations are wrong?

The answer for an outlier names its companions: absent classes that usually occur with it. In a
scene without other objects, the presence of class j raises the log-odds of class i by

    increase_ij = gain_j(c1 + W_i) - gain_j(c1)
    gain_j(x)   = sum_k softplus(x_k + W_jk) - softplus(x_k)

Here c1 are the biases of the hidden units k, and W_i are the weights of class i. The increase is
symmetric in i and j. So one row of gains for class i holds the increase by every class. The formula
is exact for one hidden layer in the local form. It leaves out a second layer, relations and the
room type.

Rare companions have the largest increases: for a toilet, the toilet paper holder. Common classes
such as chair are likely in any scene. So companions are ranked by the product of the increase and
the probability in a scene with class i. Increases below half of the largest one are ignored.
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

# Reasons for one object need n rows of relation units. This limit on the units of all rows bounds
# the number of explained objects in a scene with very many relations.
_REASON_UNITS: Final = 1 << 22

COMPANIONS: Final = 3
"""Maximum number of companions in an answer."""

_LEAST_SHARE: Final = 0.5  # smallest increase of a companion, as a share of the largest


class OutlierAnswer(NamedTuple):
    """How badly an object fits.

    Attributes:
        object: position in the scene.
        label: canonical label.
        probability: probability that it is an intruder, if half of all scenes have no intruder.
        log_odds: log-odds that its class is present, given the rest of the scene.
        is_outlier: whether the probability reaches the threshold.
        because: for an outlier, the objects that lower its log-odds most, strongest first; for
            other objects, the objects that raise the log-odds most.
        usually_with: companions of an outlier, at most three (see the module).
    """

    object: int
    label: str
    probability: float
    log_odds: float
    is_outlier: bool
    because: tuple[Because, ...]
    usually_with: tuple[str, ...] = ()


class MisplacedAnswer(NamedTuple):
    """A stated relation and the probability that it is false.

    Attributes:
        is_misplaced: whether the probability reaches the threshold.
    """

    subject: int
    relation: str
    object: int
    probability: float
    is_misplaced: bool = False


class OutliersFound(NamedTuple):
    """The objects and the stated relations of a scene, with their probabilities.

    Attributes:
        threshold: smallest probability of an outlier.
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
    """Judge every object and every stated relation of a scene.

    The least fitting objects and the least likely relations come first, ties by position.

    An object is judged by the log-odds of its class given the rest of the scene. The rest excludes
    all instances of the class and all relations that touch it. So instances of one class have the
    same score. Intruders are often common objects in the wrong room: their prior is proportional
    to popularity^alpha. So alpha times the log-odds of the class in a training scene is subtracted.
    Structure, such as a wall, always has probability 0. A short list gives little evidence about
    the scene, so its threshold is higher.

    Args:
        sensitivity: selects one of the model's thresholds.
        threshold: smallest probability of an outlier; replaces the threshold of `sensitivity`.
        details: whether to add `because` and `usually_with`.

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
    # Sorted by logit: probabilities near 0 or 1 may round to the same number.
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
    """Judge every stated relation, least likely first, as `outliers` does, but without objects."""
    if not scene.objects:
        return ()
    return _misplaced(artifact, posterior(artifact, scene), scene, sensitivity)


def intruder_probability(artifact: Artifact, given: Posterior) -> NDArray[np.float64]:
    """The probability that each class of the scene is an intruder, (n,); see `outliers`."""
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
    """The thresholds for a scene with `listed` classes, not counting structure."""
    if 0 < listed <= len(calibration.short_list_thresholds):
        return calibration.short_list_thresholds[listed - 1]
    return calibration.outlier_thresholds


def _threshold(presets: Thresholds, sensitivity: Sensitivity) -> float:
    return {"low": presets.low, "medium": presets.medium, "high": presets.high}[sensitivity]


def _adjusted(
    artifact: Artifact, classes: NDArray[np.int64], log_odds: NDArray[np.floating[Any]]
) -> NDArray[np.floating[Any]]:
    """Log-odds of presence minus alpha times the class's log-odds in a training scene, (n,)."""
    popularity = artifact.popularity
    if popularity is None:
        return log_odds
    return log_odds - artifact.calibration.popularity_weight * popularity[classes]


def _affordable(given: Posterior) -> int:
    """Maximum number of objects that get reasons."""
    per_object = len(given.present.classes) * max(1, given.unit_count)
    return min(EXPLAINED, max(1, _REASON_UNITS // per_object))


def _reasons(
    given: Posterior, explained: list[int], is_outlier: NDArray[np.bool_]
) -> dict[int, tuple[Because, ...]]:
    """The strongest reasons for each explained class.

    Reasons of an outlier lower its log-odds. Reasons of other classes raise their log-odds.
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
    """Judge the stated relations that the machine knows, least likely first, ties by position."""
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
    """Labels of the companions of each flagged class, best first (see the module).

    Args:
        present: classes of the scene; these and structure are never companions.
        flagged: class indices of the outliers.
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
