"""The readers of scene files by the name of the format; readers of 3DSSG, COCO and placing priors.

3DSSG scene graphs (Wald et al., CVPR 2020): the whole data set consists of ``relationships.json``
and of ``objects.json``, which contains the labels. The subset consists of
``relationships_train.json`` and ``relationships_validation.json``. The files of the subset include
the labels and divide scans into splits of at most nine objects. ``3RScan.json`` in the same folder
lists the scans of each room.

COCO instance annotations (Lin et al., ECCV 2014): ``instances*.json``.

Placing priors: tables of the usual relations between pairs of objects, without scenes.

A reader raises a DatasetError if a file is missing or does not have the official format.
"""

from __future__ import annotations

from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from app.model.fields import Many
from app.scene import RELATIONS, label_key
from training.datasets.files import read_json
from training.datasets.jsonl import read_jsonl
from training.datasets.records import (
    AnnotatedObject,
    AnnotatedScene,
    DatasetError,
    Id,
    Label,
    Length,
    Number,
)
from training.datasets.sources import relations_of, supported_subjects
from training.datasets.sunrgbd_mat import read_sunrgbd_mat
from training.datasets.tables import Errors, read_table


class _Scan(BaseModel):
    scan: str
    split: int | str | None = None
    objects: dict[str, Label] | None = None  # labels by object; None: see objects.json
    relationships: Many[tuple[Id, Id, Any, str]]  # subject, object, id and name of the predicate


class _Scans(BaseModel):
    scans: Many[_Scan]


class _Thing(BaseModel):
    id: Id
    label: Label


class _LabelledScan(BaseModel):
    scan: str
    objects: Many[_Thing]


class _LabelledScans(BaseModel):
    scans: Many[_LabelledScan]


class _Room(BaseModel):
    reference: str
    scans: list[_Room] = []  # of the same room


def read_3dssg(path: Path) -> list[AnnotatedScene]:
    """Read the scans, or splits of scans, as scenes. All scans of a room are in one group."""
    scans = read_json(path, _Scans).scans
    rooms = read_json(path.with_name("3RScan.json"), list[_Room])
    room_of = {scan.reference: room.reference for room in rooms for scan in (room, *room.scans)}
    labels_of: dict[str, dict[str, str]] = {}
    if any(scan.objects is None for scan in scans):
        for labelled in read_json(path.with_name("objects.json"), _LabelledScans).scans:
            labels = {thing.id: thing.label for thing in labelled.objects}
            labels_of.setdefault(labelled.scan, {}).update(labels)
    scenes: dict[str, AnnotatedScene] = {}
    for number, scan in enumerate(scans):
        name, labels = scan.scan, scan.objects or labels_of.get(scan.scan, {})
        scene_id = f"3dssg-{name}" if scan.split is None else f"3dssg-{name}-{scan.split}"
        index_of = {key: index for index, key in enumerate(labels)}
        problems = {
            f"scan {name} is not in 3RScan.json": name not in room_of,
            f"scan {name} is not in objects.json": scan.objects is None and name not in labels_of,
            f"scene {scene_id} is listed twice": scene_id in scenes,
            "a relationship names an object that is not in the scan": any(
                not {subject, anchor} <= labels.keys() for subject, anchor, *_ in scan.relationships
            ),
        }
        if problem := next((text for text, applies in problems.items() if applies), None):
            raise DatasetError(path, f"scans.{number}", problem)
        triples = [(index_of[i], name, index_of[j]) for i, j, _, name in scan.relationships]
        scenes[scene_id] = AnnotatedScene(
            scene_id=scene_id,
            source="3dssg",
            group=f"3rscan-{room_of[name]}",
            room_type=None,
            objects=tuple(AnnotatedObject(key, label) for key, label in labels.items()),
            relations=relations_of("3dssg", triples),
            supported=supported_subjects("3dssg", triples),
        )
    return list(scenes.values())


class _Annotation(BaseModel):
    id: int
    image_id: int
    category_id: int
    bbox: tuple[Number, Number, Length, Length]  # x, y, width, height
    iscrowd: bool = False


class _Image(BaseModel):
    id: int


class _Category(BaseModel):
    id: int
    name: Label


class _Instances(BaseModel):
    images: Many[_Image]
    categories: Many[_Category]
    annotations: Many[_Annotation]


def read_coco(path: Path) -> list[AnnotatedScene]:
    """Read the images of a COCO file as scenes, without empty images and boxes around crowds."""
    content = read_json(path, _Instances)
    categories = {category.id: category.name for category in content.categories}
    images: dict[int, dict[int, AnnotatedObject]] = {image.id: {} for image in content.images}
    for number, entry in enumerate(content.annotations):
        where = f"annotations.{number}"
        if entry.image_id not in images:
            raise DatasetError(path, where, f"image_id {entry.image_id} is not among the images")
        if entry.category_id not in categories:
            problem = f"category_id {entry.category_id} is not among the categories"
            raise DatasetError(path, where, problem)
        things = images[entry.image_id]
        if entry.id in things:
            raise DatasetError(path, where, f"two annotations of the image have the id {entry.id}")
        if not entry.iscrowd:
            x, y, width, height = entry.bbox
            label, box = categories[entry.category_id], (x, y, x + width, y + height)
            things[entry.id] = AnnotatedObject(str(entry.id), label, box2d=box)
    return [
        AnnotatedScene(f"coco-{image}", "coco", f"coco-{image}", None, tuple(objects.values()))
        for image, objects in images.items()
        if objects
    ]


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
    """Return the name of a file's format, derived from the file name."""
    for pattern, name in _PATTERNS.items():
        if fnmatchcase(path.name, pattern):
            return name
    *patterns, last = _PATTERNS
    problem = "the file name fits no known format; rename the file to "
    raise DatasetError(path, "", f"{problem}{', '.join(patterns)} or {last}")


def read_scenes(path: Path) -> list[AnnotatedScene]:
    """Read the scenes of a file in the format that `guess_format` returns, or raise its error."""
    return READERS[guess_format(path)](path)


PRIOR_COLUMNS: Final = ("source", "subject", "relation", "object", "count", "room")

PRIORS: Final = "placing_priors"
"""Source name of all scenes that the reader makes from rows of the table."""

# Sources whose rows become training scenes: the places of VirtualHome and AI2-THOR.
_TRAINED: Final = ("virtualhome_placing", "ithor_receptacles")
# Other values of the column ``source``, such as tables of votes and of part counts.
_SKIPPED: Final = ("tidybot", "conceptnet_atlocation", "housekeep_votes", "vg80k_partof_counts")


def read_prior_scenes(path: Path) -> list[AnnotatedScene]:
    """Read each row of a list of places as a scene of two objects. Rows of a pair are one group."""
    scenes, errors = [], Errors(path)
    for row in read_table(path, PRIOR_COLUMNS, errors):
        with errors.collected():
            source = row.one_of("source", (*_TRAINED, *_SKIPPED))
            relation = row.optional("relation")
            # One of the sources has prefixes, for example in "food bread" and "clothes skirt".
            names = [
                row.optional(column).removeprefix("food ").removeprefix("clothes ").strip()
                for column in ("subject", "object")
            ]
            keys = set(map(label_key, names)) - {""}
            if source in _TRAINED and relation in RELATIONS and len(keys) == 2:
                things = tuple(AnnotatedObject(str(k), name) for k, name in enumerate(names))
                group, listed = " ".join(names), ((0, relation, 1),)
                scenes.append(
                    AnnotatedScene(row.position, PRIORS, group, None, things, relations=listed)
                )
    errors.check()
    return scenes
