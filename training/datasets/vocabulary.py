"""Curated names of object classes and room types, and vocabularies of annotated scenes.

Some labels name no kind of object: placeholders of annotators, ids of detectors and catalogues. A
class of such a label (REMOVE, object_7, n03001627, /m/01mzpv) would teach only how often a tool
failed, so scenes and inventories are read without it. A sense of WordNet names a kind: sofa.n.01.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import ValidationError

from app.model.fields import first_error
from app.registry import VocabularyEntry
from app.scene import ObjectClass, Vocabulary, head_of, label_key
from app.scene.labels import names_nothing, without_instance
from training.datasets.records import AnnotatedScene

NAMES_FILE = Path(__file__).resolve().parent / "vocabularies" / "names.toml"


@dataclass(frozen=True)
class Names:
    """The content of `vocabularies/names.toml`."""

    base: tuple[str, ...] = ()  # common classes, in every indoor vocabulary
    household: tuple[str, ...] = ()  # rare household objects, in every indoor vocabulary
    structure: tuple[str, ...] = ()  # classes such as walls, which the service never proposes
    not_objects: tuple[str, ...] = ()  # labels that never become a class
    surroundings: tuple[str, ...] = ()  # outdoor structures such as buildings
    anywhere: tuple[str, ...] = ()  # classes that belong in every room, such as pets and bags
    placeholders: tuple[str, ...] = ()  # words of labels that name no kind of object
    numbered: tuple[str, ...] = ()  # words that are placeholders if a number follows
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)  # other names of each class
    # More specific names of each class: classes with this parent, otherwise aliases.
    kinds: dict[str, tuple[str, ...]] = field(default_factory=dict)
    # Other names of each room type. The key "" lists names without a room type.
    rooms: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def telling_apart(self, labels: Iterable[str]) -> Self:
        """Return names in which the labels of a person are different classes.

        Of several labels of one class, its name or else the first label keeps the other names. A
        label that ends with the name is a kind of the class: coffee cup of cup.
        """
        labels_of: defaultdict[str, dict[str, str]] = defaultdict(dict)
        for label in labels:
            labels_of[self.canonical(label)].setdefault(label_key(label), _plain(label))
        aliases, kinds = dict(self.aliases), dict(self.kinds)
        for name, own in labels_of.items():
            own.pop(label_key(name) if label_key(name) in own else next(iter(own)))
            of_class = {label_key(x): x for x in aliases.get(name, ())}
            told_apart = [label for key, label in own.items() if of_class.pop(key, None)]
            aliases[name] = tuple(of_class.values())
            kinds[name] = (*kinds.get(name, ()), *(x for x in told_apart if is_kind(x, name)))
        return replace(self, aliases=aliases, kinds=kinds)

    def is_curated(self, label: str) -> bool:
        """Return True if a label is a curated name of a class in any spelling."""
        return label_key(label) in self._by_key

    def canonical(self, label: str) -> str:
        """Return the curated name of a label, or the label in lower case with single spaces."""
        if (name := self._by_key.get(label_key(label))) is not None:
            return name
        if (head := head_of(label)) is not None:
            return self.canonical(head)
        return _plain(label)

    def canonical_room(self, room: str | None) -> str | None:
        """Return the canonical spelling of a room type, or None if the name means no room type."""
        if room is None:
            return None
        return self._rooms_by_key.get(label_key(room), _plain(room)) or None

    def room_index(self, room: str | None, vocabulary: Vocabulary) -> int | None:
        """Return the index of a room type, or None. Names of the vocabulary come first."""
        names = (room, self.canonical_room(room))
        indices = (vocabulary.room_index(name) for name in names if name is not None)
        return next((index for index in indices if index is not None), None)

    @cached_property
    def broader(self) -> dict[str, str]:
        """The broader class of each kind."""
        return {kind: name for name, kinds in self.kinds.items() for kind in kinds}

    @cached_property
    def _by_key(self) -> dict[str, str]:
        names = (*self.base, *self.household, *self.structure, *self.surroundings)
        return {label_key(name): name for name in names} | _by_any_name(self.aliases)

    @cached_property
    def _rooms_by_key(self) -> dict[str, str]:
        return _by_any_name(self.rooms)


def is_kind(label: str, name: str) -> bool:
    """Return True if a label is a name after further words: visitor chair for chair."""
    words, last = _plain(label).split(), len(name.split())
    return len(words) > last and label_key(" ".join(words[-last:])) == label_key(name)


def _plain(name: str) -> str:
    return " ".join(name.casefold().replace("_", " ").split())


def _by_any_name(table: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """Map the key of each name in a table to the name whose entry contains it.

    The entry "" has names that say nothing, such as "unknown"; they map to "".
    """
    return {
        label_key(other): name
        for name, others in table.items()
        for other in (name, *others)
        if other
    }


@cache
def curated_names() -> Names:
    """Read the curated names of `vocabularies/names.toml`."""

    def frozen(entry: Any) -> Any:
        table = isinstance(entry, dict)
        return {key: tuple(x) for key, x in entry.items()} if table else tuple(entry)

    values = tomllib.loads(NAMES_FILE.read_text(encoding="utf-8"))
    return Names(**{name: frozen(entry) for name, entry in values.items()})


INDOOR_FILE = Path(__file__).resolve().parent / "vocabularies" / "indoor.json"

# Minimum number of objects of a class in the scenes, and of scenes of a room type.
MINIMUM_MENTIONS = 8
MINIMUM_BOXES = 5  # from which a typical size is computed


def build_vocabulary(
    scenes: Iterable[AnnotatedScene], names: Names, *, minimum: int = MINIMUM_MENTIONS
) -> Vocabulary:
    """Collect the base classes of `names` and the frequent ones, most frequent class first.

    Raises:
        ValueError: every class has fewer objects than the minimum.
    """
    spellings: dict[str, Counter[str]] = {}
    rooms: Counter[str] = Counter()
    for scene in scenes:
        for thing in scene.objects:
            label = names.canonical(thing.label)
            spellings.setdefault(label_key(label), Counter())[label] += 1
        if room := names.canonical_room(scene.room_type):
            rooms[room] += 1
    # Spellings with the same key count as one label, under the most common spelling.
    mentions = Counter({most_frequent(x): x.total() for x in spellings.values()})
    excluded = set(map(label_key, names.not_objects))
    structure = set(map(label_key, (*names.structure, *names.surroundings)))
    frequent = {label for label, count in mentions.items() if count >= minimum}
    classes = [
        ObjectClass(label, names.aliases.get(label, ()), structure=label_key(label) in structure)
        for label in sorted(
            frequent.union(names.base, names.household), key=lambda x: (-mentions[x], x)
        )
        if label_key(label) not in excluded
    ]
    return Vocabulary(classes, sorted(room for room, count in rooms.items() if count >= minimum))


def most_frequent(counts: Counter[str]) -> str:
    """Return the most frequent name; of several, the alphabetically first."""
    return min(counts, key=lambda name: (-counts[name], name))


def vocabulary_json(vocabulary: Vocabulary) -> str:
    """Return a vocabulary as JSON text that people can edit, without empty sizes."""
    values = vocabulary.to_dict()
    for entry in values["objects"]:
        if entry["size"] is None:
            del entry["size"]
    return vocabulary_text({name: values[name] for name in ("objects", "room_types")})


def vocabulary_text(values: Mapping[str, Any]) -> str:
    """Return the JSON values of a vocabulary as text, with one class on each line."""
    lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in values["objects"])
    entries = [f'"objects": [\n{lines}\n]']
    entries += [
        f"{json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}"
        for name, value in values.items()
        if name != "objects"
    ]
    return "{\n" + ",\n".join(entries) + "\n}\n"


def with_aliases(vocabulary: Vocabulary) -> Vocabulary:
    """Return the vocabulary with curated synonyms, kinds and parents. Labels and sizes stay."""
    names, objects = curated_names(), []
    for entry in vocabulary.objects:
        synonyms = (x for x in names.aliases.get(entry.label, ()) if vocabulary.index(x) is None)
        objects.append(replace(entry, aliases=(*entry.aliases, *synonyms)))
    return with_room_aliases(_with_kinds(Vocabulary(objects, vocabulary.room_types), names))


def with_room_aliases(vocabulary: Vocabulary) -> Vocabulary:
    """Return the vocabulary with the curated synonyms of its room types."""
    rooms = curated_names().rooms
    keys = {label_key(room) for room in vocabulary.room_types}
    aliases = {
        room: synonyms
        for room in vocabulary.room_types
        if (synonyms := [x for x in rooms.get(room, ()) if label_key(x) not in keys])
    }
    return Vocabulary(vocabulary.objects, vocabulary.room_types, aliases)


def read_vocabulary(path: Path) -> Vocabulary:
    """Read a vocabulary from a JSON file in the format of `vocabulary_json`.

    Raises:
        OSError: the file cannot be read.
        ValueError: the content of the file is not JSON or not a vocabulary.
    """
    try:
        return VocabularyEntry.model_validate_json(path.read_bytes()).vocabulary()
    except ValidationError as error:
        raise ValueError(first_error(error)) from None


def source_vocabulary(
    scenes: Iterable[AnnotatedScene],
    *,
    minimum: int = MINIMUM_MENTIONS,
    required: Iterable[str] = (),
) -> Vocabulary:
    """Build a vocabulary of the frequent classes of one data source and the `required` labels.

    Different required labels are different classes, also if they are curated synonyms.
    """
    required = tuple(required)
    names = curated_names().telling_apart(required)
    # An empty entry preserves the curated spelling of a class without aliases.
    spellings = dict.fromkeys((*names.base, *names.household, *names.structure), ())
    aliases = spellings | names.aliases
    base = tuple({label_key(name): name for name in map(names.canonical, required)}.values())
    # Without kinds, a specific name becomes an alias: "coffee table" of "table". `_with_kinds` adds
    # the curated specific names that no class has.
    mentioned_only = replace(names, base=base, household=(), kinds={}, aliases=aliases)
    return _with_kinds(build_vocabulary(scenes, mentioned_only, minimum=minimum), names)


def _with_kinds(vocabulary: Vocabulary, names: Names) -> Vocabulary:
    """Set the parents of classes, and add the names of their kinds without a class as aliases."""
    objects = []
    for entry in vocabulary.objects:
        parent = names.broader.get(entry.label)
        while parent is not None and parent not in vocabulary.labels:
            parent = names.broader.get(parent)
        kinds, aliases = list(names.kinds.get(entry.label, ())), list(entry.aliases)
        for kind in kinds:
            if vocabulary.index(kind) is None:
                aliases += [kind, *names.aliases.get(kind, ())]
                kinds += names.kinds.get(kind, ())
        anywhere = entry.label in names.anywhere
        objects.append(replace(entry, aliases=tuple(aliases), parent=parent, anywhere=anywhere))
    return Vocabulary(objects, vocabulary.room_types)


def with_typical_sizes(vocabulary: Vocabulary, scenes: Iterable[AnnotatedScene]) -> Vocabulary:
    """Add the typical size of each class: the median of its boxes, if it has `MINIMUM_BOXES`."""
    boxes: dict[int, list[tuple[float, float]]] = {}
    index_of = cache(vocabulary.index)
    for thing in (thing for scene in scenes for thing in scene.objects):
        if thing.size and min(thing.size) and (index := index_of(thing.label)) is not None:
            x, y, z = thing.size
            # The yaw is unknown, so the footprint is a square with the area of the box.
            boxes.setdefault(index, []).append(((x * y) ** 0.5, z))
    classes = list(vocabulary.objects)
    for index, class_boxes in boxes.items():
        if len(class_boxes) >= MINIMUM_BOXES:
            side, height = (round(x, 3) for x in np.median(class_boxes, axis=0).tolist())
            classes[index] = replace(classes[index], size=(side, side, height))
    return Vocabulary(classes, vocabulary.room_types)


def coverage(vocabulary: Vocabulary, scenes: Iterable[AnnotatedScene]) -> float:
    """Return the share of the objects in scenes whose label is in a vocabulary."""
    mentions = Counter(thing.label for scene in scenes for thing in scene.objects)
    covered = (count for label, count in mentions.items() if vocabulary.index(label) is not None)
    return sum(covered) / mentions.total()


@lru_cache(maxsize=4096)
def is_placeholder(label: str) -> bool:
    """Return True if a label names no kind of object."""
    name, names = without_instance(label), curated_names()
    numbered = () if name == label.strip() else names.numbered
    empty = frozenset((*names.placeholders, *numbered))
    return names_nothing(label, empty) or names_nothing(name, empty)


def plain_label(label: str) -> str:
    """Return the curated name in a label: chair for "chair_12", sofa for "sofa.n.01"."""
    names = curated_names()
    # The number of a label without a curated name may distinguish kinds: "screw m4".
    if names.is_curated(label) or not names.is_curated(name := without_instance(label)):
        return label
    return name


def plain_scenes(scenes: Iterable[AnnotatedScene]) -> tuple[list[AnnotatedScene], Counter[str]]:
    """Return the scenes with plain labels and without placeholders, and the left-out labels."""
    left_out: Counter[str] = Counter()
    plain = []
    for scene in scenes:
        empty = [is_placeholder(thing.label) for thing in scene.objects]
        left_out.update(x.label for x, drop in zip(scene.objects, empty, strict=True) if drop)
        if any(empty):
            scene = scene.only([k for k, drop in enumerate(empty) if not drop])
        labels = [plain_label(thing.label) for thing in scene.objects]
        if labels != [thing.label for thing in scene.objects]:
            pairs = zip(scene.objects, labels, strict=True)
            scene = replace(scene, objects=tuple(replace(x, label=label) for x, label in pairs))
        plain.append(scene)
    return plain, left_out


def left_out_line(left_out: Counter[str], most: int) -> str:
    """Return one line that names the left-out labels and how often each occurs, "" without any."""
    if not left_out:
        return ""
    named = ", ".join(f"{label} ({count})" for label, count in left_out.most_common(most))
    more = f" and {len(left_out) - most} more" if len(left_out) > most else ""
    return f"left out, because they name no kind of object: {named}{more}"
