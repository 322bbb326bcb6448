"""Example scenes for the visual page: choose them from a user's scenes, and read them from a file.

`publish` stores the examples in the artifact. So they must come from the user's own scenes or be
written by hand: a copy of a research-only scene would put its terms on the artifact.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from app.errors import RequestError
from app.questions.reading import Limits, read_scene
from app.registry.description import Example, Examples
from app.scene import Vocabulary, canonicalise
from scene_client.schemas.requests import MAX_LABEL
from training.datasets import AnnotatedScene, DatasetError
from training.datasets.encoding import room_viewpoint
from training.datasets.records import AnnotatedObject
from training.datasets.sources import source_of
from training.datasets.vocabulary import curated_names
from training.fit.configuration import ConfigError, first_error

_SHIPPED: Final = Path(__file__).parent / "examples"
_READER: Final[TypeAdapter[tuple[Example, ...]]] = TypeAdapter(Examples)
_CHOSEN: Final = 3
# The page shows one object beside the other, so more objects would hide each other.
_MOST_OBJECTS: Final = 12
_MOST_RELATIONS: Final = 32
_FEWEST_CLASSES: Final = 3


def read_examples(reference: str, root: Path) -> tuple[Example, ...]:
    """Read the examples that a configuration names: a shipped file, or a .json file in `root`."""
    if not reference:
        return ()
    path = root / reference
    if not reference.endswith(".json"):
        path = _SHIPPED / f"{reference}.json"
    try:
        return _READER.validate_json(path.read_bytes())
    except ValidationError as error:
        raise ConfigError(f"{path}, {first_error(error)}") from error
    except OSError as error:
        raise ConfigError(
            f"{DatasetError.unreadable(path, error)}. Remove the entry `examples` of the "
            "configuration, or provide the file"
        ) from error


def accepted_examples(
    examples: Sequence[Example], vocabulary: Vocabulary
) -> tuple[tuple[Example, ...], list[str]]:
    """Return the examples that a model of this vocabulary accepts, and reasons against others."""
    accepted, reasons = [], []
    for example in examples:
        try:
            read_scene(example.scene, vocabulary, Limits())
            accepted.append(example)
        except RequestError as error:
            error.locate(example.request())
            first = error.errors[0]
            reasons.append(f"{example.name}: {first.pointer}: {first.message}")
    return tuple(accepted), reasons


def examples_json(examples: Sequence[Example]) -> str:
    """Return examples as JSON text that people can edit, with one object or relation on a line."""
    as_json = partial(json.dumps, ensure_ascii=False)

    def field(name: str, value: Any) -> str:
        rows = ",\n".join(f"  {as_json(row)}" for row in value) if isinstance(value, list) else ""
        return f' "{name}": ' + (f"[\n{rows}]" if rows else as_json(value))

    entries = [
        f'{{"name": {as_json(example.name)}, "scene": {{\n'
        + ",\n".join(field(*entry) for entry in example.request().items())
        + "}}"
        for example in examples
    ]
    return "[\n" + ",\n".join(entries) + "\n]\n"


def choose_examples(
    scenes: Sequence[AnnotatedScene], vocabulary: Vocabulary
) -> tuple[Example, ...]:
    """Return up to three typical scenes, if possible of different room types."""
    own = [scene for scene in scenes if not source_of(scene.source).research_only]
    objects_of = {scene: _usable(scene, vocabulary) for scene in own}
    classes = {scene: {index for index, _ in pairs} for scene, pairs in objects_of.items()}
    frequency = Counter(index for indices in classes.values() for index in indices)
    candidates = [scene for scene in own if len(classes[scene]) >= _FEWEST_CLASSES]
    sizes: defaultdict[str | None, list[int]] = defaultdict(list)
    for scene in candidates:
        sizes[scene.room_type].append(len(classes[scene]))

    def rank(scene: AnnotatedScene) -> tuple[bool, float, int]:
        # Scenes with more classes than the median leave few objects for `/missing` to propose.
        distance = abs(len(classes[scene]) - np.median(sizes[scene.room_type]))
        bare = not any(thing.position for _, thing in objects_of[scene])
        return bare, float(distance), -sum(frequency[index] for index in classes[scene])

    ranked = sorted(candidates, key=rank)
    # The first scene of each room type, and then the others.
    first = {scene.room_type: scene for scene in reversed(ranked)}
    ranked.sort(key=lambda scene: first[scene.room_type] is not scene)
    chosen = {scene.group: scene for scene in reversed(ranked)}
    typical = [scene for scene in ranked if chosen[scene.group] is scene][:_CHOSEN]
    return tuple(_make_example(x, objects_of[x], vocabulary, frequency) for x in typical)


def _usable(scene: AnnotatedScene, vocabulary: Vocabulary) -> list[tuple[int, AnnotatedObject]]:
    """Return the objects of a scene that a request can contain, with their class indices."""
    indices = [vocabulary.index(thing.label) for thing in scene.objects]
    return [
        (index, thing)
        for index, thing in zip(indices, scene.objects, strict=True)
        if index is not None and not vocabulary.structure[index]
        if len(vocabulary.labels[index]) <= MAX_LABEL
    ]


def _make_example(
    scene: AnnotatedScene,
    usable: Sequence[tuple[int, AnnotatedObject]],
    vocabulary: Vocabulary,
    frequency: Counter[int],
) -> Example:
    """Build a request from a scene, with the first object of each of the most frequent classes."""
    first = dict(reversed(usable))  # the first object of each class
    classes = sorted(first, key=lambda index: -frequency[index])[:_MOST_OBJECTS]
    kept = [(index, thing) for index, thing in usable if index in classes and first[index] is thing]
    names = {thing.id: vocabulary.labels[index] for index, thing in kept}
    values: dict[str, Any] = {}
    room = curated_names().room_index(scene.room_type, vocabulary)
    if room is not None:
        values["room_type"] = vocabulary.room_types[room]
    if any(thing.position for _, thing in kept):
        values |= {"frame_id": "map", "viewpoint": _viewpoint(scene)}
    elif relations := _relations(scene, names):
        values["relations"] = relations
    values["objects"] = [{"label": names[thing.id]} | _pose(thing) for _, thing in kept]
    scene_id = "".join(filter(str.isprintable, scene.scene_id))
    title = f"{values.get('room_type', 'scene').capitalize()}, {scene_id}"
    return Example.model_validate({"name": title[:MAX_LABEL], "scene": values})


def _viewpoint(scene: AnnotatedScene) -> dict[str, float]:
    """Return the viewpoint from which training derives the relations of a scene."""
    if scene.viewer_frame:
        return {"x": 0.0, "y": 0.0, "yaw": 0.0}
    positions = [thing.position or (math.nan,) * 3 for thing in scene.objects]
    view = room_viewpoint(scene.scene_id, np.array(positions))
    return {"x": round(view.x, 3), "y": round(view.y, 3), "yaw": round(view.yaw, 4)}


def _pose(thing: AnnotatedObject) -> dict[str, Any]:
    """Return position, size and orientation of an object as members of a request."""
    pose: dict[str, Any] = {}
    for name, values in (("position", thing.position), ("size", thing.size)):
        if values is not None:
            pose[name] = {axis: round(value, 3) for axis, value in zip("xyz", values, strict=True)}
    if thing.position is not None and thing.yaw:
        half = thing.yaw / 2
        turn = {"z": round(math.sin(half), 4), "w": round(math.cos(half), 4)}
        pose["orientation"] = {"x": 0.0, "y": 0.0} | turn
    return pose


def _relations(scene: AnnotatedScene, names: dict[str, str]) -> list[dict[str, str]]:
    """Return the annotated relations between named objects, without contradictions."""
    index_of = {thing.id: index for index, thing in enumerate(scene.objects)}
    triples = scene.relations
    if triples is None:
        triples = tuple(
            (index_of[thing.id], "on-top", index_of[thing.supported_by])
            for thing in scene.objects
            if thing.supported_by is not None
        )
    canonical = {canonicalise(*triple) for triple in triples}
    relations = []
    for triple in triples:
        relation, i, j = canonicalise(*triple)
        subject, other = (names.get(scene.objects[end].id) for end in (triple[0], triple[2]))
        if i != j and (relation, j, i) not in canonical and subject and other:
            relations.append({"subject": subject, "relation": triple[1], "object": other})
    return relations[:_MOST_RELATIONS]
