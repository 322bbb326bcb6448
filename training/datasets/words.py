"""Word vectors for the classes of a vocabulary.

The ``.npz`` file contains the arrays of `WordVectors`.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.scene import Vocabulary
from training.datasets.array_types import Flags
from training.datasets.records import DatasetError

MAX_WORDS: Final = 1_000_000
MAX_BYTES: Final = 512 * 2**20

_MEMBERS: Final = ("words", "vectors", "scale")
# Errors of an unreadable archive. `zipfile` raises RuntimeError for an encrypted archive and for an
# unknown compression.
_UNREADABLE: Final = (
    *(OSError, EOFError, ValueError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error),
)
_SEPARATORS: Final = re.compile(r"[\s_\-./]+")
# Words in a label that do not describe the object. They are ignored.
_FILLERS: Final = frozenset({"a", "an", "and", "for", "in", "no", "of", "on", "or", "the", "with"})

Vectors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class WordVectors:
    """Word vectors. The vector of a word is its row of ``vectors`` times ``scale``."""

    words: tuple[str, ...]  # distinct, in lower case, (words,)
    vectors: NDArray[np.int8]  # (words, dimensions)
    scale: float

    @property
    def dimensions(self) -> int:
        return int(self.vectors.shape[1])

    def of(self, text: str) -> Vectors | None:
        """Return the mean vector of the words of a text, scaled to length 1, (dimensions,).

        An unknown plural is looked up in the singular. Words such as "of" are ignored. The result
        is None if less than half of the words have a vector.
        """
        words = [word for word in _SEPARATORS.split(text.casefold()) if word]
        words = [word for word in words if word not in _FILLERS] or words
        rows = [row for word in words if (row := self._row(word)) is not None]
        if not rows or 2 * len(rows) < len(words):
            return None
        return _mean([_unit(self.vectors[row] * np.float32(self.scale)) for row in rows])

    def _row(self, word: str) -> int | None:
        forms = (word, word.removesuffix("s"), word.removesuffix("es"))
        return next((self._rows[form] for form in forms if form in self._rows), None)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {word: row for row, word in enumerate(self.words) if self.vectors[row].any()}


def class_vectors(words: WordVectors, vocabulary: Vocabulary) -> tuple[Vectors, Flags]:
    """Return the unit vectors of the classes, (classes, dimensions), and a mask of known ones.

    The vector of a class is the mean of two vectors, scaled to length 1: the vector of its label,
    and the mean over its aliases. The aliases tell a saw from the past tense of "see". A class
    without either has the vector of its parent, or zero.
    """
    vectors = np.zeros((len(vocabulary), words.dimensions), dtype=np.float32)
    for index, entry in enumerate(vocabulary.objects):
        of_aliases = [vector for x in entry.aliases if (vector := words.of(x)) is not None]
        names = [words.of(entry.label), _mean(of_aliases)]
        vector = _mean([vector for vector in names if vector is not None])
        if vector is not None:
            vectors[index] = vector
    for index, parent in enumerate(vocabulary.parents):
        if parent >= 0 and not vectors[index].any():
            vectors[index] = vectors[parent]
    return vectors, np.asarray(vectors.any(axis=1))


def _mean(vectors: list[Vectors]) -> Vectors | None:
    """Return the mean of unit vectors, scaled to length 1, or None if there is none."""
    mean = np.sum(vectors, axis=0) if vectors else np.zeros(0)
    return _unit(mean) if mean.any() else None


def read_word_vectors(path: Path) -> WordVectors:
    """Read a file of word vectors.

    Raises:
        DatasetError: the file is missing, invalid or too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        for name in _MEMBERS:
            if f"{name}.npy" not in sizes:
                raise DatasetError(path, name, "is missing")
            if sizes[f"{name}.npy"] > MAX_BYTES:
                raise DatasetError(path, name, f"must be at most {MAX_BYTES // 2**20} MiB")
        with np.load(path, allow_pickle=False) as arrays:  # a pickle could run code
            words, vectors, scale = (arrays[name] for name in _MEMBERS)
    except DatasetError:
        raise
    except _UNREADABLE as error:
        raise DatasetError.unreadable(path, error) from error
    if words.ndim != 1 or words.dtype.kind != "U" or not 0 < len(words) <= MAX_WORDS:
        raise DatasetError(path, "words", f"must be 1 to {MAX_WORDS} strings in one dimension")
    if vectors.dtype != np.int8 or vectors.ndim != 2 or len(vectors) != len(words):
        raise DatasetError(path, "vectors", f"must be {len(words)} rows of int8, one per word")
    if not vectors.shape[1]:
        raise DatasetError(path, "vectors", "must have at least one column")
    if scale.shape != () or scale.dtype.kind != "f" or not 0 < float(scale) < np.inf:
        raise DatasetError(path, "scale", "must be one positive number")
    names = tuple(word.casefold() for word in words.tolist())
    if len(set(names)) < len(names):
        raise DatasetError(path, "words", "contains a word twice; words must be distinct")
    return WordVectors(names, vectors, float(scale))


def _unit(vector: NDArray[Any]) -> Vectors:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float32)
