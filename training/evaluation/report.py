"""Reports: the metrics of a model or baseline on one data source, or pooled over data sources.

A `SourceReport` stores the values of each group of near-duplicate scenes. So reports can be pooled
over data sources, and compared by paired resampling, without the models.

A `RoomList` asks the questions of a file of the user, which no training read: scenes in any format
of `read_scenes`, such as JSON lines. The vocabulary of the evaluated model reads the labels.
Intervals come from resampled groups of scenes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from app.model import SceneModel
from app.registry import Artifact
from app.registry import Metric as CardMetric
from app.scene import Vocabulary
from training.datasets import AnnotatedScene, DatasetError, annotated_classes, encode, read_scenes
from training.datasets.batches import SceneTensors, scene_tensors
from training.datasets.files import write_whole
from training.datasets.records import digest_of
from training.evaluation.asking import artifact_model
from training.evaluation.everyday_task import SOURCE, facts_file
from training.evaluation.metrics import Metric, Ratio, Resampled, Scored
from training.evaluation.setting import Model, Outcome, Setting, Structure
from training.evaluation.tasks import EVERY_TASK, ONCE, TASKS, WHOLE_SET

_LIMIT = 200  # maximum number of scenes per data source in slow tasks

Progress = Callable[[str], None]


def silent(_: str) -> None:
    """Ignore progress messages."""


@dataclass
class SourceReport:
    """Results of one model or baseline on one data source."""

    source: str  # name of the data source, or "pooled"
    scenes: str  # `digest` of the questions
    # By task; None if the model does not support the task.
    outcomes: dict[str, Outcome | None] = field(default_factory=dict)
    parameters: int | None = None  # number of trained weights

    def write(self, path: Path) -> None:
        """Write the report into a JSON file."""
        write_whole(path, json.dumps(self, default=to_json, allow_nan=False))

    @classmethod
    def read(cls, path: Path) -> SourceReport:
        """Read a report from a file."""
        return cls(**json.loads(path.read_text(encoding="utf-8"), object_hook=from_json))


def digest(setting: Setting) -> str:
    """Return the sha256 of the questions: scene ids, limit, seed and everyday facts."""
    names = [f"{scene.source} {scene.scene_id}" for scene in setting.scenes.scenes]
    path = None if setting.everyday is None else facts_file(setting.everyday)
    facts = "" if path is None else path.read_text(encoding="utf-8")
    text = "\n".join([*names, f"limit {setting.limit}", f"seed {setting.seed}", facts])
    return sha256(text.encode()).hexdigest()


def measure(
    model: Model,
    setting: Setting,
    source: str,
    *,
    tasks: Iterable[str] = tuple(TASKS),
    progress: Progress = silent,
) -> SourceReport:
    """Measure tasks, which are keys of `EVERY_TASK`."""
    report = SourceReport(source, digest(setting), parameters=model.parameters)
    for task in tasks:
        progress(f"{source}: {task}")
        report.outcomes[task] = EVERY_TASK[task](model, setting)
    return report


def pooled(reports: Sequence[SourceReport], source: str = "pooled") -> SourceReport:
    """Pool the reports on several data sources, without metrics of a whole set of scenes (T4)."""
    together = sha256("\n".join(report.scenes for report in reports).encode()).hexdigest()
    parameters = reports[0].parameters if reports else None
    joined = SourceReport(source, together, parameters=parameters)
    for task in dict.fromkeys(task for report in reports for task in report.outcomes):
        parts = [outcome for report in reports if (outcome := report.outcomes.get(task))]
        metrics = {
            name: metric
            for name in dict.fromkeys(name for part in parts for name in part.metrics)
            if (metric := pool([part.metrics[name] for part in parts if name in part.metrics]))
        }
        counts = sum(part.scenes for part in parts), sum(part.skipped for part in parts)
        joined.outcomes[task] = Outcome(metrics, *counts) if metrics else None
    return joined


def evaluate(
    artifact: SceneModel,
    scenes: SceneTensors,
    structure: Structure,
    train: SceneTensors,
    *,
    limit: int = _LIMIT,
    everyday: Path | None = None,
    tasks: Collection[str] | None = None,
    progress: Progress = silent,
) -> list[CardMetric]:
    """Measure the metrics of a model card, on every data source or, for T4, on all together."""
    model = artifact_model(artifact)
    selected = [
        name for name, task in EVERY_TASK.items() if task.card and (tasks is None or name in tasks)
    ]
    of_source = [task for task in selected if task not in WHOLE_SET]
    once = [task for task in selected if task in ONCE]  # about facts, not about the scenes
    whole = [task for task in selected if task in WHOLE_SET and task not in ONCE]
    every = Setting(scenes, structure, train, limit=limit)
    by_name = dict(every.by_source())
    together = next(iter(by_name)) if len(by_name) == 1 else "pooled"
    questions = [
        *((source, setting, of_source) for source, setting in by_name.items()),
        (together, every, whole),
        (SOURCE, replace(every, train=None, everyday=everyday), once),
    ]
    return [
        row
        for source, setting, names in questions
        for row in card_figures(measure(model, setting, source, tasks=names, progress=progress))
    ]


def card_figures(report: SourceReport) -> list[CardMetric]:
    """Return the figures of a model card that have an interval, which needs two groups."""
    return [
        CardMetric(task=task, source=report.source, metric=name, **asdict(metric.figure()))
        for task, outcome in report.outcomes.items()
        if outcome is not None
        for name in EVERY_TASK[task].card
        if (metric := outcome.metrics.get(name)) and len(metric.groups) > 1
    ]


def pool(parts: Sequence[Metric]) -> Metric | None:
    """Pool a metric over the scenes of all parts. Return None for a metric of a whole set.

    Raises:
        ValueError: `parts` is empty or contains metrics of different types.
    """
    kinds = {(type(part), getattr(part, "statistic", "")) for part in parts}
    if len(kinds) != 1:
        raise ValueError(f"metrics to pool must have one type, not {len(kinds)} types")
    return type(parts[0]).join(parts)


_KINDS: dict[str, type[Any]] = {cls.__name__.lower(): cls for cls in (Ratio, Scored, Resampled)}
_TYPES: dict[str, type] = {"unit": np.int64, "groups": np.int64, "truth": np.bool_}


def to_json(value: Any) -> Any:
    """Return the entries of an array, a metric, an outcome or a report for JSON.

    Floats of arrays are rounded to nine significant digits, with null for values that are not
    finite, such as a resample in which the metric is undefined.
    """
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return [float(f"{x:.9g}") if np.isfinite(x) else None for x in value.tolist()]
    if isinstance(value, np.ndarray):
        return value.astype(np.int64).tolist()
    kind = {"kind": type(value).__name__.lower()} if isinstance(value, Metric) else {}
    return kind | {entry.name: getattr(value, entry.name) for entry in fields(value)}


def from_json(values: dict[str, Any]) -> Any:
    """Create a metric or an outcome from the entries of `to_json`; return other entries."""
    if "metrics" in values:
        return Outcome(**values)
    if "kind" not in values:
        return values
    entries = {
        name: np.array(value, _TYPES.get(name, np.float64)) if isinstance(value, list) else value
        for name, value in values.items()
        if name != "kind"
    }  # numpy reads None as NaN
    return _KINDS[values["kind"]](**entries)


ROOM_TASKS: Final = tuple(name for name in TASKS if name not in WHOLE_SET)
"""Tasks that a room list is asked. The others compare the answers with training scenes."""


def read_test(path: Path) -> RoomList:
    """Read the scenes of a file.

    Raises:
        DatasetError: the file has no known format, is invalid or contains no scenes.
    """
    name = path.name.partition(".")[0]
    scenes = [replace(scene, source=name) for scene in read_scenes(path)]
    if not scenes:
        raise DatasetError(path, "", "contains no scenes")
    return RoomList(name, scenes)


@dataclass(frozen=True, eq=False)
class RoomList:
    """The scenes of a file, with the name of the file as source."""

    source: str
    scenes: Sequence[AnnotatedScene]

    def setting(self, vocabulary: Vocabulary, limit: int | None = None) -> Setting:
        """Return the scenes in the classes of a vocabulary; a single group is split into rooms.

        T3 intruders have the popularity of the file.
        """
        encoded = encode(self.scenes, vocabulary)
        if len({scene.group for scene in encoded}) == 1:
            encoded = [replace(scene, group=scene.scene_id) for scene in encoded]
        scenes = scene_tensors(encoded, annotated_classes(encoded, vocabulary), vocabulary)
        structure = torch.from_numpy(vocabulary.structure.copy())
        return Setting(scenes, structure, train=scenes, limit=limit)

    def measure(self, model: SceneModel, progress: Progress = silent) -> list[CardMetric]:
        """Return the metrics of `ROOM_TASKS`."""
        asked = artifact_model(model), self.setting(model.vocabulary), self.source
        return card_figures(measure(*asked, tasks=ROOM_TASKS, progress=progress))

    def trained(self, artifact: Artifact) -> list[str]:
        """Return the source if the model learnt from exactly these scenes."""
        is_trained = any(
            entry.scenes == len(self.scenes)
            and digest_of([replace(scene, source=entry.source) for scene in self.scenes])
            == entry.digest
            for entry in artifact.manifest.data
        )
        return [self.source] if is_trained else []

    def remark(self, model: SceneModel) -> str:
        """Return the number of objects with unknown labels."""
        labels = [thing.label for scene in self.scenes for thing in scene.objects]
        unknown = sum(model.vocabulary.index(label) is None for label in labels)
        reason = "objects are left out, because their labels are unknown"
        return f"{unknown:,} of {len(labels):,} {reason}" if unknown else ""
