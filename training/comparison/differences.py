"""Two models on the same scenes: what each scores, and the difference with its interval.

Scenes of one group are near-duplicates of each other, so the bootstrap draws groups, not scenes.

Source: Field and Welsh, "Bootstrapping clustered data" (2007).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.contenders import Contender
from training.evaluation.intervals import RESAMPLES, Figure, interval, scene_weights
from training.evaluation.metrics import SceneMetric
from training.evaluation.report import Progress, SourceReport, digest, run, silent
from training.evaluation.tasks import Setting

# By task the metrics that are compared, its primary one first.
COMPARED: Mapping[str, tuple[str, ...]] = {
    "T2 missing": ("MRR", "top-1", "top-10"),
    "T2-at missing at a place": ("MRR",),
    "T3 outliers, uniform": ("hit@1", "AUROC"),
    "T1a relations": ("R-precision, instance counts", "R-precision, distinct classes"),
    "T1b completion": ("R-precision",),
    "T3b placement": ("hit@1",),
}


@dataclass(frozen=True)
class Difference:
    """One metric of both.

    Attributes:
        task, metric: as in the evaluation's tables; more is better in all of them.
        primary: the metric by which the task is judged.
        a, b: the values.
        difference: a minus b, paired, over groups.
    """

    task: str
    metric: str
    primary: bool
    a: float
    b: float
    difference: Figure

    @property
    def verdict(self) -> str:
        """Which is better, where the interval tells."""
        if self.difference.low > 0:
            return "better"
        return "worse" if self.difference.high < 0 else "undecided"


RELATIONAL = ("T1a relations", "T1b completion", "T2-at missing at a place", "T3b placement")
"""The tasks that only scenes with relations ask about."""

_RELATED = ("T2-at missing at a place", "T3b placement")

# What stands for a model in a task.
Rival = Callable[[str], Contender]


def differences(
    a: Rival,
    b: Rival,
    scenes: SceneTensors,
    structure: Tensor,
    *,
    progress: Progress = silent,
) -> list[Difference]:
    """Every compared metric that both have on the scenes.

    Args:
        structure: (V,) bool.

    Raises:
        ValueError: fewer than two groups: no interval can be told.
    """
    setting = Setting(scenes, structure, limit=None)
    # Tasks that are about annotated relations leave out scenes without any.
    groups = {related: _groups(setting.some(related)) for related in (False, True)}
    if len(set(groups[False])) < 2:
        raise ValueError("the scenes are of fewer than two groups: no interval can be told")
    reports = []
    for name, rival in (("first", a), ("second", b)):
        report = SourceReport(name, digest(setting))
        for task in COMPARED:
            for _ in run(rival(task), setting, report, tasks=[task], progress=progress):
                pass
        reports.append(report)
    progress("resampling groups")
    found = []
    for task, metrics in COMPARED.items():
        ours, theirs = (report.outcomes[task] for report in reports)
        if ours is None or theirs is None:
            continue
        for name in metrics:
            x, y = ours.metrics[name], theirs.metrics[name]
            if isinstance(x, SceneMetric) and isinstance(y, SceneMetric):
                difference = paired_over_groups(x, y, groups[task in _RELATED])
                primary = name == metrics[0]
                found.append(Difference(task, name, primary, x.value, y.value, difference))
    return found


def _groups(scenes: SceneTensors) -> list[str]:
    # A group that several sources share is one place.
    return [scene.group for scene in scenes.scenes]


def paired_over_groups(
    a: SceneMetric,
    b: SceneMetric,
    groups: Sequence[str],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Figure:
    """a minus b, with the interval over groups drawn with replacement.

    Args:
        groups: of each scene.

    Raises:
        ValueError: the metrics are not of as many scenes.
    """
    if not a.scenes == b.scenes == len(groups):
        raise ValueError(f"cannot pair {a.scenes} scenes with {b.scenes}, of {len(groups)} groups")
    names, place = np.unique(np.array(groups), return_inverse=True)
    draws: NDArray[np.float64] = np.array(
        [
            a.at(weight[place]) - b.at(weight[place])
            for weight in scene_weights(len(names), resamples, seed)
        ]
    )
    low, high = interval(draws)
    return Figure(a.value - b.value, low, high, min(a.n, b.n))
