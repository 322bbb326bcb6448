"""The task Where: a thing is taken away from a home, and `/where` looks for it.

The cases are those of `training.datasets.homes`. A request lists all other objects of each room,
and its type. Metrics of things that were in the home:

    first room        share of things whose room is the first
    first three       share of things whose room is among the first three
    first room, rooms alone
                      the same by `/rooms` for the thing, with the types of the rooms as candidates
    first room, popularity
                      the same by the room with the most objects
    first place       share of things that `/where` names at their supporter, first of all places;
                      of things whose supporter is annotated

For ties, a metric is the expectation under random order.

    ECE               calibration error of the probability of the first room, also for things that
                      were never there
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app import questions
from app.model import SceneModel
from app.questions.where import Room, where
from app.scene.spatial_relations import SUPPORTS
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask
from training.datasets.cases import scene_of
from training.datasets.homes import NOWHERE, HomeCase, home_cases
from training.evaluation.metrics import Metric, Ratio, Scored
from training.evaluation.parts import of_classes
from training.evaluation.setting import Outcome, Setting

WHERE: Final = ("first room", "first three", "first place", "ECE")
RIVALS: Final = ("first room, rooms alone", "first room, popularity")


def where_task(model: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the rooms and places of taken things; None without homes or room types."""
    scenes = setting.scenes  # all of them, because a part of the scenes has parts of homes
    index = {(one.source, one.scene_id): k for k, one in enumerate(scenes.scenes)}
    structure = setting.structure.numpy()
    cases = home_cases(scenes.scenes, structure, setting.seed)
    if not model.spec.C or not cases:
        return None
    rows: dict[str, list[tuple[int, float]]] = {name: [] for name in (*WHERE[:3], *RIVALS)}
    certainty = list[tuple[int, float, bool]]()
    for case in cases:
        scene = index[case.rooms[0].source, case.rooms[0].scene_id]
        answer = where(model, rooms_of(model, case), case.thing)
        p = np.zeros(len(case.rooms))
        for entry in answer["rooms"]:
            p[int(entry["room"])] = entry["probability"]
        certainty.append((scene, float(p.max()), int(p.argmax()) == case.room))
        if case.room == NOWHERE:
            continue
        rows["first room"].append((scene, _top(p, case.room, 1)))
        rows["first three"].append((scene, _top(p, case.room, 3)))
        rows["first room, rooms alone"].append((scene, _top(_alone(model, case), case.room, 1)))
        sizes = np.array([len(room.instance_classes) for room in case.rooms], float)
        rows["first room, popularity"].append((scene, _top(sizes, case.room, 1)))
        if (is_right := _is_supporter(case, answer["places"][0], structure)) is not None:
            rows["first place"].append((scene, float(is_right)))
    metrics: dict[str, Metric] = {}
    for name, values in rows.items():
        if values:
            index_of, right = map(np.array, zip(*values, strict=True))
            metrics[name] = Ratio.of_items(index_of, right, len(scenes))
    unit, score, truth = map(np.array, zip(*certainty, strict=True))
    metrics["ECE"] = Scored("ECE", unit, score, truth, np.arange(len(scenes)))
    return Outcome.over(scenes, metrics, 0)


def rooms_of(artifact: SceneModel, case: HomeCase) -> list[Room]:
    """Return the rooms of a case without the thing, and with their types."""
    rooms = []
    for number, encoded in enumerate(case.rooms):
        kept = kept_objects(encoded, case.thing, artifact.vocabulary.structure)
        rooms.append(Room(str(number), scene_of(encoded, kept.tolist(), ())))
    return rooms


def kept_objects(
    encoded: EncodedScene, thing: int, structure: ClassMask
) -> Int[NDArray[np.int64], "k"]:
    """Return the indices of the objects of a room without the thing and without structure."""
    classes = encoded.instance_classes
    return np.flatnonzero(~structure[classes] & (classes != thing))


def _top(values: Float[NDArray, "rooms"], room: int, k: int) -> float:
    """Return the probability that a room is among the first k, with ties in random order."""
    above = int((values > values[room] + 1e-12).sum())
    ties = int((np.abs(values - values[room]) <= 1e-12).sum())
    return float(np.clip((k - above) / ties, 0.0, 1.0))


def _is_supporter(case: HomeCase, place: Mapping[str, Any], structure: ClassMask) -> bool | None:
    """Return whether a place names the class on or in which the thing was; None if unknown."""
    encoded = case.rooms[case.room]
    (instance,) = np.flatnonzero(encoded.instance_classes == case.thing)
    supporters = np.flatnonzero(encoded.instance_holds[[*SUPPORTS], instance].any(0))
    classes = set(encoded.instance_classes[supporters].tolist())
    if not classes or structure[list(classes)].any():
        return None
    if int(place["room"]) != case.room or place.get("relation") not in ("on-top", "inside"):
        return False
    kept = kept_objects(encoded, case.thing, structure)
    return int(encoded.instance_classes[kept[int(place["object"])]]) in classes


def _alone(model: SceneModel, case: HomeCase) -> Float[NDArray, "rooms"]:
    """Return the probability of each room's type by `/rooms` for the thing; 0 without a type."""
    types = [room.room_type for room in case.rooms]
    candidates = {t: [model.vocabulary.room_types[t]] for t in types if t >= 0}
    if not candidates:
        return np.zeros(len(types))
    answer = questions.rooms(
        model, of_classes([case.thing]), top_k=len(candidates), candidates=candidates, details=False
    )
    p = {entry["room_type"]: entry["probability"] for entry in answer["room_types"]}
    return np.array([0.0 if t < 0 else p[model.vocabulary.room_types[t]] for t in types])
