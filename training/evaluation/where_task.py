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
    ECE, places       calibration error of the probability of the first place, likewise, where
                      relations are annotated. A thing without a supporter is in the rest of its
                      room
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
from app.scene.spatial_relations import RELATIONS, SUPPORTS
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask
from training.datasets.cases import scene_of
from training.datasets.homes import NOWHERE, HomeCase, home_cases
from training.evaluation.metrics import Metric, Ratio, Scored
from training.evaluation.parts import of_classes
from training.evaluation.setting import Outcome, Setting

WHERE: Final = ("first room", "first three", "first place", "ECE", "ECE, places")
SUPPORT_NAMES: Final = tuple(RELATIONS[a] for a in SUPPORTS)
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
    certainty, of_places = list[tuple[int, float, bool]](), list[tuple[int, float, bool]]()
    for case in cases:
        scene = index[case.rooms[0].source, case.rooms[0].scene_id]
        answer = where(model, rooms_of(model, case), case.thing)
        p = np.zeros(len(case.rooms))
        for entry in answer["rooms"]:
            p[int(entry["room"])] = entry["probability"]
        certainty.append((scene, float(p.max()), int(p.argmax()) == case.room))
        place, supporters = answer["places"][0], supporters_of(case, structure)
        is_right = supporters is not None and _is_place(case, place, supporters, structure)
        if supporters is not None:
            of_places.append((scene, place["probability"], is_right))
        if case.room == NOWHERE:
            continue
        rows["first room"].append((scene, _top(p, case.room, 1)))
        rows["first three"].append((scene, _top(p, case.room, 3)))
        rows["first room, rooms alone"].append((scene, _top(_alone(model, case), case.room, 1)))
        sizes = np.array([len(room.instance_classes) for room in case.rooms], float)
        rows["first room, popularity"].append((scene, _top(sizes, case.room, 1)))
        if supporters:
            rows["first place"].append((scene, float(is_right)))
    metrics: dict[str, Metric] = {}
    for name, values in rows.items():
        if values:
            index_of, right = map(np.array, zip(*values, strict=True))
            metrics[name] = Ratio.of_items(index_of, right, len(scenes))
    for name, answers in (("ECE", certainty), ("ECE, places", of_places)):
        if answers:
            unit, score, truth = map(np.array, zip(*answers, strict=True))
            metrics[name] = Scored("ECE", unit, score, truth, np.arange(len(scenes)))
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


def supporters_of(case: HomeCase, structure: ClassMask) -> set[int] | None:
    """Return the classes on or in which the thing was, without structure.

    None if the relations of the room are not annotated.
    """
    encoded = case.rooms[max(case.room, 0)]
    if not encoded.instance_observed[[*SUPPORTS]].any():
        return None
    if case.room == NOWHERE:
        return set()
    (instance,) = np.flatnonzero(encoded.instance_classes == case.thing)
    supporters = np.flatnonzero(encoded.instance_holds[[*SUPPORTS], instance].any(0))
    classes = set(encoded.instance_classes[supporters].tolist())
    return set() if structure[list(classes)].any() else classes


def is_supporter(
    case: HomeCase, place: Mapping[str, Any], supporters: set[int], structure: ClassMask
) -> bool:
    """Return whether a place in the thing's room is on or in an object of the supporters."""
    if place.get("relation") not in SUPPORT_NAMES:
        return False
    encoded = case.rooms[case.room]
    kept = kept_objects(encoded, case.thing, structure)
    return int(encoded.instance_classes[kept[int(place["object"])]]) in supporters


def _is_place(
    case: HomeCase, place: Mapping[str, Any], supporters: set[int], structure: ClassMask
) -> bool:
    """Return whether a place is that of the thing."""
    if int(place["room"]) != case.room:
        return False
    if not supporters:
        return "relation" not in place
    return is_supporter(case, place, supporters, structure)


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
