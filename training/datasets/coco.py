"""Reader for COCO instance annotations (Lin et al., ECCV 2014): ``instances*.json``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from training.datasets.files import load_json, located, take
from training.datasets.records import AnnotatedObject, AnnotatedScene, Box2d, DatasetError

SOURCE = "coco"


def read_coco(path: Path) -> list[AnnotatedScene]:
    """Read the images of a file as scenes. Images without objects are skipped.

    Boxes around crowds are also skipped, because they contain several objects. Boxes are in the
    image plane. Encoding later derives the relations left and above from boxes
    (`derive_from_boxes`).

    Raises:
        DatasetError: the file does not have the COCO format.
    """
    content = load_json(path)
    categories: dict[int, str] = {}
    for number, entry in enumerate(take(path, "", content, "categories", list)):
        where = f"categories[{number}]"
        categories[take(path, where, entry, "id", int)] = take(path, where, entry, "name", str)
    images: dict[int, list[AnnotatedObject]] = {}
    for number, entry in enumerate(take(path, "", content, "images", list)):
        images[take(path, f"images[{number}]", entry, "id", int)] = []
    for number, entry in enumerate(take(path, "", content, "annotations", list)):
        where = f"annotations[{number}]"
        image = take(path, where, entry, "image_id", int)
        category = take(path, where, entry, "category_id", int)
        if image not in images:
            raise DatasetError(path, where, f"image_id {image} is not among the images of the file")
        if category not in categories:
            raise DatasetError(path, where, f"category_id {category} is not among the categories")
        if entry.get("iscrowd"):
            continue
        key = str(take(path, where, entry, "id", int))
        with located(path, where):
            box = AnnotatedObject(key, categories[category], box2d=_box(path, where, entry))
        images[image].append(box)
    scenes = []
    for image, objects in images.items():
        name = f"{SOURCE}-{image}"
        if len({thing.id for thing in objects}) < len(objects):
            raise DatasetError(path, f"image {image}", "two annotations have the same id")
        if objects:
            scenes.append(AnnotatedScene(name, SOURCE, name, None, tuple(objects)))
    return scenes


def _box(path: Path, where: str, entry: dict[str, Any]) -> Box2d:
    bbox = take(path, where, entry, "bbox", list)
    if (
        len(bbox) != 4
        or not all(isinstance(v, (int, float)) and math.isfinite(v) for v in bbox)
        or min(bbox[2:]) < 0
    ):
        raise DatasetError(path, where, f"bbox must be [x, y, width, height], not {bbox!r}")
    x, y, width, height = map(float, bbox)
    return (x, y, x + width, y + height)
