"""Fit statistics of the numbers of instances of a class, such as the chairs of a kitchen.

`app.model.Counts` has the formula. s(n) is a weighted share of the training scenes with n
instances, shrunk towards the shares over all classes. The weights maximise the penalised likelihood
of the numbers in partly listed scenes (`some_instances`). A weight is the sum of a term of the
class and a term that all classes share. `docs/decisions/counts.md` describes the alternatives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import minimize

from app.model.statistics import EXPONENTS, INTERCEPT, ROOM, SEVERAL, SINGLE, Counts
from app.scene import Vocabulary
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask, Table
from training.datasets.cases import MOST, Part, counted_classes, listed_cases
from training.datasets.sources import source_of
from training.evaluation.statistics_tasks import class_mean
from training.fit.offset_statistics import half_precision, source_weights
from training.fit.regression import at_most

_OF_GROUP: Final = 8  # maximum number of scenes of a group; they are near-duplicates
_DRAWS: Final = 2  # listings of each training and validation scene
_PRIOR: Final = 8.0  # weight of the shares over all classes in s(n), in scenes
# Penalties on the squares of the terms of a class and of the shared terms.
_OWN, _SHARED = 0.3, 0.15
# A class has a term of its own for a listed class, or a room type, of this many cases.
_OWN_CASES: Final = 10
_PRECISION: Final = 1e-6  # a smaller relative change of the loss ends the fit
# A class needs this many scenes, and this many groups that have several instances.
_SCENES, _GROUPS = 20, 10
# Three or more listed instances are covered if this many groups have as many.
_GROUPS_OF_MANY: Final = 20
_FOLDS: Final = 5


def fit_counts(scenes: Sequence[EncodedScene], vocabulary: Vocabulary) -> Counts | None:
    """Fit the statistics of counts. Return None if no class has enough data.

    All sources have the same weight. Camera frames show parts of rooms, and written numbers are
    judgements, so both are left out. A class must beat the class mean in a cross-validation.
    """
    counted = {
        name: classes
        for name, classes in counted_classes(scenes, vocabulary).items()
        if not (source_of(name).of_one_view or source_of(name).written)
    }
    scenes = [scene for scene in scenes if scene.source in counted]
    most = _most_listed(scenes, counted, vocabulary)
    if not (most > 1).any():
        return None
    scenes = at_most(scenes, lambda scene: (scene.source, scene.group), _OF_GROUP)
    counted = {source: classes & (most > 0) for source, classes in counted.items()}
    cases = _Cases.of(scenes, counted, vocabulary)
    most *= _is_better_than_mean(scenes, cases, most, counted, vocabulary)  # 0: no statistics
    cases = cases.rows(most[cases.index] > 0)
    return _fit(cases, most, vocabulary) if (most > 1).any() else None


def _fit(cases: _Cases, most: Int[NDArray, "V"], vocabulary: Vocabulary) -> Counts:
    """Fit the statistics of the classes whose maximum listed number `most` is above 0."""
    log_frequency = _log_frequencies(cases, len(vocabulary))
    weights = _weights(cases, log_frequency, most > 0)
    # A listed number is uniform from 1 to n: its probability 1/n adds -1 to the exponent 0, of n.
    weights[:, 0, INTERCEPT] -= 1.0
    # A class is no feature of its own number.
    itself = ROOM + len(vocabulary.room_types) + np.arange(len(vocabulary))
    weights[np.arange(len(vocabulary)), :, itself] = 0.0
    classes = np.flatnonzero(most)
    tables = half_precision(log_frequency[classes]), half_precision(weights[classes])
    return Counts(classes, most[classes], *tables)


def _most_listed(
    scenes: Sequence[EncodedScene], counted: dict[str, ClassMask], vocabulary: Vocabulary
) -> Int[NDArray, "V"]:
    """Return the maximum listed number of each class: at least 2, or 0 without enough data."""
    scene_counts = np.zeros(len(vocabulary), dtype=np.int64)
    largest: dict[tuple[str, str], Int[NDArray, "V"]] = {}  # numbers of instances in a group
    for scene in scenes:
        is_counted = counted[scene.source][scene.evidence.classes]
        classes, counts = scene.evidence.classes[is_counted], scene.evidence.counts[is_counted]
        scene_counts[classes] += 1
        of_group = largest.setdefault((scene.source, scene.group), np.zeros_like(scene_counts))
        of_group[classes] = np.maximum(of_group[classes], counts)
    of_groups = np.array([*largest.values()]).reshape(-1, len(vocabulary))
    # Rows: number of groups with at least 2, 3, … instances of each class.
    groups = np.stack([(of_groups >= number).sum(0) for number in range(2, MOST)])
    most = np.maximum(2, 1 + (groups >= _GROUPS_OF_MANY).sum(0))
    return np.where((scene_counts >= _SCENES) & (groups[0] >= _GROUPS), most, 0)


@dataclass(frozen=True, eq=False)
class _Cases(Table):
    """N cases: a class of a partly listed scene."""

    index: Int[NDArray, "N"]  # class
    listed: Int[NDArray, "N"]  # number of listed instances, from 1 to `number`
    number: Int[NDArray, "N"]  # number of instances in the scene
    # Features of the listed part, (N, 3 + C + V), in the columns of `Counts.weights`.
    features: sparse.csr_matrix
    scene: Int[NDArray, "N"]
    source: Int[NDArray, "N"]  # data source of the scene

    @classmethod
    def of(
        cls, scenes: Sequence[EncodedScene], counted: dict[str, ClassMask], vocabulary: Vocabulary
    ) -> _Cases:
        """List each scene in part, `_DRAWS` times."""
        names, start = sorted(counted), ROOM + len(vocabulary.room_types)
        rows: list[tuple[NDArray, NDArray]] = []
        cases: list[tuple[int, ...]] = []
        for row, scene in enumerate(scenes):
            source = names.index(scene.source)
            for seed in range(_DRAWS):
                part, indices = listed_cases(
                    scene, counted[scene.source], vocabulary.structure, seed
                )
                rows += [_features(part, k, start) for k in indices.tolist()]
                numbers = np.stack([part.classes, part.listed, part.number])[:, indices]
                cases += [(*case, row, source) for case in numbers.T.tolist()]
        index, listed, number, scene_rows, sources = np.array(cases, dtype=np.int64).T
        columns, values = (np.concatenate(arrays) for arrays in zip(*rows, strict=True))
        bounds = np.cumsum([0, *(len(row) for row, _ in rows)])
        shape = (len(cases), start + len(vocabulary))
        features = sparse.csr_matrix((values, columns, bounds), shape=shape)
        return cls(index, listed, number, features, scene_rows, sources)

    @cached_property
    def weight(self) -> Float[NDArray, "N"]:
        """Weight of each case that balances the data sources."""
        return source_weights(self.source, self.scene) / _DRAWS


def _features(
    part: Part, k: int, start: int
) -> tuple[Int[NDArray, "columns"], Float[NDArray, "columns"]]:
    """Return columns and values for the k-th class of a part; classes begin at `start`."""
    others, listed = np.delete(part.classes, k), np.delete(part.listed, k)
    columns = [INTERCEPT, SINGLE, SEVERAL, *(start + others).tolist()]
    values = [1.0, float(part.listed[k] == 1), float((listed > 1).any())]
    values += [1 / math.sqrt(max(len(others), 1))] * len(others)  # a vector of length 1
    if part.room >= 0:
        columns.append(ROOM + part.room)
        values.append(1.0)
    return np.array(columns, dtype=np.int64), np.array(values)


def _log_frequencies(cases: _Cases, V: int) -> Float[NDArray, "V M"]:
    """Return the smoothed log frequency of each number of instances of each class."""
    table = np.zeros((V, MOST))
    np.add.at(table, (cases.index, cases.number - 1), cases.weight)
    # Each number needs a positive share, because the fitted scene may favour it.
    table += _PRIOR * (0.999 * table.sum(axis=0) / table.sum() + 0.001 / MOST)
    return np.log(table / table.sum(axis=1, keepdims=True))


def _weights(
    cases: _Cases, log_frequency: Float[NDArray, "V M"], fitted: ClassMask
) -> Float[NDArray, "V 2 3+C+V"]:
    """Return the weights of each class by maximum penalised likelihood.

    A weight is a term of the class plus a shared term. The columns of `all_terms` are the terms of
    the classes that have enough cases, followed by the shared terms.
    """
    features, (N, width), V = cases.features, cases.features.shape, len(fitted)
    # The terms of a class act only on cases of this class.
    entries = features.tocoo()
    own = fitted[cases.index[entries.row]]
    row, column = entries.row[own], entries.col[own]
    class_terms = sparse.csr_matrix(
        (entries.data[own], (row, cases.index[row] * width + column)), shape=(N, V * width)
    )
    columns, cases_of = np.unique(class_terms.indices, return_counts=True)
    used_columns = columns[cases_of >= _OWN_CASES]
    all_terms = sparse.hstack([class_terms[:, used_columns], features]).tocsr()
    penalty = np.repeat([_OWN, _SHARED], [len(used_columns), width])[:, None]
    # Logits of the numbers n: log s(n) - log n, plus a line and a parabola in log n whose
    # coefficients are the terms. A number below the listed one is impossible.
    numbers = np.arange(1, MOST + 1)
    log = np.log(numbers)
    of_number = np.stack([log, log * (math.log(MOST) - log)])
    observed, case = cases.number - 1, np.arange(N)
    base = log_frequency.T[:, cases.index] - np.log(numbers)[:, None]
    base[numbers[:, None] < cases.listed] = -np.inf

    def loss(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the penalised negative log-likelihood of the flattened terms, and its gradient."""
        terms = flat.reshape(-1, EXPONENTS)
        logits = of_number.T @ (all_terms @ terms).T
        logits += base
        logits -= logits.max(axis=0)
        p = np.exp(logits)
        total = p.sum(axis=0)
        fit = cases.weight @ (logits[observed, case] - np.log(total))
        error = cases.weight * (of_number @ p / total - of_number[:, observed])
        slope = all_terms.T @ error.T + penalty * terms
        return 0.5 * (penalty * terms**2).sum() - fit, slope.ravel()

    start, options = np.zeros(all_terms.shape[1] * EXPONENTS), {"ftol": _PRECISION}
    optimum = minimize(loss, start, jac=True, method="L-BFGS-B", options=options)
    terms = optimum.x.reshape(-1, EXPONENTS)
    weights = np.zeros((V * width, EXPONENTS))
    weights[used_columns] = terms[: len(used_columns)]
    return (weights.reshape(V, width, EXPONENTS) + terms[len(used_columns) :]).swapaxes(1, 2)


def _is_better_than_mean(
    scenes: Sequence[EncodedScene],
    cases: _Cases,
    most: Int[NDArray, "V"],
    counted: dict[str, ClassMask],
    vocabulary: Vocabulary,
) -> ClassMask:
    """Return the classes whose expected number is closer to the truth than the class mean."""
    V, groups = len(vocabulary), sorted({scene.group for scene in scenes})
    order = np.random.default_rng(0).permutation(len(groups)) % _FOLDS
    fold_of = dict(zip(groups, order.tolist(), strict=True))  # a group is in one fold
    fold = np.array([fold_of[scene.group] for scene in scenes])
    improvement = np.zeros(V)
    for number in range(_FOLDS):
        counts = _fit(cases.rows(fold[cases.scene] != number), most, vocabulary)
        test = [scenes[k] for k in np.flatnonzero(fold == number).tolist()]
        for scene, seed in product(test, range(_DRAWS)):
            part, indices = listed_cases(scene, counted[scene.source], vocabulary.structure, seed)
            room = part.room if part.room >= 0 else None
            rows, p = counts.distribution(V, part.classes, part.listed, room)
            is_case = np.isin(rows, indices)
            rows, expected = rows[is_case], p[is_case] @ np.arange(1, MOST + 1)
            classes, truth = part.classes[rows], part.number[rows]
            mean = class_mean(counts, np.searchsorted(counts.classes, classes), part.listed[rows])
            improvement[classes] -= np.abs(expected - truth) - np.abs(mean - truth)
    return improvement > 0
