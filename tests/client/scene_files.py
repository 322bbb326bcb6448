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
    labels: Any = None  # name of the label map, or the labels by their ids
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
        {"objects": KEPT, "unknown_labels": "nearest-or-ignore"},
        notes=("no-box", "too-many"),
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
    "truncated.json": (content("hydra.json")[:-200], "not JSON"),
    "truncated.xml": (content("cvat.xml")[:-30], "not XML"),
    "deep.json": ("[" * 5_000 + "]" * 5_000, "nesting is too deep"),
    "bomb.xml": (
        '<!DOCTYPE a [<!ENTITY b "bbbbbbbbbb">]><annotations>&b;</annotations>',
        "document type",
    ),
    "page.html": ("<!doctype html><html><body/></html>", "this is a web page"),
    "other.xml": ("<kml><Document/></kml>", "root <kml>"),
    "numbers.yaml": ("0: chair\n1: table\n", "label map"),
    "aliases.yaml": ("objects: [&a bed, *a, *a]\n", "aliases"),
    "damaged.yaml": ("objects:\n- [bed\n- chair: {\n", "see line"),
    "no_header.csv": ("desk,2.0,0.0,0.37\n", "without a header"),
    "words.csv": ("label,x,y,z\ndesk,two,0,0\n", "line 2, x,y,z: 'two' is not a number"),
    "scored.txt": ("a chair 0.9\nthe small lamp\n", "no known format"),
    "sentence.txt": ("I can see a wooden desk, a chair and a big lamp.\n", "no known format"),
    "headings.md": ("## Kitchen\n- stove\n## Bath\n- sink\n", "no known format"),
    "ids.txt": ("0 chair\n1 table\n", "label map"),
    "trajectory.txt": ("1305031102.17 1.3 0.6 1.6 0.6 0.6 -0.2 -0.3\n", "no known format"),
    "deep.xml": ("<a>" * 5_000 + "</a>" * 5_000, "nesting is too deep"),
    "deep.yaml": ("a: " + "[" * 4_000 + "]" * 4_000, "nesting is too deep"),
    "comments.txt": ("# a\n" * 1000 + "?", "no known format"),
    "mesh.gltf": ('{"asset": {"version": "2.0"}, "nodes": [{"name": "Chair"}]}', "a mesh (glTF)"),
    "tracks.txt": ("1,1,40,120,260,290,0.91,-1,-1,-1\n", "MOTChallenge"),
    "unknown.json": ('{"shapes": [{"points": [[1, 2]]}], "version": "5"}', "nearest is LabelMe"),
    "other.json": ('{"rooms": {"a": 1}}', "fields rooms"),
    "value.json": ("3", "no known format"),
    "empty.json": ("", "the file is empty"),
    "relations.json": ('{"scans": [{"relationships": [[1, 2, 15, "on"]]}]}', "objects.json"),
    "devices.json": ('[{"id": "d1", "area_id": "kitchen", "name": "Fridge"}]', "Home Assistant"),
    "world.sdf": ('<?xml version="1.0"?>\n<sdf version="1.9"><world/></sdf>', "an SDF world"),
    "kitchen.usda": ('#usda 1.0\ndef Xform "World" {}\n', "this is USD"),
    "tidy.pddl": ("(define (problem tidy) (:objects cup1 - cup))", "PDDL"),
    "map.pbtxt": ('item {\n id: 1\n display_name: "chair"\n}\n', "label map"),
    "twins.json": (json.dumps({"objects": [{"id": 1, "label": "bed"}] * 2}), "training format"),
    "no_label.json": (
        json.dumps({"edges": [], "nodes": [{"id": 1, "attributes": {"type": "ObjectNode"}}]}),
        "looks like Hydra",
    ),
    "empty.csv": ("label,x,y,z\n", "no objects"),
}
"""Files without a scene, or with several: the content and words of the error."""
