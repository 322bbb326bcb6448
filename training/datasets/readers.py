"""The readers of scene files, by the name of the file format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from training.datasets.coco import read_coco
from training.datasets.jsonl import read_jsonl
from training.datasets.records import AnnotatedScene, DatasetError
from training.datasets.sunrgbd_mat import read_sunrgbd_mat
from training.datasets.threedssg import read_3dssg

READERS: Final[dict[str, Callable[[Path], list[AnnotatedScene]]]] = {
    "jsonl": read_jsonl,
    "3dssg": read_3dssg,
    "sunrgbd-mat": read_sunrgbd_mat,
    "coco": read_coco,
}


def guess_format(path: Path) -> str:
    """Return the name of a file's format, derived from the file name.

    Raises:
        DatasetError: the name matches no known format.
    """
    name = path.name
    if name.endswith((".jsonl", ".jsonl.gz")):
        return "jsonl"
    if name.endswith(".mat"):
        return "sunrgbd-mat"
    if name.startswith("relationships") and name.endswith(".json"):
        return "3dssg"
    if name.startswith("instances") and name.endswith(".json"):
        return "coco"
    raise DatasetError(
        path,
        "",
        "the file name fits no known format; rename the file to *.jsonl, *.jsonl.gz, *.mat, "
        "relationships*.json or instances*.json",
    )


def read_scenes(path: Path) -> list[AnnotatedScene]:
    """Read the scenes of a file. The file name determines the format.

    Raises:
        DatasetError: the name matches no known format, or the file is invalid.
    """
    return READERS[guess_format(path)](path)
