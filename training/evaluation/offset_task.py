"""Test the placement offsets of a model on held-out scenes.

An offset is the position of a relation's subject minus the position of its object, in metres. The
model has a distribution of offsets for each relation and pair of classes. It gives an ellipse in
the horizontal plane and an ellipsoid in space, which should contain 80 % of the offsets each. The
task measures the shares of held-out offsets in them. It also measures the distance of offsets to
the mean for the relation and classes, and to the mean for the relation alone.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import chdtri

from app.model import SceneModel
from app.scene import CANONICAL
from training.datasets.cases import observed_offsets
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.setting import Outcome, Setting

SHARE: Final = 0.8  # share of the offsets that each ellipse or ellipsoid should contain

_REGIONS: Final = {"the ellipse": 2, "the ellipsoid": 3}
"""Number of axes of each region: two axes are x and y, three axes are x, y and z."""

METRICS: Final = (
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
