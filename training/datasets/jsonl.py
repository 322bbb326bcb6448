"""Read and write scenes as JSON lines, plain or gzipped, the native format of this project.

docs/training.md (The scenes) describes the fields. A scene without ``scene_id`` is named after its
file and line, such as ``scenes.jsonl:3``. A line has at most `MAX_LINE` bytes.
"""

from __future__ import annotations

import gzip
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from app.scene.geometry import SMALLEST
from training.datasets.files import bounded_int, read_lines
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.sources import relations_of, supported_subjects

MAX_LINE: Final = 8 * 2**20

_NAMES = ("scene_id", "source", "group", "room_type")
_SCENE_FIELDS = {*_NAMES, "objects", "relations", "false_relations", "counts", "viewer_frame"}
_OBJECT_FIELDS = {"id", "label", "position", "size", "yaw", "supported_by", "box2d"}

# Data sources with positions in viewer axes whose files were written before the field
# ``viewer_frame`` existed.
_VIEWER_SOURCES = frozenset({"sunrgbd-bedroom-3d"})


def read_jsonl(path: Path) -> list[AnnotatedScene]:
    """Read all scenes of a ``.jsonl`` or ``.jsonl.gz`` file, or raise the first error."""
    scenes: list[AnnotatedScene] = []
    for entry in scan_jsonl(path):
        if isinstance(entry, DatasetError):
            raise entry
        scenes.append(entry)
    return scenes


def scan_jsonl(path: Path) -> Iterator[AnnotatedScene | DatasetError]:
    """Yield a scene for each valid line and an error for each invalid line. Skip blank lines."""
    line_of: dict[tuple[str, str], int] = {}
    for number, line in enumerate(read_lines(path, MAX_LINE), 1):
        if not line.strip():
            continue
        try:
            scene = _parse_scene(json.loads(line, parse_int=bounded_int), f"{path.name}:{number}")
            first = line_of.setdefault((scene.source, scene.scene_id), number)
            if first != number:
                raise ValueError(f"scene {scene.scene_id!r} is on line {first} already")
            yield scene
        except (ValueError, RecursionError) as error:
            syntax = "the line is not JSON: " if isinstance(error, json.JSONDecodeError) else ""
            yield DatasetError(path, f"line {number}", f"{syntax}{error}")


def write_jsonl(scenes: Iterable[AnnotatedScene], path: Path) -> None:
    """Write scenes in the format of `read_jsonl`. A file named ``*.gz`` is compressed by gzip."""
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "wt", encoding="utf-8") as file:
        for scene in scenes:
            file.write(json.dumps(_fields_of(scene), ensure_ascii=False) + "\n")


def _fields_of(scene: AnnotatedScene) -> dict[str, Any]:
    """Return the fields of a scene as JSON values. Fields with an unknown value are left out."""
    ids = [thing.id for thing in scene.objects]
    values = {name: getattr(scene, name) for name in _NAMES}
    values["objects"] = [
        {name: x for name, x in asdict(thing).items() if x is not None and name != "count"}
        for thing in scene.objects
    ]
    values["relations"] = None
    for name in ("relations", "false_relations"):
        if (triples := getattr(scene, name)) or (name == "relations" and triples is not None):
            values[name] = [[ids[s], r, ids[o]] for s, r, o in triples]
    if counts := {thing.label: thing.count for thing in scene.objects if thing.count > 1}:
        values["counts"] = counts
    return values | ({"viewer_frame": True} if scene.viewer_frame else {})


def _parse_scene(values: Any, default_id: str) -> AnnotatedScene:
    _check_fields("a scene", values, "objects", _SCENE_FIELDS)
    scene_id = _require_text("scene_id", values.get("scene_id", default_id))
    source = _require_text("source", values.get("source", "jsonl"))
    objects = _parse_objects(values["objects"], values.get("counts"))
    viewer_frame = values.get("viewer_frame", source in _VIEWER_SOURCES)
    if not isinstance(viewer_frame, bool):
        raise ValueError(f"viewer_frame must be true or false, not {viewer_frame!r}")
    room_type = values.get("room_type")
    stated, denied = (
        _parse_triples(name, values.get(name), objects) for name in ("relations", "false_relations")
    )
    return AnnotatedScene(
        scene_id=scene_id,
        source=source,
        group=_require_text("group", values.get("group", scene_id)),
        room_type=None if room_type is None else _require_text("room_type", room_type),
        objects=objects,
        relations=None if stated is None else relations_of(source, stated),
        viewer_frame=viewer_frame,
        false_relations=relations_of(source, denied or ()),
        supported=supported_subjects(source, stated or ()),
    )


def _parse_objects(entries: Any, counts: Any) -> tuple[AnnotatedObject, ...]:
    if not isinstance(entries, list):
        raise ValueError("objects must be a list")
    things = [{"label": entry} if isinstance(entry, str) else entry for entry in entries]
    for thing in things:
        _check_fields("an object", thing, "label", _OBJECT_FIELDS)
    nameless = Counter(_require_text("label", t["label"]) for t in things if t.get("id") is None)
    ids = {_require_id(thing["id"]) for thing in things if thing.get("id") is not None}
    objects = []
    for thing in things:
        name, number = thing.get("id"), 0
        if name is None:
            name = label = thing["label"]
            while name in ids or (not number and nameless[label] > 1):
                number += 1
                name = f"{label}_{number}"
            ids.add(name)
        objects.append(_parse_object(thing, _require_id(name)))
    count_of = _parse_counts({} if counts is None else counts, objects)
    return tuple(replace(thing, count=count_of.get(thing.label, 1)) for thing in objects)


def _parse_object(values: Mapping[str, Any], name: str) -> AnnotatedObject:
    supported_by, yaw = values.get("supported_by"), values.get("yaw", 0.0)
    if not _is_number(yaw):
        raise ValueError(f"yaw must be a number, not {yaw!r}")
    size = _parse_numbers("size", values.get("size"), 3)
    return AnnotatedObject(
        id=name,
        label=_require_text("label", values["label"]),
        position=_parse_numbers("position", values.get("position"), 3),
        # Sides that are all below 1 mm mean an unknown size, as in a request.
        size=None if size and all(abs(side) < SMALLEST for side in size) else size,
        yaw=float(yaw),
        supported_by=None if supported_by is None else _require_id(supported_by),
        box2d=_parse_numbers("box2d", values.get("box2d"), 4),
    )


def _parse_counts(counts: Any, objects: Iterable[AnnotatedObject]) -> Mapping[str, int]:
    if not isinstance(counts, Mapping):
        raise ValueError("counts must be null, or an object that maps labels to numbers")
    listed = Counter(thing.label for thing in objects)
    for label, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int):
            raise ValueError(f"the count of {label!r} must be an integer, not {count!r}")
        if listed[label] != 1:
            raise ValueError(
                f"counts contains the label {label!r}, which needs exactly one object, but the "
                f"scene has {listed[label]}"
            )
    return counts


def _parse_triples(
    name: str, values: Any, objects: tuple[AnnotatedObject, ...]
) -> list[tuple[int, str, int]] | None:
    """Return the triples (subject index, predicate, object index) of a list, or None for null."""
    if values is None:
        return None
    if not isinstance(values, list):
        raise ValueError(f"{name} must be a list or null")
    labels = Counter(thing.label for thing in objects)
    index_of = {t.label: index for index, t in enumerate(objects) if labels[t.label] == 1}
    index_of |= {thing.id: index for index, thing in enumerate(objects)}
    triples = []
    for entry in values:
        if isinstance(entry, dict) and set(entry) == {"subject", "relation", "object"}:
            entry = [entry["subject"], entry["relation"], entry["object"]]
        if not isinstance(entry, list) or len(entry) != 3:
            raise ValueError(
                "a relation is a list [subject, relation, object] or an object with these fields, "
                f"not {entry!r}"
            )
        subject, anchor = index_of.get(_require_id(entry[0])), index_of.get(_require_id(entry[2]))
        if subject is None or anchor is None:
            raise ValueError(f"relation {entry!r} names an object that is not in the scene")
        triples.append((subject, _require_text("predicate", entry[1]), anchor))
    return triples


def _check_fields(what: str, values: Any, needed: str, allowed: set[str]) -> None:
    if not isinstance(values, Mapping):
        raise ValueError(f"{what} must be a JSON object, not {type(values).__name__}")
    if needed not in values:
        raise ValueError(f"{what} lacks {needed}")
    if unknown := sorted(set(values) - allowed):
        raise ValueError(f"{what} has unknown fields: {', '.join(unknown)}")


def _require_text(name: str, value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{name} must be a non-empty string, not {value!r}")
    return value


def _require_id(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        raise ValueError(f"an id must be a string or an integer, not {value!r}")
    return str(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _parse_numbers(name: str, values: Any, length: int) -> Any:
    """Return a list of numbers, or the values of an object with the keys x, y and z, as a tuple."""
    if values is None:
        return None
    if length == 3 and isinstance(values, dict) and set(values) == {"x", "y", "z"}:
        values = [values[axis] for axis in "xyz"]
    if not isinstance(values, list) or len(values) != length or not all(map(_is_number, values)):
        raise ValueError(f"{name} must be a list of {length} numbers, not {values!r}")
    return tuple(map(float, values))
