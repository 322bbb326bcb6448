"""Scenes as the machines of Bozcan et al. (2018) see them: classes and listed triples."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app.scene import Vocabulary, canonicalise
from training.datasets import (
    AnnotatedScene,
    EncodedScene,
    encode,
    read_scenes,
    source_vocabulary,
    split,
)
from training.datasets.array_types import Table
from training.datasets.splits import Protocol

SPLITS: Final[dict[str, Protocol]] = {"scenes": "paper", "groups": "paper groups"}
"""Splits by name. "scenes" is the split of the paper, "groups" keeps near-duplicates together."""

RELATIONS: Final = 4
"""Number of canonical relations: left, front, on-top and above. The paper has no inside."""


@dataclass(frozen=True, eq=False)
class Scenes(Table):
    """N scenes. In an annotated scene, an unlisted relation is false."""

    v: Float[Tensor, "N V"]  # presence of each class
    r: Float[Tensor, "N T"]  # listed triples among those of training
    labelled: Int[Tensor, "N"]  # number of listed triples, those without a unit included
    annotated: Bool[Tensor, "N"]  # False for a scene without annotation of relations

    def __len__(self) -> int:
        return len(self.v)


@dataclass(frozen=True, eq=False)
class Material:
    """The scenes of one split."""

    vocabulary: Vocabulary
    triples: Int[Tensor, "T 3"]  # relation, subject and object class of each triple of `train`
    train: Scenes
    validation: Scenes
    test: Scenes
    digest: str  # sha256 of the scenes and their split


def read_material(source: str, folder: Path) -> dict[str, Material]:
    """Read the scenes of a source, and split them 60 / 30 / 10 % by each of `SPLITS`.

    Raises:
        DatasetError: the file is missing or invalid.
    """
    path = Path(source)
    read = read_scenes(path if path.suffix else folder / f"{source}.jsonl.gz")
    scenes = [_of_the_paper(scene) for scene in read]
    classes = source_vocabulary(scenes)
    # Structure such as the floor is an ordinary class, as in the paper.
    objects = [replace(entry, structure=False) for entry in classes.objects]
    vocabulary = Vocabulary(objects, classes.room_types, classes.room_aliases)
    encoded = {scene.scene_id: scene for scene in encode(scenes, vocabulary)}
    return {name: _material(scenes, encoded, vocabulary, how) for name, how in SPLITS.items()}


def _of_the_paper(scene: AnnotatedScene) -> AnnotatedScene:
    """Return the scene with only the `RELATIONS` of the paper and their opposites."""

    def kept(triples: Sequence[tuple[int, str, int]]) -> tuple[tuple[int, str, int], ...]:
        return tuple(triple for triple in triples if canonicalise(*triple)[0] < RELATIONS)

    relations = None if scene.relations is None else kept(scene.relations)
    return replace(scene, relations=relations, false_relations=kept(scene.false_relations))


def _material(
    scenes: Sequence[AnnotatedScene],
    encoded: dict[str, EncodedScene],
    vocabulary: Vocabulary,
    protocol: Protocol,
) -> Material:
    """Split the scenes by a protocol. The triples of the training part become units."""
    parts = split(scenes, seed=0, protocol=protocol)
    V = len(vocabulary)
    members = {part: [encoded[x.scene_id] for x in own] for part, own in parts.items()}
    train = [_keys(scene, V) for scene in members["train"]]
    units = np.unique(np.concatenate([*train, np.zeros(0, np.int64)]))
    tensors = {part: _scenes(own, units, V) for part, own in members.items()}
    sha = hashlib.sha256(repr([entry.label for entry in vocabulary.objects]).encode())
    for entry in parts.items():
        sha.update(repr(entry).encode())
    # The inverse of `_keys`: relation, subject and object class of each unit.
    triples = np.stack([units // V // V, units // V % V, units % V], axis=1)
    return Material(vocabulary, torch.from_numpy(triples), **tensors, digest=sha.hexdigest())


def _keys(scene: EncodedScene, V: int) -> Int[NDArray, "n"]:
    """Return the listed triples of a scene as integers (relation * V + i) * V + j."""
    relation, subject, object_ = scene.evidence.holds[:RELATIONS].nonzero()
    classes = scene.evidence.classes
    return np.asarray((relation * V + classes[subject]) * V + classes[object_])


def _scenes(scenes: Sequence[EncodedScene], units: Int[NDArray, "T"], V: int) -> Scenes:
    """Return the scenes as tensors. `units` are the keys (`_keys`) of the triples with a unit."""
    v, r = torch.zeros(len(scenes), V), torch.zeros(len(scenes), len(units))
    keys = [_keys(scene, V) for scene in scenes]
    for row, (scene, own) in enumerate(zip(scenes, keys, strict=True)):
        v[row, torch.from_numpy(scene.evidence.classes)] = 1.0
        r[row, torch.from_numpy(np.isin(units, own))] = 1.0
    annotated = [bool(scene.evidence.observed[:RELATIONS].any()) for scene in scenes]
    return Scenes(v, r, torch.tensor([len(own) for own in keys]), torch.tensor(annotated))
