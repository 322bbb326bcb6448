"""Test the expected numbers of instances of a model on held-out scenes.

A robot lists a part of each scene (`datasets.cases.some_instances`) and asks for the expected
number of instances of each listed class. The task compares the mean absolute error of this number
with the errors of two means:

- the class mean: over the training scenes of the model with at least the listed number;
- the mean of the source: over the training scenes of the same data source, and at least the listed
  number.

Classes without statistics, and classes whose instances the source does not count, are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.model import SceneModel
from app.model.statistics import Counts
from app.questions.missing import LIKELY, more
from app.questions.posterior import present
from training.datasets import EncodedScene
from training.datasets.cases import MOST, counted_classes, listed_cases
from training.evaluation.asking import of_classes
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.setting import Outcome, Setting

METRICS: Final = (
    "error of the expected count",
    "error of the class mean",
    "change of error, class mean",
    "change of error, mean of the source",
    "count in the interval",
    "proposals that are right",
)


def counts_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the errors, the share of counts in the interval and the precision of proposals."""
    train = setting.train
    if artifact.counts is None or train is None:
        return None
    counted = counted_classes(train.scenes, artifact.vocabulary)
    is_counted = torch.tensor([scene.source in counted for scene in setting.scenes.scenes])
    scenes = setting.at(is_counted.nonzero().squeeze(1)).scenes
    answers = [
        (k, *answer)
        for k, scene in enumerate(scenes.scenes)
        for answer in _ask_counts(artifact, scene, counted[scene.source], setting.seed)
    ]
    if not answers:
        return None
    scene, index, number, listed, expected, low, high, p = np.array(answers).T
    scene, index, listed_number = (x.astype(np.int64) for x in (scene, index, listed))

    def mean(values: Float[NDArray, " N"]) -> Ratio:
        return Ratio.of_items(scene, values, len(scenes))

    row = np.searchsorted(artifact.counts.classes, index)
    of_class = mean(np.abs(class_mean(artifact.counts, row, listed_number) - number))
    source_mean = np.maximum(_mean_counts(train.scenes, artifact)[index], listed)
    error = mean(np.abs(expected - number))
    metrics: dict[str, Metric] = {
        "error of the expected count": error,
        "error of the class mean": of_class,
        "change of error, class mean": error - of_class,
        "change of error, mean of the source": error - mean(np.abs(source_mean - number)),
        "count in the interval": mean((low <= number) & (number <= high)),
    }
    if (is_likely := p >= LIKELY).any():
        is_right = (number > listed)[is_likely]
        precision = Ratio.of_items(scene[is_likely], is_right, len(scenes))
        metrics["proposals that are right"] = precision
    return Outcome.over(scenes, metrics, error.skipped)


def _ask_counts(
    artifact: SceneModel, scene: EncodedScene, counted: Bool[NDArray, " V"], seed: int
) -> list[tuple[float, ...]]:
    """Return (class, number, listed, expected, low, high, probability) of each listed class."""
    part, is_candidate = listed_cases(scene, counted, artifact.vocabulary.structure, seed)
    request = of_classes(np.repeat(part.classes, part.listed).tolist())
    request = replace(request, room_type=part.room if part.room >= 0 else None)
    candidates, labels = part.classes[is_candidate].tolist(), artifact.vocabulary.labels
    pairs = zip(part.classes.tolist(), part.number.tolist(), strict=True)
    number_of = {labels[index]: (index, number) for index, number in pairs}
    listing = present(request, artifact.spec)
    entries = more(artifact, request, listing, top_k=len(candidates), candidates=candidates)
    fields = ("listed_count", "expected_count", "low", "high", "probability")
    return [(*number_of[entry["label"]], *(entry[name] for name in fields)) for entry in entries]


def _mean_counts(scenes: Sequence[EncodedScene], artifact: SceneModel) -> Float[NDArray, " V"]:
    """Return the mean number of instances of each class in the scenes with the class."""
    times, total = np.zeros((2, len(artifact.vocabulary)))
    for scene in scenes:
        times[scene.evidence.classes] += 1
        total[scene.evidence.classes] += np.minimum(scene.evidence.counts, MOST)
    return total / np.maximum(times, 1)


def class_mean(
    counts: Counts, row: Int[NDArray, " k"], listed: Int[NDArray, " k"]
) -> Float[NDArray, " k"]:
    """Return the mean number in training scenes with at least `listed`, for rows of `counts`."""
    numbers = np.arange(1, counts.log_share.shape[1] + 1)
    p = np.exp(counts.log_share[row].astype(np.float64)) * (numbers >= listed[:, None])
    return p @ numbers / p.sum(axis=1)
