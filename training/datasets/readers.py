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
from collections import defaultdict
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from training.datasets.files import Node, load_json
from training.datasets.jsonl import read_jsonl
from training.datasets.records import AnnotatedObject, AnnotatedScene, Box2d, DatasetError
from training.datasets.sources import relations_of, supported_subjects
from training.datasets.sunrgbd_mat import read_sunrgbd_mat


def read_3dssg(path: Path) -> list[AnnotatedScene]:
    """Read the scans, or splits of scans, in a relationships file of 3DSSG as scenes.

    All scans of a room are in one group. The official files contain no room types and no poses.
    """
    scans = load_json(path).entries("scans")
    rooms = _rooms(path.with_name("3RScan.json"))
    whole: dict[str, dict[str, str]] | None = None
    scenes: dict[str, AnnotatedScene] = {}
    for scan in scans:
        name = scan.take("scan", str)
        if "objects" in scan.value:
            labels = scan.take("objects", dict)
        else:
            whole = _labels(path.with_name("objects.json")) if whole is None else whole
            labels = whole.get(name)
        if labels is None:
            raise scan.error(f"scan {name} is not in objects.json")
        if name not in rooms:
            raise scan.error(f"scan {name} is not in 3RScan.json")
        part = f"-{scan.value['split']}" if "split" in scan.value else ""
        scene_id = f"3dssg-{name}{part}"
        if scene_id in scenes:
            raise scan.error(f"scene {scene_id} is listed twice")
        triples = _triples(scan, list(labels))
        with scan.located():
            scenes[scene_id] = AnnotatedScene(
                scene_id=scene_id,
                source="3dssg",
                group=f"3rscan-{rooms[name]}",
                room_type=None,
                objects=tuple(AnnotatedObject(key, label) for key, label in labels.items()),
                relations=relations_of("3dssg", triples),
                supported=supported_subjects("3dssg", triples),
            )
    return list(scenes.values())


def _triples(scan: Node, ids: list[str]) -> list[tuple[int, str, int]]:
    """Return the triples (subject index, predicate, object index) of a scan."""
    index_of = {key: index for index, key in enumerate(ids)}
    triples = []
    for entry in scan.entries("relationships"):
        values = entry.value
        if not isinstance(values, list) or len(values) != 4 or not isinstance(values[3], str):
            raise entry.error(f"must be [subject, object, predicate id, predicate], not {values!r}")
        subject, anchor = index_of.get(str(values[0])), index_of.get(str(values[1]))
        if subject is None or anchor is None:
            raise entry.error(f"{values!r} names an object that is not in the scan")
        triples.append((subject, values[3], anchor))
    return triples


def _labels(path: Path) -> dict[str, dict[str, str]]:
    """Read ``objects.json``. Return a mapping from scan id to object id to label."""
    labels: dict[str, dict[str, str]] = defaultdict(dict)
    for scan in load_json(path).entries("scans"):
        labels[scan.take("scan", str)] |= {
            str(thing.take("id", (str, int))): thing.take("label", str)
            for thing in scan.entries("objects")
        }
    return labels


def _rooms(path: Path) -> dict[str, str]:
    """Read ``3RScan.json``. Map each scan id to the id of the reference scan of the same room."""
    rooms: dict[str, str] = {}
    content = load_json(path)
    if not isinstance(content.value, list):
        raise content.error("the file must contain a list of reference scans")
    for number, entry in enumerate(content.value):
        room = Node(path, entry, f"[{number}]")
        reference = room.take("reference", str)
        names = (rescan.take("reference", str) for rescan in room.entries("scans"))
        rooms |= dict.fromkeys((reference, *names), reference)
    return rooms


def read_coco(path: Path) -> list[AnnotatedScene]:
    """Read the images of a COCO file as scenes. Images without objects are skipped.

    Boxes around crowds are also skipped, because they contain several objects. Boxes are in the
    image plane. Encoding later derives the relations left and above from boxes.
    """
    content = load_json(path)
    categories = {c.take("id", int): c.take("name", str) for c in content.entries("categories")}
    images: dict[int, dict[int, AnnotatedObject]]
    images = {image.take("id", int): {} for image in content.entries("images")}
    for entry in content.entries("annotations"):
        image, category = entry.take("image_id", int), entry.take("category_id", int)
        if image not in images:
            raise entry.error(f"image_id {image} is not among the images of the file")
        if category not in categories:
            raise entry.error(f"category_id {category} is not among the categories")
        if entry.value.get("iscrowd"):
            continue
        key = entry.take("id", int)
        if key in images[image]:
            raise DatasetError(path, f"image {image}", "two annotations have the same id")
        with entry.located():
            box = _box(entry)
            images[image][key] = AnnotatedObject(str(key), categories[category], box2d=box)
    return [
        AnnotatedScene(f"coco-{image}", "coco", f"coco-{image}", None, tuple(objects.values()))
        for image, objects in images.items()
        if objects
    ]


def _box(entry: Node) -> Box2d:
    bbox = entry.take("bbox", list)
    numbers = all(isinstance(v, (int, float)) and math.isfinite(v) for v in bbox)
    if len(bbox) != 4 or not numbers or min(bbox[2:]) < 0:
        raise entry.error(f"bbox must be [x, y, width, height], not {bbox!r}")
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
