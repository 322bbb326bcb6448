"""From a configuration to split, encoded scenes, for training and evaluation alike."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from app.scene import CANONICAL, Vocabulary
from training.batches import SceneTensors, scene_tensors
from training.config import DATA, Config, ConfigError, DataConfig, is_file, source_name
from training.datasets import (
    AnnotatedScene,
    EncodedScene,
    annotated_classes,
    encode,
    generate_rooms,
    indoor_vocabulary,
    priors,
    read_scenes,
    read_vocabulary,
    rooms_vocabulary,
    shuffle_objects,
    source_vocabulary,
    split,
    with_typical_sizes,
)
from training.datasets.words import class_vectors, read_word_vectors
from training.trainer import TrainingData


@dataclass(frozen=True)
class SplitScenes:
    """Encoded scenes of every part, with what they were read from.

    Attributes:
        data: the section that named them.
        vocabulary: class indices of the scenes.
        parts: per part, its scenes over all sources.
        counts, digests: per source, scenes read and sha256 of what was read.
        shuffle: seed of the permutation, None where the scenes are as they were read.
        words: (V, D) unit word vectors of the classes; None without any.
    """

    data: DataConfig
    vocabulary: Vocabulary
    parts: dict[str, list[EncodedScene]]
    counts: dict[str, int]
    digests: dict[str, str]
    shuffle: int | None = None
    words: torch.Tensor | None = None

    @property
    def digest(self) -> str:
        """sha256 of all that decides what is learnt from: contents, vocabulary, split, shuffling.

        Names alone would not do: a corrected file has the same ones.
        """
        decisive = {
            "data": self.data.model_dump(mode="json"),
            "contents": self.digests,
            "vocabulary": self.vocabulary.to_dict(),
            "shuffle": self.shuffle,
        }
        return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()

    def training_data(self) -> TrainingData:
        """Tensors for the trainer. What a source annotates is learnt from its training part."""
        annotated = annotated_classes(self.parts["train"], self.vocabulary)
        every = {scene.source for scenes in self.parts.values() for scene in scenes}
        for source in every - set(annotated):
            raise ConfigError(f"source {source!r} has no scene in the training part")
        tensors: dict[str, SceneTensors] = {
            part: scene_tensors(scenes, annotated, len(self.vocabulary))
            for part, scenes in self.parts.items()
        }
        return TrainingData(
            train=tensors["train"],
            validation=tensors["validation"],
            test=tensors["test"],
            structure=torch.from_numpy(self.vocabulary.structure.copy()),
            relations=len(CANONICAL),
            room_types=len(self.vocabulary.room_types),
            digest=self.digest,
            words=self.words,
        )

    def shuffled(self, seed: int) -> SplitScenes:
        """The same with the objects of training and validation scenes permuted between scenes.

        Test scenes stay as they are.
        """
        structure = self.vocabulary.structure
        permuted = {
            part: shuffle_objects(self.parts[part], structure, seed)
            for part in ("train", "validation")
        }
        return replace(self, parts=self.parts | permuted, shuffle=seed)


def read_sources(data: DataConfig, root: Path) -> dict[str, list[AnnotatedScene]]:
    """The scenes of every source under its name.

    A source is a file, or `<source>.jsonl.gz` in `root` or in its folder `extra`.

    Raises:
        ConfigError: there is no such file.
        DatasetError: a file is malformed.
    """
    scenes: dict[str, list[AnnotatedScene]] = {}
    for source in data.sources:
        name = source_name(source)
        if source == "rooms":
            found = generate_rooms(data.rooms, seed=data.split_seed)
        elif source == priors.SOURCE:
            found = priors.read_prior_scenes(root / "extra" / f"{source}.tsv.gz")
        else:
            path = root / (source if is_file(source) else f"{source}.jsonl.gz")
            extra = root / "extra" / path.name
            if not is_file(source) and not path.is_file() and extra.is_file():
                path = extra
            if not path.is_file():
                raise ConfigError(
                    f"there is no {path.name} in {path.parent}: name its folder with --data"
                )
            found = [replace(scene, source=name) for scene in read_scenes(path)]
        scenes[name] = found[: data.limit]
    return scenes


def build_vocabulary(data: DataConfig, scenes: list[AnnotatedScene], root: Path) -> Vocabulary:
    """The vocabulary a configuration names, with the typical sizes of its scenes.

    Raises:
        ConfigError: an unknown name, or a file in `root` that holds no vocabulary.
    """
    if data.vocabulary == "indoor":
        vocabulary = indoor_vocabulary()
    elif data.vocabulary == "source":
        vocabulary = source_vocabulary(scenes)
    elif data.vocabulary == "rooms":
        vocabulary = rooms_vocabulary()
    elif data.vocabulary.endswith(".json"):
        vocabulary = _read_vocabulary(root / data.vocabulary)
    else:
        raise ConfigError(
            f"unknown vocabulary {data.vocabulary!r}: indoor, source, rooms, or a file that ends "
            "in .json"
        )
    return with_typical_sizes(vocabulary, scenes)


def _read_vocabulary(path: Path) -> Vocabulary:
    try:
        return read_vocabulary(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"data.vocabulary: {path} cannot be used: {error}") from error


def split_and_encode(
    data: DataConfig,
    scenes: dict[str, list[AnnotatedScene]],
    vocabulary: Vocabulary | None = None,
    root: Path = DATA,
) -> SplitScenes:
    """Split all sources together (groups are shared between them) and encode each part.

    Args:
        vocabulary: that of a published model; by default the configuration's.
        root: where the file of the configuration's vocabulary is.

    Raises:
        ConfigError: see `build_vocabulary`.
    """
    everything = [scene for source in scenes.values() for scene in source]
    parts = split(everything, seed=data.split_seed, protocol=data.split)
    if vocabulary is None:
        vocabulary = build_vocabulary(data, list(parts["train"]), root)
    return SplitScenes(
        data=data,
        vocabulary=vocabulary,
        parts={part: encode(some, vocabulary) for part, some in parts.items()},
        counts={source: len(some) for source, some in scenes.items()},
        digests={source: digest_of(some) for source, some in scenes.items()},
        words=_word_vectors(data, vocabulary, root),
    )


def _word_vectors(data: DataConfig, vocabulary: Vocabulary, root: Path) -> torch.Tensor | None:
    """The vectors of the classes, (V, D).

    Raises:
        DatasetError: there is no such file, or it holds no vectors.
    """
    if not data.words:
        return None
    vectors, _ = class_vectors(read_word_vectors(root / data.words), vocabulary)
    return torch.from_numpy(vectors)


def digest_of(scenes: Sequence[AnnotatedScene]) -> str:
    """sha256 of the scenes' contents, whatever file format they came in."""
    sha = hashlib.sha256()
    for scene in scenes:
        sha.update(repr(scene).encode())
    return sha.hexdigest()


def prepare(config: Config, root: Path) -> SplitScenes:
    """Read, split and encode what a configuration names."""
    return split_and_encode(config.data, read_sources(config.data, root), root=root)
