"""Extend a proposal of `init` with new files, and keep what a person has edited.

`proposed.json` contains every name that a proposal had. A name that is in `proposed.json` but not
in the vocabulary was removed by a person, so no update adds it again.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from app.model.fields import first_error
from app.registry import VocabularyEntry
from app.scene import ObjectClass, Vocabulary, label_key
from training.datasets import AnnotatedScene, DatasetError, source_vocabulary
from training.datasets.records import AnnotatedObject
from training.datasets.vocabulary import coverage, vocabulary_text
from training.domain.look import Label
from training.domain.material import read_material
from training.domain.proposal import Proposal, propose, use_frequent_names
from training.fit.configuration import ConfigError, DataConfig, is_file
from training.runs.config_files import load_config, read_toml

PROPOSED: Final = "proposed.json"  # the file with the names of all proposals


@dataclass(frozen=True)
class Update:
    """The files that `init --update` writes, and its report."""

    proposal: Proposal  # for all scenes, with the edited and extended vocabulary
    files: dict[Path, str]  # text of each changed file
    added: tuple[Label, ...]  # new classes
    rooms: tuple[str, ...]  # new room types
    removed: tuple[Label, ...]  # frequent labels that the person removed from the vocabulary
    sources: tuple[str, ...]  # new entries of `data.sources`


def update(name: str, folder: Path, files: Sequence[Path]) -> Update:
    """Extend the proposal in a folder with files. The sources of the proposal are read again.

    Raises:
        ConfigError: the folder has no proposal, or one of its files cannot be read or extended.
        DatasetError: a file cannot be read, or has no scenes.
    """
    config_file = folder / f"{name}.toml"
    data = _data_of(config_file)
    own = [folder / source for source in data.sources if is_file(source)]
    own_paths = {path.resolve() for path in own}
    new = [file for file in files if file.resolve() not in own_paths]
    added = tuple(Path(os.path.relpath(file, folder)).as_posix() for file in new)
    material = read_material((*own, *new))
    proposal = propose(name, material, (*data.sources, *added))
    scenes = [*material.scenes, *material.drawn(proposal.config.data.written)]
    proposed = _proposed(folder / PROPOSED)
    values, edited = _read_vocabulary(folder / data.vocabulary)
    classes = _new_classes(edited, proposed, scenes, proposal.minimum, material.things)
    rooms = tuple(
        room
        for room in proposal.vocabulary.room_types
        if edited.room_index(room) is None and label_key(room) not in proposed["room_types"]
    )
    extended, texts = edited, {}
    if classes or rooms:
        values = _with_entries(values, classes, rooms)
        extended = VocabularyEntry.model_validate(values).vocabulary()
        texts[folder / data.vocabulary] = vocabulary_text(values)
        texts[folder / PROPOSED] = proposed_json(classes, rooms, proposed)
    if added:
        written = proposal.config.data.written if not data.written else 0
        texts[config_file] = _with_sources(config_file, [*data.sources, *added], written)
    without = [label for label in proposal.labels if not _has(extended, label)]
    removed = tuple(
        x for x in without if proposed["objects"] & set(map(label_key, (x.name, *x.spellings)))
    )
    dropped = tuple(label for label in without if label not in removed)
    covered = coverage(extended, scenes)
    result = replace(proposal, vocabulary=extended, coverage=covered, dropped=dropped)
    labels = tuple(x for x in proposal.labels if _has(extended, x) and not _has(edited, x))
    return Update(result, texts, labels, rooms, removed, added)


def _data_of(config_file: Path) -> DataConfig:
    """Return the data section of a configuration whose vocabulary can be extended."""
    if not config_file.is_file():
        raise ConfigError(
            f"{config_file} does not exist, so nothing can be updated: run init without --update"
        )
    data = load_config(str(config_file)).data
    if not data.vocabulary.endswith(".json"):
        raise ConfigError(
            f"{config_file}: data.vocabulary is {data.vocabulary!r}; --update extends .json files"
        )
    return data


def proposed_json(
    classes: Iterable[ObjectClass], rooms: Iterable[str], earlier: Mapping[str, set[str]] = {}
) -> str:
    """Return the text of `proposed.json`: the keys of the names of this and earlier proposals."""
    names = {
        "objects": {label_key(x) for entry in classes for x in (entry.label, *entry.aliases)},
        "room_types": set(map(label_key, rooms)),
    }
    values = {kind: sorted(own | earlier.get(kind, set())) for kind, own in names.items()}
    return json.dumps(values, ensure_ascii=False, indent=0) + "\n"


def _proposed(path: Path) -> dict[str, set[str]]:
    """Read the keys of the names of earlier proposals."""
    try:
        values = json.loads(path.read_bytes())
        return {kind: set(map(label_key, values[kind])) for kind in ("objects", "room_types")}
    except FileNotFoundError:
        raise ConfigError(
            f"{path} is missing, so removed classes cannot be told from new ones. To let every "
            'frequent label in, write {"objects": [], "room_types": []} into this file'
        ) from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path} cannot be used: {error!r}") from None


def _read_vocabulary(path: Path) -> tuple[dict[str, Any], Vocabulary]:
    """Return the JSON values of a vocabulary file, and the vocabulary. Raises ConfigError."""
    try:
        values = json.loads(path.read_bytes())
        return values, VocabularyEntry.model_validate(values).vocabulary()
    except ValidationError as error:
        raise ConfigError(f"{path} cannot be used: {first_error(error)}") from None
    except OSError as error:
        raise ConfigError(str(DatasetError.unreadable(path, error))) from None
    except ValueError as error:
        raise ConfigError(f"{path} cannot be used: {error}") from None


def _with_entries(
    values: dict[str, Any], classes: Sequence[ObjectClass], rooms: Sequence[str]
) -> dict[str, Any]:
    """Return the values of a vocabulary file with further classes and room types at the end."""
    entries = Vocabulary(classes).to_dict()["objects"] if classes else []
    for entry in entries:
        del entry["size"]
    objects, room_types = values["objects"], values.get("room_types", ())
    return values | {"objects": [*objects, *entries], "room_types": [*room_types, *rooms]}


def _new_classes(
    edited: Vocabulary,
    proposed: dict[str, set[str]],
    scenes: Sequence[AnnotatedScene],
    minimum: int,
    written: Iterable[str],
) -> tuple[ObjectClass, ...]:
    """Return the frequent or written classes that are in no earlier proposal and no class."""

    def is_new(label: str) -> bool:
        return edited.index(label) is None and label_key(label) not in proposed["objects"]

    rest = []
    for scene in scenes:
        things = [AnnotatedObject(x.id, x.label) for x in scene.objects if is_new(x.label)]
        rest.append(AnnotatedScene(scene.scene_id, scene.source, scene.group, None, tuple(things)))
    try:
        required = filter(is_new, written)
        vocabulary = source_vocabulary(rest, minimum=minimum, required=required)
        vocabulary = use_frequent_names(vocabulary, rest)
    except ValueError:
        return ()  # no new label is frequent
    new = [entry for entry in vocabulary.objects if is_new(entry.label)]
    labels = {entry.label for entry in new}
    return tuple(
        replace(
            entry,
            aliases=tuple(filter(is_new, entry.aliases)),
            parent=entry.parent if entry.parent in labels else None,
        )
        for entry in new
    )


def _has(vocabulary: Vocabulary, label: Label) -> bool:
    return any(vocabulary.index(x) is not None for x in (label.name, *label.spellings))


def _with_sources(path: Path, sources: Sequence[str], written: int) -> str:
    """Return the text of a configuration with new sources, and `data.written` unless it is 0."""
    expected = read_toml(path)
    expected["data"]["sources"] = list(sources)
    array = json.dumps(list(sources), ensure_ascii=False)
    if written:
        expected["data"]["written"] = written
        array += f"\nwritten = {written}"
    text = re.sub(
        r"^([ \t]*sources[ \t]*=[ \t]*)\[[^\[\]]*\]",
        lambda match: match[1] + array,
        path.read_text("utf-8"),
        count=1,
        flags=re.MULTILINE,
    )
    try:
        if tomllib.loads(text) == expected:
            return text
    except tomllib.TOMLDecodeError:
        pass
    entries = array.replace("\n", " and ")
    raise ConfigError(f"{path}: write sources = {entries} into [data] yourself, then repeat")
