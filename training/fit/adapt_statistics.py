"""Adapt the statistics of a model to one home: usual places, and numbers of instances.

- *Places.* The counts of the model (`app.model.Places`) get the scenes of the home with a relation
  of two classes, at most `_SCENES`. A confirmed relation that the model reports counts like
  `_SCENES` scenes, and the model never reports it again.
- *Numbers.* Let S scenes show a class, N(n) of them n instances, and p(n) be the mean answer of the
  model about them (`app.model.Counts`). If several instances are in `LEAST` scenes, s(n) in the
  formula of the model is multiplied by

      (w N(n) + `_PRIOR` p(n)) / ((w S + `_PRIOR`) p(n)),    w = min(1, `_SCENES` / S),

  the posterior mean of the share of n instances with a Dirichlet prior around p, divided by p.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.model import SceneModel
from training.datasets.cases import Triple
from training.fit.offset_statistics import half_precision
from training.fit.regression import recalibrated

LEAST: Final = 3  # scenes that show several instances of a class
_SCENES: Final = 20.0  # maximum number of scenes with an influence on one relation or class
_SMALLEST: Final = -64.0  # log share that a model may store
_PRIOR: Final = 5.0  # weight of the answers of the model, in scenes


@dataclass(frozen=True)
class Numbers:
    """The numbers of instances in one recorded scene."""

    classes: Int[NDArray[Any], "n"]  # without structure, ascending
    instances: Int[NDArray[Any], "n"]  # of each class
    room: int | None


def with_places(
    model: SceneModel, confirmed: Collection[Triple], repeated: Mapping[Triple, int]
) -> SceneModel:
    """Return the model with the relations of a home; it never reports the confirmed ones."""
    places, V = model.places, len(model.vocabulary)
    if places is None or not (confirmed or repeated):
        return model
    scenes = {triple: min(float(n), _SCENES) for triple, n in repeated.items()}
    scenes |= dict.fromkeys(confirmed, _SCENES)
    triples = sorted(scenes)
    # The keys of relation a between classes i and j; scene counts of equal keys are added.
    new = np.array([(a * V + i) * V + j for a, i, j in triples], places.triple.dtype)
    keys, index = np.unique(np.concatenate([places.triple, new]), return_inverse=True)
    added = np.array([scenes[triple] for triple in triples])
    counts = np.bincount(index, np.concatenate([places.triple_scenes, added]))
    places = replace(places, triple=keys, triple_scenes=counts.astype(places.triple_scenes.dtype))
    own = tuple(sorted(confirmed))
    misplaced = model.calibration.misplaced.model_copy(update={"confirmed": own})
    return recalibrated(replace(model, places=places), misplaced=misplaced)


def with_numbers(model: SceneModel, scenes: Iterable[Numbers]) -> tuple[SceneModel, list[str]]:
    """Return the model with the usual numbers of a home, and the labels whose numbers changed."""
    if model.counts is None:
        return model, []
    counts, V = model.counts, len(model.vocabulary)
    shown: dict[int, list[tuple[Float[NDArray[np.float64], "M"], int]]] = defaultdict(list)
    for scene in scenes:
        one_each = np.ones_like(scene.classes)
        rows, p = counts.distribution(V, scene.classes, one_each, scene.room)
        for row, distribution in zip(rows.tolist(), p, strict=True):
            shown[int(scene.classes[row])].append((distribution, int(scene.instances[row])))
    log_share, labels = counts.log_share.copy(), []
    for row, k in enumerate(counts.classes.tolist()):
        if sum(n > 1 for _, n in shown[k]) >= LEAST:
            changed = log_share[row] + _log_ratio(shown[k])
            log_share[row] = half_precision(np.maximum(changed - changed.max(), _SMALLEST))
            labels.append(model.vocabulary.labels[k])
    return replace(model, counts=replace(counts, log_share=log_share)), labels


def _log_ratio(
    shown: Collection[tuple[Float[NDArray[np.float64], "M"], int]],
) -> Float[NDArray[np.float64], "M"]:
    """Return the log of the factor of s(n), from distributions and shown numbers of one class."""
    p = np.mean([distribution for distribution, _ in shown], axis=0)
    M, S = len(p), len(shown)
    number = np.bincount(np.minimum([n for _, n in shown], M) - 1, minlength=M)
    weight = min(1.0, _SCENES / S)
    share = (weight * number + _PRIOR * p) / (weight * S + _PRIOR)
    ratio: Float[NDArray[np.float64], "M"] = np.log(share / np.maximum(p, 1e-9))
    return ratio
