"""The readers of scene files by the name of the format: JSON lines, and COCO instance annotations.

``instances*.json`` are annotations of COCO (Lin et al., ECCV 2014). A reader raises a DatasetError
if a file is missing or does not have the official format.
"""

from __future__ import annotations

from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final, TypeAlias

from pydantic import BaseModel

from training.datasets.files import read_json
from training.datasets.jsonl import read_jsonl
from training.datasets.records import (
    AnnotatedObject,
    AnnotatedScene,
    DatasetError,
    Length,
    Number,
    Text,
)


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
    name: Text


class _Instances(BaseModel):
    images: list[_Image]
    categories: list[_Category]
    annotations: list[_Annotation]


def read_coco(path: Path) -> list[AnnotatedScene]:
    """Read the images of a COCO file as scenes. Images without objects are skipped.

    Boxes around crowds are also skipped, because they contain several objects. Boxes are in the
    image plane. Encoding later derives the relations left and above from boxes.
    """
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
            label = categories[entry.category_id]
            things[entry.id] = AnnotatedObject(
                str(entry.id), label, box2d=(x, y, x + width, y + height)
            )
    return [
        AnnotatedScene(f"coco-{image}", "coco", f"coco-{image}", None, tuple(objects.values()))
        for image, objects in images.items()
        if objects
    ]


Reader: TypeAlias = Callable[[Path], list[AnnotatedScene]]

READERS: Final[dict[str, Reader]] = {
    "*.jsonl": read_jsonl,
    "*.jsonl.gz": read_jsonl,
    "instances*.json": read_coco,
}
"""The reader of each known format, by the pattern of its file names."""


def reader_of(path: Path) -> Reader:
    """Return the reader of a file, derived from the file name.

    Raises:
        DatasetError: the name matches no known format.
    """
    for pattern, reader in READERS.items():
        if fnmatchcase(path.name, pattern):
            return reader
    *patterns, last = READERS
    problem = "the file name fits no known format; rename the file to "
    raise DatasetError(path, "", f"{problem}{', '.join(patterns)} or {last}")


def read_scenes(path: Path) -> list[AnnotatedScene]:
    """Read the scenes of a file with the reader of `reader_of`, or raise its error."""
    return reader_of(path)(path)
