"""Outside tests: questions from a file of the user, which no training read.

The file contains scenes in any format of `read_scenes`, such as JSON lines. The labels are read
with the vocabulary of the evaluated model. Intervals come from resampled groups of scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import torch

from app.model import SceneModel
from app.registry import Artifact
from app.registry import Metric as CardMetric
from app.scene import Vocabulary
from training.datasets import AnnotatedScene, DatasetError, annotated_classes, encode, read_scenes
from training.datasets.batches import SceneTensors, scene_tensors
from training.datasets.records import digest_of
from training.evaluation.artifact_model import artifact_model
from training.evaluation.report import Progress, card_figures, measure, silent
from training.evaluation.setting import Setting
from training.evaluation.tasks import TASKS, WHOLE_SET

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

    def tensors(self, vocabulary: Vocabulary) -> SceneTensors:
        """Return the scenes in the classes of a vocabulary; a single group is split into rooms."""
        encoded = encode(self.scenes, vocabulary)
        if len({scene.group for scene in encoded}) == 1:
            encoded = [replace(scene, group=scene.scene_id) for scene in encoded]
        return scene_tensors(encoded, annotated_classes(encoded, vocabulary), vocabulary)

    def measure(self, model: SceneModel, progress: Progress = silent) -> list[CardMetric]:
        """Return the metrics of `ROOM_TASKS`; T3 intruders have the popularity of the file."""
        scenes = self.tensors(model.vocabulary)
        structure = torch.from_numpy(model.vocabulary.structure.copy())
        setting = Setting(scenes, structure, train=scenes, limit=None)
        answers, tasks = artifact_model(model), ROOM_TASKS
        return card_figures(measure(answers, setting, self.source, tasks=tasks, progress=progress))

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
