"""Small files of detectors, annotation tools and simulators, which clients and service read."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Example:
    """A file, with the expected request and reasons of notes."""

    text: str
    request: dict[str, Any]
    notes: tuple[str, ...] = ()
    labels: str | None = None  # name of the label map
    scene: str | None = None  # name of the scene to read, if the file has several


HERE = Path(__file__).parent


def content(name: str) -> str:
    return (HERE / "files" / name).read_text("utf-8")


EXPECTED: dict[str, Any] = json.loads((HERE / "expected.json").read_text("utf-8"))
"""Members of the example of each file. Numbers have six decimals."""

CHAIRS = [{"image_id": 1, "category_id": 62, "score": 1 - n / 1e4} for n in range(3000)]
KEPT = [{"id": f"chair_{n + 1}", "label": "chair", "confidence": 1 - n / 1e4} for n in range(256)]

EXAMPLES = {
    **{name: Example(content(name), **members) for name, members in EXPECTED.items()},
    "thousands.json": Example(
        json.dumps(CHAIRS),
        {"objects": KEPT, "unknown_labels": "nearest-or-ignore", "relations": []},
        notes=("no-box",) * 256 + ("too-many",) * 2744,
        labels="coco91",
    ),
}

_IDS = "class ids are numbers"

REFUSED: dict[str, tuple[str, str]] = {
    "results.json": (content("coco_results.json"), _IDS),
    "yolo.txt": (content("yolo.txt"), _IDS),
    "numeric.json": (
        '{"detections": [{"results": [{"hypothesis": {"class_id": "56", "score": 0.8}}]}]}',
        _IDS,
    ),
    "numbers.json": ('["56"]', "class id instead of a label"),
    "coco.json": (content("coco_instances.json"), "2 scenes (7, 9): choose one"),
    "rooms.json": (content("hydra.json"), "2 scenes (R(0), R(1)): choose one"),
    "lines.jsonl": ('{"objects": []}\n{"objects": []}', "2 scenes (1, 2): choose one"),
    "captions.json": (
        json.dumps({"images": [], "annotations": [{"id": 1, "image_id": 1, "caption": "A bed."}]}),
        "instances_",
    ),
    "classes.json": (json.dumps([{"name": "bed", "class": 1, "confidence": 0.9}]), "classifier"),
    "truncated.json": (content("hydra.json")[:-200], "not JSON"),
    "truncated.xml": (content("cvat.xml")[:-30], "not XML"),
    "deep.json": ("[" * 5_000 + "]" * 5_000, "nesting is too deep"),
    "bomb.xml": (
        '<!DOCTYPE a [<!ENTITY b "bbbbbbbbbb">]><annotations>&b;</annotations>',
        "document type",
    ),
    "page.xml": ("<html><body/></html>", "root <html>"),
    "echo.txt": ("header:\n  stamp:\n    sec: 1\ndetections: []\n", "YAML"),
    "no_header.csv": ("desk,2.0,0.0,0.37\n", "not JSON"),
    "words.csv": ("label,x,y,z\ndesk,two,0,0\n", "line 2, column x: 'two'"),
    "unknown.json": ('{"shapes": [], "version": "5.0"}', "shapes, version"),
    "value.json": ("3", "a JSON value"),
    "empty.json": ("", "not JSON"),
    "twins.json": (json.dumps({"objects": [{"id": 1, "label": "bed"}] * 2}), "training format"),
    "no_type.json": (
        json.dumps({"objects": [{"objectType": "Bed", "position": {"x": 1}}]}),
        "looks like AI2-THOR",
    ),
    "empty.csv": ("label,x,y,z\n", "no objects"),
}
"""Files without a scene, or with several: the content and words of the error."""
