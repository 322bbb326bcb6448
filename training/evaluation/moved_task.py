"""T3c: one object of a scene stands at a wrong place. Which object has moved?

Each scene is asked twice: with a moved object, and untouched. Scenes with boxes are asked as poses,
without relations. An object then stands on another object, on the floor or under its supporter.
Other scenes state at most 40 relations, one of them an altered support. See
`training.datasets.moved`. The room type is not stated. Scenes without a possible move are skipped.

    named first             share of scenes whose first misplaced relation names the moved object in
                            the field `moved`
    flagged at 5 % alarms   share of scenes in which the highest probability about the moved object
                            exceeds a threshold. At this threshold, at most 5 % of the untouched
                            scenes of the same source have an alarm

A misplaced relation is about the object in its field `moved`. Without this field, it is about its
subject.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.scene import Scene
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_rng, some_scenes
from training.datasets.moved import moved_scene, untouched_scene
from training.evaluation.asking import ask_every
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.setting import MisplacedScore, Outcome, Setting, Structure

ALARMS: Final = 0.05  # share of untouched scenes with an alarm at the threshold

METRICS: Final = ("named first", "flagged at 5 % alarms")

_SCENES: Final = 300  # maximum number of scenes of a source


@dataclass(frozen=True, eq=False)
class MovedCase:
    """A scene with the moved object `object`, and the same scene without the move."""

    scene_index: int
    moved: Scene
    object: str
    untouched: Scene


def moved_cases(scenes: SceneTensors, structure: Structure, seed: int = 0) -> list[MovedCase]:
    """Return a case for each scene in which an object can move."""
    is_structure = structure.numpy()
    cases = []
    for scene_index, encoded in enumerate(scenes.scenes):
        case = moved_scene(encoded, is_structure, scene_rng(encoded, seed))
        untouched = untouched_scene(encoded, is_structure, scene_rng(encoded, seed))
        if case is not None and untouched is not None:
            scene, index = case
            scene, untouched = (replace(entry, room_type=None) for entry in (scene, untouched))
            cases.append(MovedCase(scene_index, scene, scene.objects[index].id, untouched))
    return cases


def ask_moved(score: MisplacedScore, cases: Sequence[MovedCase]) -> Float[NDArray, "N 3"]:
    """Return the answers to N cases.

    The columns are 1 if the moved object is named first, the highest probability about the moved
    object, and that in the untouched scene; 0 without an entry.
    """

    def ask(case: MovedCase) -> Float[NDArray, " 3"]:
        entries, untouched = score(case.moved), score(case.untouched)
        is_first = bool(entries) and entries[0].get("moved") == case.object
        return np.array([is_first, _highest(entries, case.object), _highest(untouched)])

    return np.array(ask_every(ask, cases)).reshape(-1, 3)


def _highest(entries: Sequence[Mapping[str, Any]], object_: str | None = None) -> float:
    """Return the highest probability of the entries about an object; None means all entries."""
    values = [
        float(entry["probability"])
        for entry in entries
        if object_ is None or (entry.get("moved") or entry["subject"]) == object_
    ]
    return max(values, default=0.0)


def flagged(
    suspicion: Float[NDArray, " N"], untouched: Float[NDArray, " N"], source: Int[NDArray, " N"]
) -> Bool[NDArray, " N"]:
    """Return whether each suspicion exceeds the threshold of its source; see `ask_moved`."""
    is_flagged = np.zeros(len(source), dtype=np.bool_)
    for name in np.unique(source):
        in_source = source == name
        threshold = np.sort(untouched[in_source])[-1 - int(ALARMS * in_source.sum())]
        is_flagged[in_source] = suspicion[in_source] > threshold
    return is_flagged


def moved_task(score: MisplacedScore, setting: Setting) -> Outcome | None:
    """Measure T3c: the shares of moved objects that are named first, and flagged."""
    scenes = some_scenes(setting.some(related=True), _SCENES, setting.seed)
    cases = moved_cases(scenes, setting.structure, setting.seed)
    if not cases:
        return None
    first, suspicion, untouched = ask_moved(score, cases).T
    index = np.array([case.scene_index for case in cases])
    values = first, flagged(suspicion, untouched, scenes.source.numpy()[index])
    metrics: dict[str, Metric] = {
        name: Ratio.of_items(index, value, len(scenes))
        for name, value in zip(METRICS, values, strict=True)
    }
    return Outcome.over(scenes, metrics, len(scenes) - len(cases))
