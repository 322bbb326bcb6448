"""Fit the doubt about detections: `Calibration.real` and `Calibration.labels`.

Validation scenes are seen by a model of detectors (`training.datasets.detections`), `_DRAWS` times
each. Half of the seen scenes have a further real object that does not belong.

    real      Logistic regression: is the detection right? Intruders are right detections.
    labels    Logistic regression of the right one of two labels, on the differences of their
              features. Each detection of a class with similar classes has a second label.

Source: Platt, "Probabilistic outputs for support vector machines" (1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.model import LabelFit, RealFit, SceneModel
from app.questions.alternatives import Guesses, label_log_odds
from app.questions.posterior import Posterior
from app.scene import Scene, SceneObject
from training.datasets import EncodedScene
from training.datasets.cases import scene_rng
from training.datasets.detections import Detections, Detector
from training.fit.regression import LEAST_SCENES, logistic

_DRAWS: Final = 2
_INTRUDERS: Final = 0.5  # share of the seen scenes with an intruder


def detector_of(artifact: SceneModel) -> Detector:
    """Return the model of detectors with the classes and the frequencies of a model."""
    popularity = np.array(artifact.calibration.popularity, dtype=np.float64)
    frequency = np.where(np.isnan(popularity), 0.0, sigmoid(np.nan_to_num(popularity)))
    return Detector.of(artifact.vocabulary, frequency)


def fit_doubt(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> dict[str, Any]:
    """Return the entries `real` and `labels`; none of them with fewer than 20 scenes."""
    if len(scenes) < LEAST_SCENES or artifact.calibration.outlier is None:
        return {}
    detector = detector_of(artifact)
    rows, pairs = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    for draw in range(_DRAWS):
        for encoded in scenes:
            rng = scene_rng(encoded, 2 * seed + draw)
            seen = detector.draw(encoded, artifact.vocabulary.structure.tolist(), rng)
            if len(seen.classes) < 2:
                continue
            pairs.append(pair_features(artifact, seen))
            if rng.random() < _INTRUDERS:
                seen = detector.with_intruder(seen, encoded.instance_classes, rng)
            rows.append(np.column_stack([real_features(artifact, seen), seen.right]))
    if not rows:
        return {}
    examples = np.concatenate(rows)
    entries: dict[str, Any] = {}
    if len(np.unique(examples[:, -1])) == 2:
        confidence, context, log_count, intercept = logistic(examples[:, :-1], examples[:, -1] > 0)
        entries["real"] = RealFit(
            intercept=intercept,
            confidence=max(confidence, 0.0),
            context=max(context, 0.0),
            log_count=log_count,
        )
    different = np.concatenate(pairs)
    if len(different):
        # Both orders of each pair: the regression then has no intercept.
        features = np.concatenate([different, -different])
        truth = np.arange(len(features)) < len(different)
        confidence, context, _ = logistic(features, truth)
        entries["labels"] = LabelFit(confidence=max(confidence, 0.0), context=max(context, 0.0))
    return entries


def seen_scene(seen: Detections) -> Scene:
    """Return the scene of some detections, with their first labels."""
    rows = zip(seen.classes.tolist(), seen.confidence.tolist(), strict=True)
    return Scene(tuple(SceneObject(str(k), str(c), int(c), p) for k, (c, p) in enumerate(rows)))


def real_features(artifact: SceneModel, seen: Detections) -> Float[NDArray, "N 3"]:
    """Return logit of the confidence, score and log n of each detection; see `RealFit`."""
    posterior, vocabulary = Posterior(artifact, seen_scene(seen)), artifact.vocabulary
    score = posterior.given_rest()[0] - artifact.intruder_prior[posterior.present.classes]
    score[~vocabulary.judged[posterior.present.classes]] = 0.0
    if posterior.listed < 2:
        score[:] = 0.0
    logit = np.log(seen.confidence / (1 - seen.confidence))
    log_n = np.full(len(logit), np.log(max(1, posterior.listed)))
    return np.column_stack([logit, score[posterior.present.row], log_n])


def pair_features(artifact: SceneModel, seen: Detections) -> Float[NDArray, "n 2"]:
    """Return the features of the right label minus those of the wrong one; see `LabelFit`."""
    guesses = {
        row: Guesses(["", ""], [int(first), int(other)], [float(p), float(q)])
        for row, (first, p, _, other, q) in enumerate(zip(*seen, strict=True))
        if other >= 0
    }
    if not guesses:
        return np.zeros((0, 2))
    logit, z = label_log_odds(artifact, seen_scene(seen), guesses)
    features = np.column_stack([logit, z]).reshape(len(guesses), 2, 2)
    difference = features[:, 0] - features[:, 1]
    is_right = seen.right[list(guesses)]
    return np.where(is_right[:, None], difference, -difference)
