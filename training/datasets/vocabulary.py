"""Build vocabularies from annotated scenes and curated names."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.scene import ObjectClass, Vocabulary, label_key
from training.datasets.names import Names, curated_names
from training.datasets.records import AnnotatedScene

INDOOR_FILE = Path(__file__).resolve().parent.parent / "vocabularies" / "indoor.json"

# Minimum number of mentions of a class in the training scenes. Indoor classes also have word
# vectors, so a smaller minimum suffices for them.
MINIMUM_MENTIONS = 8
INDOOR_MINIMUM_MENTIONS = 5
# Minimum number of boxes for a typical size.
MINIMUM_BOXES = 5


def build_vocabulary(
    scenes: Iterable[AnnotatedScene],
    names: Names,
    *,
    minimum: int = MINIMUM_MENTIONS,
    minimum_rooms: int | None = None,
    outdoor: bool = False,
) -> Vocabulary:
    """Collect the frequent classes of scenes and their aliases, most frequent first.

    Labels are pooled under their curated names before counting. The base and household classes of
    ``names`` are always included. Labels of ``not_objects`` are always excluded.

    Args:
        scenes: the annotated scenes.
        names: the curated names.
        minimum: minimum number of mentions of a class.
        minimum_rooms: minimum number of scenes of a room type; by default ``minimum``.
        outdoor: include labels of ``outdoor`` and ``surroundings``.

    Raises:
        ValueError: every class has fewer mentions than the minimum.
    """
    spellings: dict[str, Counter[str]] = {}
    rooms: Counter[str] = Counter()
    for scene in scenes:
        for thing in scene.objects:
            label = names.canonical(thing.label)
            spellings.setdefault(label_key(label), Counter())[label] += 1
        if room := names.canonical_room(scene.room_type):
            rooms[room] += 1
    # Spellings with the same key are one label; the most common spelling represents it.
    mentions = Counter(
        {
            min(found, key=lambda label: (-found[label], label)): found.total()
            for found in spellings.values()
        }
    )
    refused = {label_key(name) for name in names.not_objects}
    if not outdoor:
        refused |= {label_key(name) for name in (*names.outdoor, *names.surroundings)}
    rooms_from = minimum if minimum_rooms is None else minimum_rooms
    kept = {*names.base, *names.household}
    kept |= {label for label, count in mentions.items() if count >= minimum}
    structure = {label_key(name) for name in (*names.structure, *names.surroundings)}
    return Vocabulary(
        [
            ObjectClass(
                label,
                aliases=names.aliases.get(label, ()),
                structure=label_key(label) in structure,
            )
            for label in sorted(kept, key=lambda label: (-mentions[label], label))
            if label_key(label) not in refused
        ],
        sorted(room for room, count in rooms.items() if count >= rooms_from),
    )


def write_indoor_vocabulary(
    scenes: Iterable[AnnotatedScene], path: Path = INDOOR_FILE
) -> Vocabulary:
    """Build the indoor vocabulary from the scenes of all sources; write one class per line.

    Photographs relate indoor objects to outdoor surroundings, so surroundings are ordinary classes.
    """
    names = replace(curated_names(), surroundings=())
    vocabulary = build_vocabulary(
        scenes,
        names,
        minimum=INDOOR_MINIMUM_MENTIONS,
        minimum_rooms=MINIMUM_MENTIONS,
        outdoor=True,
    )
    path.write_text(vocabulary_json(vocabulary), encoding="utf-8")
    return vocabulary


def vocabulary_json(vocabulary: Vocabulary) -> str:
    """Format a vocabulary as JSON that people can edit, one class per line.

    The file omits sizes: `with_typical_sizes` computes them from the training data.
    """
    values = vocabulary.to_dict()
    for entry in values["objects"]:
        del entry["size"]
    lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in values["objects"])
    rooms = json.dumps(values["room_types"], ensure_ascii=False)
    return f'{{\n"objects": [\n{lines}\n],\n"room_types": {rooms}\n}}\n'


def read_vocabulary(path: Path) -> Vocabulary:
    """Read a vocabulary file, written by `vocabulary_json` or by hand.

    Raises:
        OSError: the file cannot be read.
        ValueError: the content is not JSON or not a vocabulary.
    """
    return Vocabulary.from_dict(json.loads(path.read_text(encoding="utf-8")))


def indoor_vocabulary(path: Path = INDOOR_FILE) -> Vocabulary:
    """Read the committed indoor vocabulary."""
    return read_vocabulary(path)


def source_vocabulary(
    scenes: Iterable[AnnotatedScene], *, minimum: int = MINIMUM_MENTIONS
) -> Vocabulary:
    """Build a vocabulary of the mentioned classes only, without the base classes.

    The vocabulary is for models trained on one source, such as ProcTHOR or VRD. It has few classes,
    so names of narrower kinds become aliases: "dining table" becomes an alias of "table".
    """
    names = curated_names()
    mentioned_only = Names(
        structure=names.structure,
        not_objects=names.not_objects,
        surroundings=names.surroundings,
        aliases=_reachable(names),
        rooms=names.rooms,
    )
    found = build_vocabulary(scenes, mentioned_only, minimum=minimum, outdoor=True)
    objects = [_with_kinds(entry, found, names) for entry in found.objects]
    return Vocabulary(objects, found.room_types)


def _with_kinds(entry: ObjectClass, vocabulary: Vocabulary, names: Names) -> ObjectClass:
    """Add names of narrower kinds as aliases if the vocabulary does not contain them."""
    unknown = [kind for kind in names.kinds.get(entry.label, ()) if vocabulary.index(kind) is None]
    more = [name for kind in unknown for name in (kind, *names.aliases.get(kind, ()))]
    return replace(entry, aliases=(*entry.aliases, *more))


def _reachable(names: Names) -> dict[str, tuple[str, ...]]:
    """Return the aliases by class; an entry for every curated class keeps the curated spelling."""
    return dict.fromkeys((*names.base, *names.household, *names.structure), ()) | names.aliases


def with_typical_sizes(vocabulary: Vocabulary, scenes: Iterable[AnnotatedScene]) -> Vocabulary:
    """Add a typical size to each class: the median of its boxes.

    The yaw of an object is unknown if only its typical size is used, so the typical footprint is a
    square. Its side is the median of sqrt(dx * dy), which preserves the area.

    Args:
        vocabulary: the classes; a class with fewer than `MINIMUM_BOXES` boxes keeps its size.
        scenes: the scenes; objects without a size are skipped.
    """
    boxes: dict[int, list[tuple[float, float]]] = {}
    found: dict[str, int | None] = {}
    for scene in scenes:
        for thing in scene.objects:
            if thing.size is None:
                continue
            if thing.label not in found:
                found[thing.label] = vocabulary.index(thing.label)
            if (index := found[thing.label]) is not None:
                x, y, z = thing.size
                boxes.setdefault(index, []).append(((x * y) ** 0.5, z))
    return Vocabulary(
        [_sized(entry, boxes.get(index, ())) for index, entry in enumerate(vocabulary.objects)],
        vocabulary.room_types,
    )


def _sized(entry: ObjectClass, boxes: Sequence[tuple[float, float]]) -> ObjectClass:
    if len(boxes) < MINIMUM_BOXES:
        return entry
    side, height = (round(float(value), 3) for value in np.median(boxes, axis=0))
    return ObjectClass(entry.label, entry.aliases, entry.structure, (side, side, height))


def coverage(
    vocabulary: Vocabulary, scenes: Iterable[AnnotatedScene], *, structure: bool = True
) -> float:
    """Return the share of object mentions in scenes that a vocabulary covers.

    Args:
        vocabulary: the vocabulary.
        scenes: the scenes.
        structure: include mentions of structure classes.

    Raises:
        ValueError: the scenes mention no object.
    """
    known = total = 0
    mentions = Counter(thing.label for scene in scenes for thing in scene.objects)
    for label, count in mentions.items():
        index = vocabulary.index(label)
        if index is not None and not structure and vocabulary.structure[index]:
            continue
        total += count
        known += count * (index is not None)
    if not total:
        raise ValueError("the scenes mention no object")
    return known / total
