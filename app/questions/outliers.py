"""The question `outliers`: which objects do not belong, and which stated relations are wrong?

An intruder is an object that does not belong to the scene. An outlier is an object that the service
reports as a probable intruder. The answer for an outlier names its companions: absent classes that
usually occur with the class of the outlier. In a scene without other objects, the presence of class
j raises the log-odds of class i by

    increase_ij = gain_j(c1 + W_i) - gain_j(c1)
    gain_j(x)   = sum_k softplus(x_k + W_jk) - softplus(x_k)

Here c1 are the biases of the hidden units k, and W_i are the weights of class i. The increase is
symmetric in i and j. So the gains of all classes at c1 + W_i give the increase by every class j.
The formula is exact for a machine with one hidden layer in the local form. It leaves out a second
layer, relations and the room type.

Rare classes have the largest increases, such as a toilet paper holder for a toilet. Common classes
such as chair are likely in any scene. So companions are ranked by a product: the increase,
multiplied by the probability of class j in a scene with class i. Classes whose increase is below
half of the largest increase are ignored.
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
from app.registry.description import CountSlope, Thresholds
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

Sensitivity = Literal["low", "medium", "high"]

# The time to explain one object grows with the number of classes multiplied by the number of
# relation units. This limit on the total bounds the number of explained objects in scenes with very
# many relations.
_REASON_UNITS: Final = 1 << 22

COMPANIONS: Final = 3
"""Maximum number of companions in the answer for one outlier."""

_LEAST_SHARE: Final = 0.5  # smallest increase of a companion, as a share of the largest


class OutlierAnswer(NamedTuple):
    """An object and the probability that it does not belong to the scene.

    Attributes:
        object: index of the object in `Scene.objects`.
        label: canonical label of the object's class.
        probability: probability that the object is an intruder, under the assumption that half of
            all scenes contain an intruder.
        log_odds: log-odds that the object's class is present, given the rest of the scene.
        is_outlier: True if the probability is at least the threshold.
        because: up to three other objects, in order of their effect on `log_odds`. For an outlier,
            these objects lower its log-odds. For other objects, they raise the log-odds.
        usually_with: labels of up to three companions. The tuple is empty for an object that is not
            an outlier.
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
        subject, object: indices in `Scene.objects`.
        relation: name of the canonical relation.
        probability: probability that the relation is false.
        is_misplaced: True if the probability is at least the threshold.
    """

    subject: int
    relation: str
    object: int
    probability: float
    is_misplaced: bool = False


class OutliersFound(NamedTuple):
    """The objects and the stated relations of a scene, with their probabilities.

    Attributes:
        threshold: minimum probability of an outlier. None if the model judges no object and the
            caller states no threshold.
        outliers: every object of the scene, probable intruders first. The tuple is empty if the
            model judges no object.
        misplaced: every stated relation, probably false relations first. The tuple is empty if the
            model judges no relation.
    """

    threshold: float | None
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

    Probable intruders and probably false relations come first. Objects and relations with equal
    scores keep the order of the request.

    The score of an object is the log-odds of its class given the rest of the scene. The rest does
    not contain the instances of the class and their relations. So all instances of a class have the
    same score. Intruders are often common objects in the wrong room. The prior of an intruder is
    therefore proportional to popularity^alpha. The popularity of a class is the odds that a
    training scene has the class. So the function subtracts alpha times the log of the popularity.
    Structural classes, such as wall, always have the probability 0. A scene with few objects gives
    little evidence, so its threshold is higher.

    Args:
        artifact: the model.
        scene: the objects and stated relations to judge.
        sensitivity: name of one of the model's thresholds.
        threshold: minimum probability of an outlier. None means the threshold of `sensitivity`.
        details: whether the answers contain `because` and `usually_with`.

    Raises:
        ValueError: the threshold is outside [0, 1].
    """
    entry, presets = artifact.calibration.outlier, artifact.calibration.outlier_thresholds
    if threshold is not None and not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be in [0, 1], not {threshold}")
    if not scene.objects:
        if threshold is None and presets is not None:
            threshold = _threshold(presets, sensitivity)
        return OutliersFound(threshold, (), ())
    given = posterior(artifact, scene)
    wrong = _misplaced(artifact, given, scene, sensitivity)
    if entry is None or presets is None:
        return OutliersFound(threshold, (), wrong)
    classes = given.present.classes
    if threshold is None:
        listed = int((~artifact.vocabulary.structure[classes]).sum())
        short = artifact.calibration.short_list_thresholds
        if 0 < listed <= len(short):
            presets = short[listed - 1]
        threshold = _threshold(presets, sensitivity)
    log_odds = given.log_odds_given_rest()
    logits = _intruder_logits(artifact, entry, classes, log_odds)
    # The order follows the logits, because probabilities near 0 or 1 may round to the same number.
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
    return OutliersFound(threshold, tuple(found), wrong)


def misplaced(
    artifact: Artifact, scene: Scene, *, sensitivity: Sensitivity = "medium"
) -> tuple[MisplacedAnswer, ...]:
    """Judge every stated relation like `outliers`, but do not judge objects."""
    if not scene.objects:
        return ()
    return _misplaced(artifact, posterior(artifact, scene), scene, sensitivity)


def intruders(artifact: Artifact, scene: Scene) -> NDArray[np.int64]:
    """Return the classes that do not belong to a whole scene, at medium sensitivity.

    A whole scene lists all its objects. So the thresholds for short lists, which are often
    incomplete, do not apply.
    """
    entry, presets = artifact.calibration.outlier, artifact.calibration.outlier_thresholds
    given = posterior(artifact, scene)
    classes = given.present.classes
    if entry is None or presets is None:
        return classes[:0]
    logits = _intruder_logits(artifact, entry, classes, given.log_odds_given_rest())
    return classes[_probability(logits) >= presets.medium]


def _intruder_logits(
    artifact: Artifact,
    entry: CountSlope,
    classes: NDArray[np.int64],
    log_odds: NDArray[np.floating[Any]],
) -> NDArray[np.float64]:
    """Return the logit of each class's probability of being an intruder, (n,).

    The logit of a structural class is -inf.
    """
    intercept, slope = intruder_line(entry, len(log_odds))
    logits = intercept + slope * _adjusted(artifact, classes, log_odds).astype(np.float64)
    logits[artifact.vocabulary.structure[classes]] = -np.inf
    return logits


def _probability(logits: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isinf(logits), 0.0, sigmoid(logits))


def _threshold(presets: Thresholds, sensitivity: Sensitivity) -> float:
    return {"low": presets.low, "medium": presets.medium, "high": presets.high}[sensitivity]


def _adjusted(
    artifact: Artifact, classes: NDArray[np.int64], log_odds: NDArray[np.floating[Any]]
) -> NDArray[np.floating[Any]]:
    """Return log-odds of presence minus alpha times the class's log-odds in training scenes, (n,).

    alpha is `Calibration.popularity_weight`.
    """
    popularity = artifact.popularity
    if popularity is None:
        return log_odds
    return log_odds - artifact.calibration.popularity_weight * popularity[classes]


def _affordable(given: Posterior) -> int:
    """Return the maximum number of objects with reasons in the answer."""
    per_object = len(given.present.classes) * max(1, given.unit_count)
    return min(EXPLAINED, max(1, _REASON_UNITS // per_object))


def _reasons(
    given: Posterior, explained: list[int], is_outlier: NDArray[np.bool_]
) -> dict[int, tuple[Because, ...]]:
    """Return the strongest reasons for each explained class; see `OutlierAnswer`."""
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


def stated_log_odds(
    artifact: Artifact, given: Posterior, scene: Scene
) -> tuple[NDArray[np.int64], NDArray[np.floating[Any]]]:
    """Return the n stated relations that the machine knows, and their log-odds.

    Returns:
        The triples (relation, subject, object), (3, n), and the log-odds that each relation holds,
        given the rest of the scene, (n,).
    """
    stated = [triple for triple in scene.relations or () if triple[0] < artifact.spec.A]
    relation, subject, object_ = triples = np.array(stated, dtype=np.int64).reshape(-1, 3).T.copy()
    if not stated:
        return triples, np.zeros(0)
    row = given.present.row
    return triples, given.unit_log_odds(relation, row[subject], row[object_])


def _misplaced(
    artifact: Artifact, given: Posterior, scene: Scene, sensitivity: Sensitivity
) -> tuple[MisplacedAnswer, ...]:
    """Judge the stated relations that the machine knows, least likely first.

    Relations with equal log-odds keep the order of `Scene.relations`.
    """
    entry, presets = artifact.calibration.misplaced, artifact.calibration.misplaced_thresholds
    (relation, subject, object_), log_odds = stated_log_odds(artifact, given, scene)
    if entry is None or presets is None or not len(log_odds):
        return ()
    order = np.argsort(log_odds, kind="stable")
    p = sigmoid(false_log_odds(entry, log_odds[order]))
    return tuple(
        entries(
            MisplacedAnswer,
            subject[order].tolist(),
            [CANONICAL[number] for number in relation[order].tolist()],
            object_[order].tolist(),
            p.tolist(),
            (p >= _threshold(presets, sensitivity)).tolist(),
        )
    )


def _companions(
    artifact: Artifact, present: NDArray[np.int64], flagged: NDArray[np.int64]
) -> list[tuple[str, ...]]:
    """Return the labels of the companions of each outlier, best first; see the module.

    The classes in ``present``, those of the scene, and structural classes are never companions.
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
