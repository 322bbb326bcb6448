"""Reader for 3DSSG scene graphs (Wald et al., CVPR 2020) in their official format.

The whole data set consists of ``relationships.json`` and of ``objects.json``, which contains the
labels. The subset consists of ``relationships_train.json`` and ``relationships_validation.json``.
The files of the subset include the labels and divide scans into splits of at most nine objects.
``3RScan.json`` in the same folder lists the scans of each room.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from training.datasets.files import load_json, located, take
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.sources import relation_of

SOURCE = "3dssg"


def read_3dssg(path: Path) -> list[AnnotatedScene]:
    """Read the scans, or splits of scans, in a relationships file as scenes.

    All scans of a room are in one group. The official files contain no room types and no poses.

    Raises:
        DatasetError: a file is missing or does not have the official format.
    """
    scans = take(path, "", load_json(path), "scans", list)
    rooms = _rooms(path.with_name("3RScan.json"))
    labels: dict[str, dict[str, str]] | None = None
    scenes: list[AnnotatedScene] = []
    seen: set[str] = set()
    for number, scan in enumerate(scans):
        where = f"scans[{number}]"
        name = take(path, where, scan, "scan", str)
        if "objects" in scan:
            objects = take(path, where, scan, "objects", dict)
        else:
            if labels is None:
                labels = _labels(path.with_name("objects.json"))
            if name not in labels:
                raise DatasetError(path, where, f"scan {name} is not in objects.json")
            objects = labels[name]
        if name not in rooms:
            raise DatasetError(path, where, f"scan {name} is not in 3RScan.json")
        scene_id = f"3dssg-{name}-{scan['split']}" if "split" in scan else f"3dssg-{name}"
        if scene_id in seen:
            raise DatasetError(path, where, f"scene {scene_id} is listed twice")
        seen.add(scene_id)
        with located(path, where):
            scenes.append(
                AnnotatedScene(
                    scene_id=scene_id,
                    source=SOURCE,
                    group=f"3rscan-{rooms[name]}",
                    room_type=None,
                    objects=tuple(AnnotatedObject(key, label) for key, label in objects.items()),
                    relations=_relations(path, where, scan, list(objects)),
                )
            )
    return scenes


def _relations(
    path: Path, where: str, scan: dict[str, Any], ids: list[str]
) -> tuple[tuple[int, str, int], ...]:
    place = {key: position for position, key in enumerate(ids)}
    found: dict[tuple[int, str, int], None] = {}
    for number, entry in enumerate(take(path, where, scan, "relationships", list)):
        here = f"{where}.relationships[{number}]"
        if not isinstance(entry, list) or len(entry) != 4 or not isinstance(entry[3], str):
            raise DatasetError(
                path, here, f"must be [subject, object, predicate id, predicate], not {entry!r}"
            )
        subject, anchor = place.get(str(entry[0])), place.get(str(entry[1]))
        if subject is None or anchor is None:
            raise DatasetError(path, here, f"{entry!r} names an object that is not in the scan")
        relation = relation_of(SOURCE, entry[3])
        if relation is not None and subject != anchor:
            found[subject, relation, anchor] = None
    return tuple(found)


def _labels(path: Path) -> dict[str, dict[str, str]]:
    """Read ``objects.json``. Return a mapping from scan id to object id to label."""
    labels: dict[str, dict[str, str]] = {}
    for number, scan in enumerate(take(path, "", load_json(path), "scans", list)):
        where = f"scans[{number}]"
        found = labels.setdefault(take(path, where, scan, "scan", str), {})
        for position, thing in enumerate(take(path, where, scan, "objects", list)):
            here = f"{where}.objects[{position}]"
            key = str(take(path, here, thing, "id", (str, int)))
            found[key] = take(path, here, thing, "label", str)
    return labels


def _rooms(path: Path) -> dict[str, str]:
    """Read ``3RScan.json``. Map each scan id to the id of the reference scan of the same room."""
    rooms: dict[str, str] = {}
    entries = load_json(path)
    if not isinstance(entries, list):
        raise DatasetError(path, "", "the file must contain a list of reference scans")
    for number, entry in enumerate(entries):
        where = f"[{number}]"
        reference = take(path, where, entry, "reference", str)
        rooms[reference] = reference
        for position, rescan in enumerate(take(path, where, entry, "scans", list)):
            rooms[take(path, f"{where}.scans[{position}]", rescan, "reference", str)] = reference
    return rooms
