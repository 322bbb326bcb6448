"""Test the expected numbers of instances of a model on held-out scenes.

A robot lists a part of each scene (`datasets.cases.some_instances`) and asks for the expected
number of instances of each listed class. The task measures the mean absolute error of this number.
It compares the error with the errors of two means:

- the class mean: the mean number in the training scenes of the model that have at least the listed
  number;
- the mean of the source: the mean number in the training scenes of the same data source. If it is
  smaller than the listed number, the listed number takes its place.

Classes without statistics, and classes whose instances the source does not count, are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from app.model import SceneModel
from app.model.count_statistics import Counts
from app.questions.missing import LIKELY, more
from app.questions.posterior import present
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats, Ints
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
    counting = counted_classes(train.scenes, artifact.vocabulary)
    is_counted = torch.tensor([scene.source in counting for scene in setting.scenes.scenes])
    scenes = setting.at(is_counted.nonzero().squeeze(1)).scenes
    answers = [
        (scene_index, *answer)
        for scene_index, scene in enumerate(scenes.scenes)
        for answer in _ask_counts(artifact, scene, counting[scene.source], setting.seed)
    ]
    if not answers:
        return None
    scene_index, index, number, listed, expected, low, high, p = np.array(answers).T
    scene_index, index, k = (x.astype(np.int64) for x in (scene_index, index, listed))

    def error(guess: Floats) -> Ratio:
        return Ratio.of_items(scene_index, np.abs(guess - number), len(scenes))

    row = np.searchsorted(artifact.counts.classes, index)
    ours, mean_error = error(expected), error(class_mean(artifact.counts, row, k))
    of_source = error(np.maximum(_mean_counts(train.scenes, artifact)[index], listed))
    is_inside = ((low <= number) & (number <= high)).astype(np.float64)
    metrics: dict[str, Metric] = {
        "error of the expected count": ours,
        "error of the class mean": mean_error,
        "change of error, class mean": ours - mean_error,
        "change of error, mean of the source": ours - of_source,
        "count in the interval": Ratio.of_items(scene_index, is_inside, len(scenes)),
    }
    if (is_likely := p >= LIKELY).any():
        is_right = (number > listed)[is_likely].astype(np.float64)
        hits = Ratio.of_items(scene_index[is_likely], is_right, len(scenes))
        metrics["proposals that are right"] = hits
    return Outcome.over(scenes, metrics, len(scenes) - len(np.unique(scene_index)))


def _ask_counts(
    artifact: SceneModel, scene: EncodedScene, counted: Flags, seed: int
) -> list[tuple[float, ...]]:
    """Return (class, number, listed, expected, low, high, probability) of each listed class."""
    part, asked = listed_cases(scene, counted, artifact.vocabulary.structure, seed)
    room = part.room if part.room >= 0 else None
    scene_part = of_classes(np.repeat(part.classes, part.listed).tolist())
    scene_part = replace(scene_part, room_type=room)
    listing = present(scene_part, artifact.spec)
    candidates = part.classes[asked].tolist()
    labels = artifact.vocabulary.labels
    pairs = zip(part.classes.tolist(), part.number.tolist(), strict=True)
    number_of = {labels[index]: (index, number) for index, number in pairs}
    entries = more(artifact, scene_part, listing, top_k=len(candidates), candidates=candidates)
    fields = ("listed_count", "expected_count", "low", "high", "probability")
    return [(*number_of[entry["label"]], *(entry[name] for name in fields)) for entry in entries]


def _mean_counts(scenes: Sequence[EncodedScene], artifact: SceneModel) -> Floats:
    """Return the mean number of instances of each class in the scenes with the class, (V,)."""
    times, total = np.zeros((2, len(artifact.vocabulary)))
    for scene in scenes:
        times[scene.evidence.classes] += 1
        total[scene.evidence.classes] += np.minimum(scene.evidence.counts, MOST)
    means: Floats = total / np.maximum(times, 1)
    return means


def class_mean(counts: Counts, row: Ints, listed: Ints) -> Floats:
    """Return the mean number in training scenes with at least the listed number, (k,).

    `row` (k,) are the rows of the classes in `counts`.
    """
    numbers = np.arange(1, counts.log_share.shape[1] + 1)
    p = np.exp(counts.log_share[row].astype(np.float64)) * (numbers >= listed[:, None])
    mean: Floats = p @ numbers / p.sum(axis=1)
    return mean
