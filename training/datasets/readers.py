"""The readers of scene files by the name of the format, and the readers of 3DSSG and COCO.

3DSSG scene graphs (Wald et al., CVPR 2020): the whole data set consists of ``relationships.json``
and of ``objects.json``, which contains the labels. The subset consists of
``relationships_train.json`` and ``relationships_validation.json``. The files of the subset include
the labels and divide scans into splits of at most nine objects. ``3RScan.json`` in the same folder
lists the scans of each room.

COCO instance annotations (Lin et al., ECCV 2014): ``instances*.json``.

A reader raises a DatasetError if a file is missing or does not have the official format.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

from training.datasets.files import load_json, located, take
from training.datasets.jsonl import read_jsonl
from training.datasets.records import AnnotatedObject, AnnotatedScene, Box2d, DatasetError
from training.datasets.sources import relations_of, supported_subjects
from training.datasets.sunrgbd_mat import read_sunrgbd_mat


def read_3dssg(path: Path) -> list[AnnotatedScene]:
    """Read the scans, or splits of scans, in a relationships file of 3DSSG as scenes.

    All scans of a room are in one group. The official files contain no room types and no poses.
    """
    scans = _entries(path, "", load_json(path), "scans")
    rooms = _rooms(path.with_name("3RScan.json"))
    labels: dict[str, dict[str, str]] | None = None
    scenes: dict[str, AnnotatedScene] = {}
    for where, scan in scans:
        name = take(path, where, scan, "scan", str)
        if "objects" in scan:
            objects = take(path, where, scan, "objects", dict)
        else:
            if labels is None:
                labels = _labels(path.with_name("objects.json"))
            objects = labels.get(name)
        if objects is None:
            raise DatasetError(path, where, f"scan {name} is not in objects.json")
        if name not in rooms:
            raise DatasetError(path, where, f"scan {name} is not in 3RScan.json")
        scene_id = f"3dssg-{name}-{scan['split']}" if "split" in scan else f"3dssg-{name}"
        if scene_id in scenes:
            raise DatasetError(path, where, f"scene {scene_id} is listed twice")
        triples = _triples(path, where, scan, list(objects))
        with located(path, where):
            scenes[scene_id] = AnnotatedScene(
                scene_id=scene_id,
                source="3dssg",
                group=f"3rscan-{rooms[name]}",
                room_type=None,
                objects=tuple(AnnotatedObject(key, label) for key, label in objects.items()),
                relations=relations_of("3dssg", triples),
                supported=supported_subjects("3dssg", triples),
            )
    return list(scenes.values())


def _entries(path: Path, where: str, values: Any, name: str) -> list[tuple[str, Any]]:
    """Return position and value of each entry of the list ``name``."""
    entries = take(path, where, values, name, list)
    start = f"{where}.{name}" if where else name
    return [(f"{start}[{number}]", entry) for number, entry in enumerate(entries)]


def _triples(
    path: Path, where: str, scan: dict[str, Any], ids: list[str]
) -> list[tuple[int, str, int]]:
    """Return the triples (subject index, predicate, object index) of a scan."""
    index_of = {key: index for index, key in enumerate(ids)}
    triples = []
    for place, entry in _entries(path, where, scan, "relationships"):
        if not isinstance(entry, list) or len(entry) != 4 or not isinstance(entry[3], str):
            raise DatasetError(
                path, place, f"must be [subject, object, predicate id, predicate], not {entry!r}"
            )
        subject, anchor = index_of.get(str(entry[0])), index_of.get(str(entry[1]))
        if subject is None or anchor is None:
            raise DatasetError(path, place, f"{entry!r} names an object that is not in the scan")
        triples.append((subject, entry[3], anchor))
    return triples


def _labels(path: Path) -> dict[str, dict[str, str]]:
    """Read ``objects.json``. Return a mapping from scan id to object id to label."""
    labels: dict[str, dict[str, str]] = {}
    for where, scan in _entries(path, "", load_json(path), "scans"):
        scan_labels = labels.setdefault(take(path, where, scan, "scan", str), {})
        for place, thing in _entries(path, where, scan, "objects"):
            key = str(take(path, place, thing, "id", (str, int)))
            scan_labels[key] = take(path, place, thing, "label", str)
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
        for place, rescan in _entries(path, where, entry, "scans"):
            rooms[take(path, place, rescan, "reference", str)] = reference
    return rooms


def read_coco(path: Path) -> list[AnnotatedScene]:
    """Read the images of a COCO file as scenes. Images without objects are skipped.

    Boxes around crowds are also skipped, because they contain several objects. Boxes are in the
    image plane. Encoding later derives the relations left and above from boxes.
    """
    content = load_json(path)
    categories: dict[int, str] = {
        take(path, where, entry, "id", int): take(path, where, entry, "name", str)
        for where, entry in _entries(path, "", content, "categories")
    }
    images: dict[int, dict[int, AnnotatedObject]] = {
        take(path, where, entry, "id", int): {}
        for where, entry in _entries(path, "", content, "images")
    }
    for where, entry in _entries(path, "", content, "annotations"):
        image = take(path, where, entry, "image_id", int)
        category = take(path, where, entry, "category_id", int)
        if image not in images:
            raise DatasetError(path, where, f"image_id {image} is not among the images of the file")
        if category not in categories:
            raise DatasetError(path, where, f"category_id {category} is not among the categories")
        if entry.get("iscrowd"):
            continue
        key = take(path, where, entry, "id", int)
        if key in images[image]:
            raise DatasetError(path, f"image {image}", "two annotations have the same id")
        with located(path, where):
            box = _box(path, where, entry)
            images[image][key] = AnnotatedObject(str(key), categories[category], box2d=box)
    return [
        AnnotatedScene(f"coco-{image}", "coco", f"coco-{image}", None, tuple(objects.values()))
        for image, objects in images.items()
        if objects
    ]


def _box(path: Path, where: str, entry: dict[str, Any]) -> Box2d:
    bbox = take(path, where, entry, "bbox", list)
    numbers = all(isinstance(v, (int, float)) and math.isfinite(v) for v in bbox)
    if len(bbox) != 4 or not numbers or min(bbox[2:]) < 0:
        raise DatasetError(path, where, f"bbox must be [x, y, width, height], not {bbox!r}")
    x, y, width, height = map(float, bbox)
    return (x, y, x + width, y + height)


READERS: Final[dict[str, Callable[[Path], list[AnnotatedScene]]]] = {
    "jsonl": read_jsonl,
    "3dssg": read_3dssg,
    "sunrgbd-mat": read_sunrgbd_mat,
    "coco": read_coco,
}


_PATTERNS: Final = {
    "*.jsonl": "jsonl",
    "*.jsonl.gz": "jsonl",
    "*.mat": "sunrgbd-mat",
    "relationships*.json": "3dssg",
    "instances*.json": "coco",
}


def guess_format(path: Path) -> str:
    """Return the name of a file's format, derived from the file name.

    Raises:
        DatasetError: the name matches no known format.
    """
    for pattern, name in _PATTERNS.items():
        if fnmatchcase(path.name, pattern):
            return name
    *patterns, last = _PATTERNS
    problem = "the file name fits no known format; rename the file to "
    raise DatasetError(path, "", f"{problem}{', '.join(patterns)} or {last}")


def read_scenes(path: Path) -> list[AnnotatedScene]:
    """Read the scenes of a file in the format that `guess_format` returns, or raise its error."""
    return READERS[guess_format(path)](path)
