"""Word vectors: how close the meanings of two labels are.

The file ``words.npz`` beside this module has the vectors of 41,306 words. Training shares weights
between classes of similar words, and the service reads labels that no class has
(`Vocabulary.meaning`). Both use this file. The vectors are GloVe 6B 100d (Pennington, Socher,
Manning, EMNLP 2014), which are in the public domain, as 8-bit integers.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_FILE: Final = Path(__file__).with_name("words.npz")
_SEPARATORS: Final = re.compile(r"[\s_\-./]+")
# Words in a label that do not describe the object. They are ignored.
_FILLERS: Final = frozenset({"a", "an", "and", "for", "in", "no", "of", "on", "or", "the", "with"})

Vectors = NDArray[np.float32]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class WordVectors:
    """Word vectors. The vector of a word is its row of ``vectors`` times ``scale``."""

    words: tuple[str, ...]  # distinct, in lower case, (words,)
    vectors: NDArray[np.int8]  # (words, dimensions)
    scale: float

    @property
    def dimensions(self) -> int:
        """Number of components of a vector."""
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

    def knows(self, word: str) -> bool:
        """Return whether a word in lower case has a vector."""
        return word in self._rows

    def _row(self, word: str) -> int | None:
        forms = (word, word.removesuffix("s"), word.removesuffix("es"))
        return next((self._rows[form] for form in forms if form in self._rows), None)

    @cached_property
    def _rows(self) -> dict[str, int]:
        rows = np.flatnonzero(self.vectors.any(axis=1)).tolist()
        return {self.words[row]: row for row in rows}


@lru_cache(maxsize=1)
def word_vectors() -> WordVectors:
    """Return the vectors of ``words.npz``. The first call reads the file, in about 0.1 s."""
    with np.load(_FILE, allow_pickle=False) as arrays:
        words, vectors, scale = (arrays[name] for name in ("words", "vectors", "scale"))
    return WordVectors(tuple(words.tolist()), vectors, float(scale))


def class_vectors(
    words: WordVectors, names: Sequence[Sequence[str]], parents: Sequence[int]
) -> tuple[Vectors, Flags]:
    """Return the unit vectors of the classes, (classes, dimensions), and a mask of known ones.

    The vector of a class is the mean of two vectors, scaled to length 1: the vector of its label,
    and the mean over its aliases. The aliases tell a saw from the past tense of "see". A class
    without either has the vector of its parent, or zero. ``names`` has the label of each class,
    then its aliases. ``parents`` is -1 without a parent.
    """
    vectors = np.zeros((len(names), words.dimensions), dtype=np.float32)
    for index, (label, *aliases) in enumerate(names):
        of_aliases = [vector for alias in aliases if (vector := words.of(alias)) is not None]
        parts = [words.of(label), _mean(of_aliases)]
        vector = _mean([vector for vector in parts if vector is not None])
        if vector is not None:
            vectors[index] = vector
    for index, parent in enumerate(parents):
        if parent >= 0 and not vectors[index].any():
            vectors[index] = vectors[parent]
    return vectors, np.asarray(vectors.any(axis=1))


def _mean(vectors: list[Vectors]) -> Vectors | None:
    """Return the mean of unit vectors, scaled to length 1, or None if there is none."""
    if len(vectors) <= 1:
        return vectors[0] if vectors else None
    mean = sum(vectors[1:], start=vectors[0])
    return _unit(mean) if mean.any() else None


def _unit(vector: NDArray[Any]) -> Vectors:
    return np.asarray(vector / math.sqrt(vector @ vector), dtype=np.float32)
