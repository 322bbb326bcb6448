"""Training scenes in many files (shards), of which one at a time is in memory.

A source such as `shards/part-*.jsonl.gz`, or a URL of fsspec with a `*`, is a sharded source. A
sample of its scenes stays in memory: it gives the first biases, the objects' phase, validation and
test. Each epoch reads all shards in random order, and encodes their training scenes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import fsspec
import numpy as np
import torch

from app.scene import Vocabulary
from training.batches import SceneTensors, scene_tensors
from training.config import ConfigError
from training.datasets import AnnotatedScene, encode, read_scenes, split


@dataclass(frozen=True)
class Shards:
    """The files of a sharded source.

    Attributes:
        files: paths or URLs.
        source: name of the source.
        vocabulary: classes; the scenes use their indices.
        sample: number of files whose scenes stay in memory.
        annotated: by source, (V,) bool of the classes that the source mentions in the sample.
        seed: seed of the split.
    """

    files: tuple[str, ...]
    source: str
    sample: int
    vocabulary: Vocabulary
    annotated: dict[str, np.ndarray]
    seed: int

    @property
    def scale(self) -> float:
        """The number of files for each file of the sample."""
        return len(self.files) / min(self.sample, len(self.files))

    def parts(self, generator: torch.Generator) -> Iterator[SceneTensors]:
        """Yield the training scenes of each shard, in random order."""
        for k in torch.randperm(len(self.files), generator=generator).tolist():
            yield self._part(self.files[k])

    def _part(self, file: str) -> SceneTensors:
        scenes = read_shard(file, self.source)
        train = split(scenes, seed=self.seed, protocol="stable")["train"]
        encoded = encode(train, self.vocabulary)
        return scene_tensors(encoded, self.annotated, len(self.vocabulary))


def shard_files(pattern: str, root: Path) -> tuple[str, ...]:
    """Return the sorted files of a pattern; a path is relative to `root`.

    Raises:
        ConfigError: the pattern matches no file.
    """
    fs, path = fsspec.url_to_fs(pattern if "://" in pattern else str((root / pattern).absolute()))
    files = tuple(sorted(fs.glob(path)))
    if not files:
        raise ConfigError(f"no file matches {pattern} in {root}: name its folder with --data")
    return tuple(fs.unstrip_protocol(file) for file in files) if "://" in pattern else files


def read_shard(file: str, source: str) -> list[AnnotatedScene]:
    """Read the scenes of a shard."""
    with _local(file) as path:
        return [replace(scene, source=source) for scene in read_scenes(path)]


def shards_digest(files: Sequence[str]) -> str:
    """Return the sha256 of the contents of all shards."""
    sha = hashlib.sha256()
    for file in files:
        with _local(file) as path, path.open("rb") as opened:
            sha.update(hashlib.file_digest(opened, "sha256").digest())
    return sha.hexdigest()


@contextmanager
def _local(file: str) -> Iterator[Path]:
    """Yield the path of a shard, for a URL of a temporary copy."""
    if "://" not in file:
        yield Path(file)
        return
    fs, path = fsspec.url_to_fs(file)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / Path(path).name
        fs.get_file(path, str(copy))
        yield copy
