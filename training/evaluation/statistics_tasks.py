"""Test the statistics of a model, which training scenes give, on held-out scenes.

Offsets: an offset is the position of a relation's subject minus the position of its object, in
metres. The model has a distribution of offsets for each relation and pair of classes. It gives an
ellipse in the horizontal plane and an ellipsoid in space, which should contain 80 % of the offsets
each. The task measures the shares of held-out offsets in them. It also measures the distance of
offsets to the mean for the relation and classes, and to the mean for the relation alone.

Counts: a robot lists a part of each scene (`datasets.cases.some_instances`) and asks for the
expected number of instances of each listed class. The task compares the mean absolute error of this
number with the errors of two means over the training scenes with at least the listed number: those
of the model, and those of the same data source. Classes without statistics, and classes whose
instances the source does not count, are left out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.special import chdtri

from app.model import SceneModel
from app.model.statistics import Counts
from app.questions.missing import LIKELY, more
from app.questions.posterior import present
from app.scene import CANONICAL
from training.datasets import EncodedScene
from training.datasets.batches import subset
from training.datasets.cases import MOST, counted_classes, listed_cases, observed_offsets
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.parts import of_classes
from training.evaluation.setting import Outcome, Setting

SHARE: Final = 0.8  # share of the offsets that each ellipse or ellipsoid should contain

_REGIONS: Final = {"the ellipse": 2, "the ellipsoid": 3}
"""Number of axes of each region: two axes are x and y, three axes are x, y and z."""

OFFSETS: Final = (
    *(f"in {region}, {name}" for name in CANONICAL for region in _REGIONS),
    "distance (m)",
    "distance (m), relation alone",
)


def offsets_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the share of covered offsets for each relation, and the distances for all."""
    if (offsets := artifact.offsets) is None:
        return None
    scenes = setting.scenes.scenes
    all_offsets = observed_offsets(scenes)
    has_statistics = offsets.relation_scenes[all_offsets.relation] > 0
    if not has_statistics.any():
        return None
    observed = all_offsets.rows(has_statistics)
    values, _ = offsets.find(observed.relation, observed.subject, observed.other)
    deviation = observed.offset - values[:, :3]
    squares = np.square(deviation / values[:, 3:])
    metrics: dict[str, Metric] = {}
    for a in np.unique(observed.relation):
        in_relation = observed.relation == a
        for region, axes in _REGIONS.items():
            is_inside = squares[in_relation, :axes].sum(axis=1) <= chdtri(axes, 1 - SHARE)
            metrics[f"in {region}, {CANONICAL[a]}"] = Ratio.of_items(
                observed.scene[in_relation], is_inside.astype(np.float64), len(scenes)
            )
    residual = observed.offset - offsets.relation[observed.relation, :3]
    for name, vectors in (("distance (m)", deviation), ("distance (m), relation alone", residual)):
        distance = np.linalg.norm(vectors, axis=1)
        metrics[name] = Ratio.of_items(observed.scene, distance, len(scenes))
    return Outcome.over(setting.scenes, metrics, len(scenes) - len(np.unique(observed.scene)))


COUNTS: Final = (
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
    scenes = subset(setting.scenes, is_counted)
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
    # The setting has one data source, so the mean of its training scenes is that of the source.
    class_scenes, instances = np.zeros((2, len(artifact.vocabulary)))
    for evidence in (encoded.evidence for encoded in train.scenes):
        class_scenes[evidence.classes] += 1
        instances[evidence.classes] += np.minimum(evidence.counts, MOST)
    source_mean = np.maximum((instances / np.maximum(class_scenes, 1))[index], listed)
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


def class_mean(
    counts: Counts, row: Int[NDArray, " k"], listed: Int[NDArray, " k"]
) -> Float[NDArray, " k"]:
    """Return the mean number in training scenes with at least `listed`, for rows of `counts`."""
    numbers = np.arange(1, counts.log_share.shape[1] + 1)
    p = np.exp(counts.log_share[row].astype(np.float64)) * (numbers >= listed[:, None])
    return p @ numbers / p.sum(axis=1)
