"""Predicted weights of words that a model has no class for.

A model's weights of a class depend on the meaning of the class: a tankard is where mugs are. So the
rows of the known classes predict the row of a word, by kernel ridge regression from word vectors:

    row(x) = mean + s · k(x)' (K + λ I)^-1 (rows - mean)
    k_j(x) = exp(x'x_j - 1),   K_ij = k_j(x_i)

x are the word vectors without their mean over the classes, scaled to length 1. The regression
shrinks the rows, and the stretch s of W undoes that. The couplings of a word to other classes are
0, and its base rate is the same in all data sources, because predicted ones did not improve the
answers.

The relations of a word and its places are those of its nearest class (`Vocabulary.stand_in`).
docs/decisions/vocabulary.md has the measurements.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.inference import Weights
from app.inference.objects import LARGEST_WEIGHT
from app.scene.vocabulary import Vocabulary, Word

_RIDGE: Final = 0.1  # λ
_STRETCH: Final = {"W": 1.7}  # s of each array, 1 by default

# Predicted arrays. An array has one row for each class, or else one column.
_ROWS: Final = ("W",)
_COLUMNS: Final = ("b", "kappa", "Y")

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class RowMap:
    """The regression from D components of word vectors to M weights, fitted to K classes."""

    centre: Float[Floats, " D"]  # mean of the word vectors
    vectors: Float[Floats, "K D"]  # without the mean, of length 1
    coefficients: Float[Floats, "K M"]  # (K + λ I)^-1 (rows - mean)
    mean: Float[Floats, " M"]  # of the rows

    @classmethod
    def fit(cls, weights: Weights, vocabulary: Vocabulary, left_out: Sequence[int] = ()) -> Self:
        """Fit the map to the classes with word vectors, except structure and ``left_out`` indices.

        Raises:
            ValueError: no class has a word vector.
        """
        vectors, has_vector = vocabulary.vectors
        used = has_vector & ~vocabulary.structure
        used[list(left_out)] = False
        if not used.any():
            raise ValueError("no class of the model has a word vector")
        rows = np.concatenate([part.reshape(len(used), -1) for part in _parts(weights).values()], 1)
        centre = vectors[used].mean(0)
        x, rows = _directions(vectors[used] - centre), rows[used].astype(np.float32)
        mean = rows.mean(0)
        kernel = np.exp(x @ x.T - 1)
        kernel[np.diag_indices_from(kernel)] += np.float32(_RIDGE)
        return cls(centre, x, np.linalg.solve(kernel, rows - mean), mean)

    def with_words(self, weights: Weights, words: Sequence[Word]) -> Weights:
        """Return the weights with a further class for each word, at the end."""
        vectors = np.stack([word.vector for word in words])
        return with_rows(weights, self.rows(weights, vectors))

    def rows(
        self, weights: Weights, vectors: Float[Floats, "N D"]
    ) -> dict[str, Float[NDArray[np.float32], "N ..."]]:
        """Return the predicted weights of N words by the names of their arrays."""
        k = np.exp(_directions(vectors - self.centre) @ self.vectors.T - 1)
        change, start = k @ self.coefficients, 0
        rows: dict[str, Floats] = {}
        for name, part in _parts(weights).items():
            shape = len(vectors), *part.shape[1:]
            end = start + int(np.prod(part.shape[1:], dtype=np.int64))
            stretched = self.mean[start:end] + _STRETCH.get(name, 1.0) * change[:, start:end]
            rows[name] = stretched.clip(-LARGEST_WEIGHT, LARGEST_WEIGHT).reshape(shape)
            start = end
        return rows


def with_rows(weights: Weights, rows: Mapping[str, Floats]) -> Weights:
    """Return the weights with a further class for each predicted row. Other weights are 0."""
    V, more = weights.spec.V, len(rows["W"])
    larger = weights.enlarged(V + more, weights.spec.C)
    for name, values in _parts(larger).items():
        values[V:] = rows[name]
    return larger


def _parts(weights: Weights) -> dict[str, NDArray[Any]]:
    """Return views of the predicted arrays, with the classes in the first axis."""
    parts = {name: weights[name] for name in _ROWS}
    return parts | {name: weights[name].T for name in _COLUMNS if name in weights.arrays}


def _directions(vectors: Float[Floats, "N D"]) -> Float[Floats, "N D"]:
    """Return vectors scaled to length 1. A vector of 0 stays 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.float32(1e-9))
