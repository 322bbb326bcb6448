"""What does not belong here, or stands in the wrong place?"""

from __future__ import annotations

import numpy as np

from app.reasoning.answers import Because, MisplacedAnswer, OutlierAnswer, entries
from app.reasoning.calibration import false_log_odds, intruder_line, sigmoid
from app.reasoning.listing import least_fitting
from app.reasoning.posterior import Posterior, posterior
from app.reasoning.reasons import EXPLAINED, strongest_reasons
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

# Reasons for one object cost n rows. Where a scene shows very many relations, they are given for
# fewer objects, so that their rows hold about so many relation units in all.
_REASON_UNITS = 1 << 22


def outliers(
    artifact: Artifact, scene: Scene, *, threshold: float | None = None, details: bool = True
) -> tuple[tuple[OutlierAnswer, ...], tuple[MisplacedAnswer, ...]]:
    """Every object, least fitting first, and every stated relation, least likely first.

    An object is judged by the log-odds of its class given the rest of the scene: all instances of
    the class, and all relations that touch it, are taken out first. So instances of one class
    score alike. Ties go by position.

    Args:
        threshold: probability from which an object is called an outlier; by default the model's.
        details: also say what speaks for and against each object.

    Raises:
        ValueError: a threshold outside [0, 1].
    """
    calibration = artifact.calibration
    if threshold is None:
        threshold = calibration.outlier_threshold
    if not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be in [0, 1], not {threshold}")
    if not scene.objects:
        return (), ()
    given = posterior(artifact, scene)
    log_odds = given.log_odds_given_rest()
    order, p = least_fitting(
        *intruder_line(calibration, len(log_odds)), log_odds, given.present.row
    )
    row = given.present.row[order]
    rows, probability, labels = row.tolist(), p[row], artifact.vocabulary.labels
    explained = list(dict.fromkeys(rows[: _affordable(given)])) if details else []
    reasons = _reasons(given, explained) if explained else {}
    found = entries(
        OutlierAnswer,
        order.tolist(),
        [labels[index] for index in given.present.classes[row].tolist()],
        probability.tolist(),
        log_odds[row].tolist(),
        (probability >= threshold).tolist(),
        [reasons.get(one, ()) for one in rows],
    )
    return tuple(found), _misplaced(artifact, given, scene)


def misplaced(artifact: Artifact, scene: Scene) -> tuple[MisplacedAnswer, ...]:
    """Every stated relation, least likely first: what `outliers` says of them, and no more."""
    if not scene.objects:
        return ()
    return _misplaced(artifact, posterior(artifact, scene), scene)


def _affordable(given: Posterior) -> int:
    """For how many objects to give reasons."""
    per_object = len(given.present.classes) * max(1, given.unit_count)
    return min(EXPLAINED, max(1, _REASON_UNITS // per_object))


def _reasons(given: Posterior, explained: list[int]) -> dict[int, tuple[Because, ...]]:
    """For each explained class, the other classes that change its log-odds most."""
    if len(given.present.classes) < 2:
        return dict.fromkeys(explained, ())
    rows = np.array(explained, dtype=np.int64)
    found = strongest_reasons(given.present, given.reasons(rows), rows)
    return dict(zip(explained, found, strict=True))


def _misplaced(artifact: Artifact, given: Posterior, scene: Scene) -> tuple[MisplacedAnswer, ...]:
    """The scene's relations that the machine knows, least likely first, ties by their order."""
    stated = [triple for triple in scene.relations or () if triple[0] < artifact.machine.spec.A]
    if not stated:
        return ()
    row = given.present.row
    relation, subject, object_ = np.array(stated).T.copy()
    log_odds = given.unit_log_odds(relation, row[subject], row[object_])
    order = np.argsort(log_odds, kind="stable")
    return tuple(
        entries(
            MisplacedAnswer,
            subject[order].tolist(),
            [CANONICAL[number] for number in relation[order].tolist()],
            object_[order].tolist(),
            sigmoid(false_log_odds(artifact.calibration, log_odds[order])).tolist(),
        )
    )
