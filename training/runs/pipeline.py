"""Read, split and encode the scenes of a configuration, for training and evaluation."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from app.model import Possibility
from app.registry import Example
from app.scene import RoleCounts, Vocabulary
from training.datasets import (
    AnnotatedScene,
    DatasetError,
    EncodedScene,
    annotated_classes,
    encode,
    generate_rooms,
    inventories,
    read_scenes,
    rooms_vocabulary,
    source_vocabulary,
    split,
)
from training.datasets.batches import TrainingData, scene_tensors
from training.datasets.files import KNOWLEDGE
from training.datasets.readers import PRIORS, read_prior_scenes
from training.datasets.records import digest_of
from training.datasets.roles import count_roles
from training.datasets.sources import is_inventory
from training.datasets.vocabulary import plain_scenes, read_vocabulary, with_typical_sizes
from training.datasets.written import written_vocabulary
from training.fit.configuration import Config, ConfigError, DataConfig, is_file, source_name
from training.fit.possibility import fit_possibility


@dataclass(frozen=True)
class SplitScenes:
    """The encoded scenes of the train, validation and test part, and their origin."""

    data: DataConfig
    vocabulary: Vocabulary  # the scenes use the indices of its classes
    roles: RoleCounts  # of the classes in the training scenes
    possibility: Possibility | None  # of the classes; None: no class has a description
    parts: dict[str, list[EncodedScene]]
    counts: dict[str, int]  # number of scenes, by source
    digests: dict[str, str]  # sha256 of the contents of the scenes, by source
    words: Float[Tensor, "V D"] | None = None  # unit word vectors of the classes
    examples: tuple[Example, ...] = ()  # for the artifact

    @property
    def digest(self) -> str:
        """The sha256 of the training input: scenes, vocabulary and split."""
        decisive = {
            "data": self.data.model_dump(mode="json"),
            "contents": self.digests,
            "vocabulary": self.vocabulary.to_dict(),
        }
        return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()

    def training_data(self) -> TrainingData:
        """Return the tensors. A source annotates the classes that occur in its training part."""
        annotated = annotated_classes(self.parts["train"], self.vocabulary)
        sources = {scene.source for scenes in self.parts.values() for scene in scenes}
        for source in sources - set(annotated):
            raise ConfigError(
                f"the training part contains no scene of the source {source!r}; add scenes, or "
                "remove the source from data.sources"
            )
        words = self.vocabulary
        tensors = {name: scene_tensors(part, annotated, words) for name, part in self.parts.items()}
        return TrainingData(
            **tensors,
            structure=torch.from_numpy(self.vocabulary.structure.copy()),
            digest=self.digest,
            words=self.words,
            vocabulary=self.vocabulary,
            roles=self.roles,
            possibility=self.possibility,
        )

    def complete_data(self) -> TrainingData:
        """Return the tensors for an experiment, which needs all three parts."""
        for part, scenes in self.parts.items():
            if not scenes:
                raise ConfigError(
                    f"the {part} part contains no scenes: provide more scenes or more groups"
                )
        return self.training_data()


def read_sources(data: DataConfig, root: Path) -> dict[str, list[AnnotatedScene]]:
    """Read the scenes of every data source, by source name. Scenes of files have plain labels."""
    _require_files(data, root)
    scenes: dict[str, list[AnnotatedScene]] = {}
    for source in data.sources:
        name, path = source_name(source), _path(source, root)
        if source == "rooms":
            own = generate_rooms(data.rooms, seed=data.split_seed)
        elif is_inventory(source):
            inventory = inventories.read_inventory(path)
            draw = inventory.detected_scenes if source == inventories.SOURCE else inventory.scenes
            own = draw(data.written, seed=data.split_seed)
        elif source == PRIORS:
            own = read_prior_scenes(path)
        else:
            own = read_scenes(path)
            if is_file(source):
                own, _ = plain_scenes(own)
        scenes[name] = [replace(scene, source=name) for scene in own[: data.limit]]
    return scenes


def _path(source: str, root: Path) -> Path:
    """Return the file of a data source. Files of public sources may be in the folder `extra`."""
    if source == inventories.SOURCE:
        return KNOWLEDGE / "inventories.csv"
    if is_file(source):
        return root / source
    file = f"{source}.tsv.gz" if source == PRIORS else f"{source}.jsonl.gz"
    extra = root / "extra" / file
    return extra if extra.is_file() else root / file


def _require_files(data: DataConfig, root: Path) -> None:
    """Raise ConfigError if files of scenes are missing. It names them, and the remedy."""
    paths = {source: _path(source, root) for source in data.sources if source != "rooms"}
    missing = {source: path for source, path in paths.items() if not path.is_file()}
    if not missing:
        return
    names = ", ".join(path.relative_to(root).as_posix() for path in missing.values())
    advice = (
        "The paths start at the folder of your configuration file. Pass this folder with --data, "
        "such as --data my-lab"
        if all(map(is_file, missing))
        else "The repository does not contain the public data sets. docs/training.md (The public "
        "data sets) names them and their files. Pass the folder of the files with --data"
    )
    raise ConfigError(
        f"{len(missing)} of {len(paths)} files of scenes are missing in {root}: {names}. {advice}"
    )


def build_vocabulary(data: DataConfig, scenes: list[AnnotatedScene], root: Path) -> Vocabulary:
    """Return the vocabulary of a configuration, with typical object sizes from the scenes."""
    name = data.vocabulary
    makers: dict[str, Callable[[], Vocabulary]] = {
        "written": written_vocabulary,
        "source": partial(source_vocabulary, scenes),
        "rooms": rooms_vocabulary,
    }
    if name in makers:
        return with_typical_sizes(makers[name](), scenes)
    if not name.endswith(".json"):
        raise ConfigError(
            f"data.vocabulary is {name!r}; it must be {', '.join(makers)}, or the name of a .json "
            "file"
        )
    try:
        vocabulary = read_vocabulary(root / name)
    except OSError as error:
        raise ConfigError(
            f"data.vocabulary: {DatasetError.unreadable(root / name, error)}"
        ) from error
    except ValueError as error:
        raise ConfigError(f"data.vocabulary: {root / name} cannot be used: {error}") from error
    return with_typical_sizes(vocabulary, scenes)


def _things(data: DataConfig, root: Path) -> dict[str, inventories.Thing]:
    """Return the described things of the tables beside own inventories, and of the repository."""
    own = (source for source in data.sources if is_file(source) and is_inventory(source))
    beside = (_path(source, root).with_name(inventories.THINGS) for source in own)
    tables = (inventories.read_things(path) for path in beside if path.is_file())
    return inventories.with_shipped(tables)


def split_and_encode(
    data: DataConfig,
    scenes: dict[str, list[AnnotatedScene]],
    root: Path,
    vocabulary: Vocabulary | None = None,
) -> SplitScenes:
    """Split the scenes of all sources at once, because sources can share rooms, and encode them."""
    all_scenes = [scene for source in scenes.values() for scene in source]
    parts = split(all_scenes, seed=data.split_seed, protocol=data.split)
    if vocabulary is None:
        vocabulary = build_vocabulary(data, parts["train"], root)
    roles, things = count_roles(parts["train"], vocabulary), _things(data, root)
    encoded: dict[str, list[EncodedScene]] = {
        name: encode(part, vocabulary, roles) for name, part in parts.items()
    }
    return SplitScenes(
        data=data,
        vocabulary=vocabulary,
        roles=roles,
        possibility=fit_possibility(parts["train"], encoded["train"], vocabulary, things),
        parts=encoded,
        counts={name: len(source) for name, source in scenes.items()},
        digests={name: digest_of(source) for name, source in scenes.items()},
        words=torch.from_numpy(vocabulary.vectors[0]) if data.words else None,
    )


def prepare(config: Config, root: Path, vocabulary: Vocabulary | None = None) -> SplitScenes:
    """Read, split and encode the scenes of a configuration; `vocabulary`: of a published model."""
    return split_and_encode(config.data, read_sources(config.data, root), root, vocabulary)
