"""Read and write scenes as JSON lines, plain or gzipped, the native format of this project.

docs/training.md (The scenes) describes the fields. A scene without ``scene_id`` is named after its
file and line, such as ``scenes.jsonl:3``. A line has at most `MAX_LINE` bytes.
"""

from __future__ import annotations

import codecs
import gzip
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    FailFast,
    Field,
    StrictBool,
    StrictInt,
    ValidationError,
)

from app.scene.scene import SMALLEST
from scene_client.frames import BoxOrigin, Conventions, Extents, QuaternionOrder, Units, Up
from scene_client.schemas import MAX_RELATIONS, Stamp
from training.datasets.files import position_and_problem, read_lines
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError, Id, Label, Text
from training.datasets.sources import relations_of, supported_subjects

MAX_LINE: Final = 8 * 2**20
MAX_SCENES: Final = 250_000  # of a file; each takes about 2 kB of memory
MAX_OBJECTS: Final = 4096  # of a scene

_NAMES = ("scene_id", "source", "group", "room_type")

# Sources in viewer axes whose files are older than the field ``viewer_frame``.
_VIEWER_SOURCES = frozenset({"sunrgbd-bedroom-3d"})


def _of_label(entry: Any) -> Any:
    return {"label": entry} if isinstance(entry, str) else entry


def _of_fields(entry: Any) -> Any:
    fields = ("subject", "relation", "object")
    is_request = isinstance(entry, dict) and set(entry) == set(fields)
    return [entry[name] for name in fields] if is_request else entry


class _Objects(BaseModel):
    objects: Annotated[list[AnnotatedObject], FailFast()]


_Triple = Annotated[tuple[Id, Text, Id], BeforeValidator(_of_fields)]


_Triples = Annotated[list[_Triple], Field(max_length=MAX_RELATIONS)]


class _Line(BaseModel):
    model_config = ConfigDict(extra="forbid")

    objects: Annotated[
        list[Annotated[dict[str, Any], BeforeValidator(_of_label)]],
        Field(max_length=MAX_OBJECTS),
        FailFast(),
    ]
    scene_id: Text | None = None
    source: Text = "jsonl"
    group: Text | None = None
    room_type: Label | None = None
    relations: _Triples | None = None
    false_relations: _Triples | None = None
    counts: Annotated[dict[str, StrictInt], Field(max_length=MAX_OBJECTS)] | None = None
    viewer_frame: StrictBool | None = None
    up: Up | None = None
    units: Units = "m"
    extents: Extents = "full"
    box_origin: BoxOrigin = "centre"
    quaternion_order: QuaternionOrder = "xyzw"  # scenes have no quaternions
    stamp: Stamp | None = None  # checked, but not used
    confirmed: StrictBool = False


def read_jsonl(path: Path) -> list[AnnotatedScene]:
    """Read all scenes of a ``.jsonl`` or ``.jsonl.gz`` file, or raise the first error."""
    scenes: list[AnnotatedScene] = []
    for entry in scan_jsonl(path):
        if isinstance(entry, DatasetError):
            raise entry
        scenes.append(entry)
    return scenes


def scan_jsonl(path: Path) -> Iterator[AnnotatedScene | DatasetError]:
    """Yield a scene for each valid line and an error for each invalid line. Skip blank lines.

    Raises:
        DatasetError: the file cannot be read, or has more than `MAX_SCENES` lines with scenes.
    """
    line_of: dict[tuple[str, str], int] = {}
    count = 0
    for number, line in enumerate(read_lines(path, MAX_LINE), 1):
        if not line.strip():
            continue
        if (count := count + 1) > MAX_SCENES:
            raise DatasetError(path, "", f"has more than {MAX_SCENES} scenes")
        try:
            scene = _parse_scene(line, f"{path.name}:{number}")
            first = line_of.setdefault((scene.source, scene.scene_id), number)
            if first != number:
                raise ValueError(f"scene {scene.scene_id!r} is on line {first} already")
            yield scene
        except ValidationError as error:
            position, problem = position_and_problem(error)
            text = f"{position}: {problem}" if position else problem
            yield DatasetError(path, f"line {number}", text)
        except ValueError as error:
            yield DatasetError(path, f"line {number}", str(error))


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
    flags = ("viewer_frame", "confirmed")
    return values | {name: True for name in flags if getattr(scene, name)}


def _parse_scene(line: bytes, default_id: str) -> AnnotatedScene:
    """Return the scene of a line. One without `scene_id` gets the default."""
    values = _Line.model_validate_json(line.removeprefix(codecs.BOM_UTF8))
    scene_id, source = values.scene_id or default_id, values.source
    conventions = Conventions.of(values)
    objects = _objects(values.objects, values.counts or {}, conventions)
    stated, denied = (
        _indices(x or (), objects) for x in (values.relations, values.false_relations)
    )
    frame = values.viewer_frame
    return AnnotatedScene(
        scene_id=scene_id,
        source=source,
        group=values.group or scene_id,
        room_type=values.room_type,
        objects=objects,
        relations=None if values.relations is None else relations_of(source, stated),
        viewer_frame=source in _VIEWER_SOURCES if frame is None else frame,
        false_relations=relations_of(source, denied),
        supported=supported_subjects(source, stated),
        confirmed=values.confirmed,
        conventions=conventions,
    )


# Errors of boxes, which a recorded request may state. Training takes its boxes as exact.
_UNUSED: Final = frozenset({"position_std", "size_std"})


def _objects(
    entries: Sequence[dict[str, Any]], counts: Mapping[str, int], conventions: Conventions
) -> tuple[AnnotatedObject, ...]:
    """Return the objects, in metres and with z up.

    One without id is called by its label, with a number if needed.
    """
    labels = Counter(str(entry.get("label")) for entry in entries)
    nameless = Counter(str(entry.get("label")) for entry in entries if entry.get("id") is None)
    ids = {str(entry["id"]) for entry in entries if entry.get("id") is not None}
    last: Counter[str] = Counter()  # number of the last object of each label
    complete = []
    for entry in entries:
        name, label = entry.get("id"), str(entry.get("label"))
        if name is None:
            name, is_taken = label, label in ids or nameless[label] > 1
            while is_taken:
                last[label] += 1
                name = f"{label}_{last[label]}"
                is_taken = name in ids
            ids.add(name)
        count = {"count": counts[label]} if label in counts else {}
        known = {key: value for key, value in entry.items() if key not in _UNUSED}
        complete.append(known | {"id": name} | count)
    for label in counts:
        if labels[label] != 1:
            raise ValueError(
                f"counts contains the label {label!r}, which needs exactly one object, but the "
                f"scene has {labels[label]}"
            )
    things = _Objects.model_validate({"objects": complete}).objects
    return tuple(_in_metres(thing, conventions) for thing in things)


def _in_metres(thing: AnnotatedObject, conventions: Conventions) -> AnnotatedObject:
    """Return an object in metres and with z up. Its y axis may have pointed up before."""
    if conventions != Conventions():
        position, size, yaw = conventions.box(thing.position, thing.size, yaw=thing.yaw)
        thing = replace(thing, position=position, size=size, yaw=yaw)
    # Sides that are all below 1 mm mean an unknown size, as in a request.
    if thing.size and max(thing.size) < SMALLEST:
        thing = replace(thing, size=None)
    return thing


def _indices(
    triples: Iterable[tuple[str, str, str]], objects: Sequence[AnnotatedObject]
) -> list[tuple[int, str, int]]:
    """Return triples of the indices of two objects, which are named by id or unambiguous label."""
    labels = Counter(thing.label for thing in objects)
    index_of = {t.label: index for index, t in enumerate(objects) if labels[t.label] == 1}
    index_of |= {thing.id: index for index, thing in enumerate(objects)}
    for subject, name, anchor in triples:
        if not {subject, anchor} <= index_of.keys():
            triple = [subject, name, anchor]
            raise ValueError(f"relation {triple!r} names an object that is not in the scene")
    return [(index_of[i], name, index_of[j]) for i, name, j in triples]
